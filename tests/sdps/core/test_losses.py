"""Losses of normals: what each of them counts, and what it does not."""

import math

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from sdps.core.losses import chord_normal_loss, expected_error_loss, normal_gradient_loss


def unit(*shape: int) -> Tensor:
    return functional.normalize(torch.randn(*shape, 3), dim=-1)


def test_the_gradient_loss_knows_steps_and_not_offsets() -> None:
    truth = torch.zeros(1, 3, 4, 4)
    mask = torch.ones(1, 1, 4, 4)
    assert float(normal_gradient_loss(truth + 0.3, truth, mask)) == pytest.approx(0.0, abs=1e-6)
    ramp = truth.clone()
    ramp[:, 0] += 0.1 * torch.arange(4.0)  # one step of 0.1 along x, none along y
    assert float(normal_gradient_loss(ramp, truth, mask)) == pytest.approx(0.05)
    mask[..., 2:] = 0.0
    broken = ramp.clone()
    broken[..., 2:] = 7.0  # pairs across the border do not count
    kept = float(normal_gradient_loss(broken, truth, mask))
    assert kept == pytest.approx(4 * 0.1 / (4 + 6))
    assert float(normal_gradient_loss(broken, truth, 0.0 * mask)) == 0.0


def test_the_chord_loss_grows_with_the_angle_and_knows_the_mask():
    truth, mask = torch.zeros(1, 3, 1, 3), torch.tensor([1.0, 1.0, 0.0]).view(1, 1, 1, 3)
    truth[:, 2] = 1.0
    turned = truth.clone()
    turned[0, :, 0, 0] = torch.tensor([math.sin(0.4), 0.0, math.cos(0.4)])
    turned[..., 2] = -1.0
    wanted = (math.hypot(2.0 * math.sin(0.2), 0.02) - 0.02) / 2.0
    assert float(chord_normal_loss(turned, truth, mask)) == pytest.approx(wanted, rel=1e-5)
    assert float(chord_normal_loss(turned, truth, 0.0 * mask)) == 0.0


def test_the_expected_error_is_best_at_the_mean_of_the_errors():
    truth = unit(1, 8, 8).permute(0, 3, 1, 2)
    normals = unit(1, 8, 8).permute(0, 3, 1, 2).requires_grad_()
    mask = torch.ones(1, 1, 8, 8)
    mean = (normals.detach() - truth).norm(dim=1).mean()
    losses = [float(expected_error_loss(scale * mean * mask, normals, truth, mask)) for scale in (0.8, 1.0, 1.25)]
    assert losses[1] < min(losses[0], losses[2])
    assert not expected_error_loss(mean * mask, normals, truth, mask).requires_grad
