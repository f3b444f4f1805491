"""Muon: orthogonal updates of the right size, exact resume, and what it takes of a network."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from sdps_scenes import write_data
from torch import nn

from sdps.models.checkpoint import load_weights
from sdps.training.muon import _COEFFICIENTS, Muon, is_matrix, orthogonalise
from sdps.training.stages import NormalStage
from sdps.training.trainer import train
from sdps.training.training_config import NormalTraining


@pytest.mark.parametrize("shape", [(64, 64), (64, 576), (576, 64)])
def test_updates_are_nearly_orthogonal(shape: tuple[int, int]) -> None:
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    values = torch.linalg.svdvals(orthogonalise(matrix))
    assert values.max() < 1.3 and values.quantile(0.05) > 0.6  # the smallest of a square one may be far from 1
    assert (orthogonalise(matrix) * matrix).sum() > 0  # the nearest, not any


@pytest.mark.parametrize("smallest", [1.0, 1e-6])
@pytest.mark.parametrize("shape", [(64, 576), (128, 128), (200, 40)])
def test_gram_matrices_give_what_the_plain_iteration_does(shape: tuple[int, int], smallest: float) -> None:
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    left, values, right = torch.linalg.svd(matrix, full_matrices=False)
    matrix = left @ torch.diag(values * torch.logspace(0, math.log10(smallest), len(values))) @ right
    x = matrix.double() / matrix.double().norm()
    for _ in range(5):
        a, b, c = _COEFFICIENTS
        gram = x @ x.T
        x = a * x + (b * gram + c * gram @ gram) @ x
    assert (orthogonalise(matrix) - x).norm() < 1e-3 * x.norm()


def test_kernels_are_matrices_and_the_rest_is_not() -> None:
    network = nn.Sequential(
        nn.Conv2d(3, 64, 3), nn.Conv2d(64, 64, 3), nn.ConvTranspose2d(64, 32, 4), nn.Conv2d(32, 3, 3)
    )
    assert [is_matrix(layer.weight) for layer in network] == [False, True, True, False]
    optimiser = Muon(network, lr=1e-3)
    assert sum(len(group["params"]) for group in optimiser.param_groups) == len(list(network.parameters()))


def test_a_step_is_as_large_as_one_of_adamw() -> None:
    layer = nn.Conv2d(64, 128, 3)
    before = layer.weight.detach().clone()
    optimiser = Muon(layer, lr=1e-3)
    layer.weight.grad, layer.bias.grad = torch.randn(layer.weight.shape), torch.randn(128)
    optimiser.step()
    size = (layer.weight - before).square().mean().sqrt().item()
    assert size == pytest.approx(0.2e-3, rel=0.25)  # root mean square 0.2 x learning rate, AdamW's typical one


def test_an_interrupted_run_goes_on_exactly(tmp_path: Path) -> None:
    write_data(tmp_path, ("train",) * 3, lights=3, size=32)
    config = NormalTraining(steps=4, batch_scenes=1, images=2, size=32, crop=16, lights="true", workers=0,
                            validation_scenes=0, optimiser="muon", schedule="constant")  # fmt: skip
    whole = train(NormalStage(config), tmp_path, tmp_path / "whole")
    train(NormalStage(replace(config, steps=2)), tmp_path, tmp_path / "parts")
    parts = train(NormalStage(config), tmp_path, tmp_path / "parts")
    states = [load_weights(result.weights["nenet"]).network.state_dict() for result in (whole, parts)]
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
