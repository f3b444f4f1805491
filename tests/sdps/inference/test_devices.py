"""Devices without having one: on torch's `meta` device an operation that mixes in a tensor of the CPU fails.

A network, its loss and its lights must come out of tensors of one device alone; what passes here meets no tensor left
behind on a GPU. Values are another matter (`test_gpu.py`).
"""

from contextlib import nullcontext

import pytest
import torch

from sdps.models.base import Lights
from sdps.models.frames import FrameNet
from sdps.models.lcnet import INPUT_SIZE
from sdps.models.registry import MODELS, create
from sdps.training.muon import _Muon, is_matrix, orthogonalise

META = torch.device("meta")
NORMALS = [name for name, item in MODELS.items() if item.role == "normals" and item.build is not FrameNet]
"""`frames` works on the pixels of the object: how many is a value, which this device has not."""
LIGHTING = [name for name, item in MODELS.items() if item.role == "lighting"]


@pytest.fixture(autouse=True)
def no_autocast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Autocast does not know the device; nothing here is computed in half precision."""
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())


def vectors(*shape: int) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.rand(*shape, device=META), dim=-1)


@pytest.mark.parametrize("name", LIGHTING)
def test_lighting_networks(name: str) -> None:
    network = create(name).to(META)
    images = torch.rand(2, 3, 3, INPUT_SIZE, INPUT_SIZE, device=META)
    prediction = network(images, torch.ones(2, 1, INPUT_SIZE, INPUT_SIZE, device=META))
    loss = network.loss(prediction, Lights(vectors(2, 3, 3), torch.ones(2, 3, device=META)))["total"]
    assert loss.device == META
    for how in ("centre", "expectation"):
        assert network.read_lights(prediction, how).directions.device == META
    loss.backward()


@pytest.mark.parametrize("name", NORMALS)
def test_normal_networks(name: str) -> None:
    network = create(name).to(META)
    images, mask = torch.rand(1, 3, 3, 32, 32, device=META), torch.ones(1, 1, 32, 32, device=META)
    lights = Lights(vectors(1, 3, 3), torch.ones(1, 3, device=META))
    normals = network(network.observe(images, mask, lights))
    assert normals.shape == (1, 3, 32, 32) and normals.device == META
    normals.sum().backward()


def test_muon() -> None:
    assert orthogonalise(torch.rand(64, 128, device=META)).device == META
    network = create("nenet").to(META)
    for parameter in network.parameters():
        parameter.grad = torch.zeros_like(parameter)
    # Fused AdamW wants a real device; the matrices' part is ours.
    _Muon([p for p in network.parameters() if is_matrix(p)], 1e-3, 0.95, 0.0).step()
