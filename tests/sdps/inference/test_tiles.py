"""Tiles: together they are the whole, and what networks say of them is what they say of the whole."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from sdps_scenes import hemisphere_lights, shade, sphere_normals

from render.shared.config import to_plain
from sdps.data.augment import Augmentation
from sdps.inference import estimator as estimators
from sdps.inference.estimator import Estimator
from sdps.inference.image_source import survey
from sdps.inference.tiles import PIXEL_BYTES, tiles
from sdps.methods import on_box
from sdps.methods.on_box import Box, estimate_bytes
from sdps.models.base import Lights
from sdps.models.checkpoint import TrainedModel
from sdps.models.frames import FusedMap
from sdps.models.registry import create

ROOT = Path(__file__).resolve().parents[3]
LIGHTS = hemisphere_lights(6, np.random.default_rng(1))


def trained(name: str) -> TrainedModel:
    """Return a network with random weights, whose layers all do something."""
    torch.manual_seed(2)
    network = create(name).eval()
    for parameter in network.parameters():
        if not parameter.any():  # those that begin training at zero would hide a mistake
            torch.nn.init.normal_(parameter, std=0.05)
    metadata = {"config": {"augmentation": to_plain(Augmentation())}}
    return TrainedModel(name, network.to(memory_format=torch.channels_last), {}, metadata)


@pytest.fixture(scope="module")
def sphere() -> tuple[np.ndarray, np.ndarray]:
    """Images (6, 300, 300, 3) with fine structure, and a mask (300, 300)."""
    normals, mask = sphere_normals(300, radius=0.95)
    images = shade(normals, LIGHTS)
    paint = np.random.default_rng(3).uniform(0.3, 1.0, (300, 300, 1)).astype(np.float32)
    return (images * paint).astype(np.float32), mask


@pytest.mark.parametrize(("height", "width", "multiple"), [(300, 200, 4), (97, 411, 4), (64, 5000, 1), (801, 333, 8)])
def test_tiles_cover_the_object_once(height: int, width: int, multiple: int) -> None:
    mask = np.random.default_rng(0).random((height, width)) < 0.01
    most, halo = 150**2, 16
    seen = np.zeros(mask.shape, int)
    for tile in tiles(mask, most, halo, multiple):
        seen[tile.inner] += 1
        outer = mask[tile.outer_rows, tile.outer_columns]
        assert np.array_equal(outer[tile.within], mask[tile.inner])
        assert outer.size <= 1.2 * most
        assert tile.outer_rows.start % multiple == 0 and tile.outer_columns.start % multiple == 0
        assert tile.outer_rows.start == max(tile.rows.start - halo, 0)
        assert tile.outer_columns.stop == min(tile.columns.stop + halo, width)
    assert (seen <= 1).all() and seen[mask].all()


def test_a_small_object_is_one_tile() -> None:
    (tile,) = tiles(np.eye(40, dtype=bool), 1600, 32, 4)
    assert tile.inner == tile.within == (slice(0, 40), slice(0, 40))


@pytest.mark.parametrize("name", ["frames", "psfcn", "nenet-plus", "upsfcn-deep"])
def test_normals_depend_on_no_pixel_out_of_reach(name: str) -> None:
    network = trained(name).network
    side, middle = 2 * network.reach + 36, network.reach + 18
    images = torch.rand(1, 2, 3, side, side)
    seen = network.observe(images, torch.ones(1, 1, side, side), Lights(*unit_lights(2)))
    if name == "frames":
        shape = (1, side, side)
        parts = torch.rand(3, *shape), torch.rand(32, *shape)
        fused = FusedMap(*(part.permute(1, 0, 2, 3).requires_grad_() for part in parts), torch.ones(1, *shape))
        network.regress(fused)[0, :, middle, middle].sum().backward()
        (gradient,) = [fused.feature.grad.abs().sum(dim=(0, 1))]
    else:
        seen.images.requires_grad_()
        network(seen)[0, :, middle, middle].sum().backward()
        gradient = seen.images.grad.abs().sum(dim=(0, 1, 2))
    rows = gradient.sum(dim=1).nonzero()[:, 0]
    columns = gradient.sum(dim=0).nonzero()[:, 0]
    for places in (rows, columns):
        assert middle - int(places.min()) <= network.reach and int(places.max()) - middle <= network.reach
        assert int(places.max() - places.min()) > network.reach  # it does see far


def unit_lights(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return directions (1, count, 3) and intensities (1, count)."""
    return torch.from_numpy(LIGHTS[:count])[None].float(), torch.ones(1, count)


@pytest.mark.parametrize("name", ["frames", "psfcn", "nenet-plus", "upsfcn-light", "cnnps"])
def test_tiles_say_what_the_whole_says(name: str, sphere: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    images, mask = sphere
    model = trained(name)
    if name == "cnnps":  # slow, and pixel by pixel
        images, mask = images[:, 120:200, 120:200], mask[120:200, 120:200]
    estimator = Estimator(
        lighting=None, normals=model, device=torch.device("cpu"), precision="float32", rotations=1, stray_light=False
    )
    lights = LIGHTS if estimator.needs_lights else None
    whole = estimator.estimate(images, mask, lights)
    side = 70 if name == "cnnps" else 150
    kept = getattr(model.network, "kept_bytes", 0)
    monkeypatch.setattr(estimators, "TILE_BYTES", side**2 * (PIXEL_BYTES + len(images) * kept))
    assert len(tiles(mask, side**2, 0)) > 1
    cut = estimator.estimate(images, mask, lights)
    np.testing.assert_allclose(cut.normals, whole.normals, atol=1e-5)
    if whole.expected_error is not None:
        error = whole.expected_error
        np.testing.assert_allclose(cut.expected_error, error, atol=1e-3)


def test_a_part_reads_what_the_whole_reads(sphere: tuple) -> None:
    images, mask = sphere
    scene = survey(images, mask, 4)
    part = scene.part(slice(10, 90), slice(33, 70))
    np.testing.assert_array_equal(part.read(1, 4), scene.read(1, 4)[:, 10:90, 33:70])


@pytest.mark.parametrize("name", ["least-squares-shadows", "position-threshold", "robust-least-squares"])
def test_methods_by_pixel_see_some_rows_at_once(name: str, sphere: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    images, mask = sphere
    whole = Box(name, images, mask).run((LIGHTS, None)).normals
    monkeypatch.setattr(on_box, "PART_BYTES", 8 * 2**20)
    assert estimate_bytes(name, len(images), mask.size) == 8 * 2**20
    np.testing.assert_allclose(Box(name, images, mask).run((LIGHTS, None)).normals, whole, atol=1e-6)
    assert estimate_bytes("pf14", len(images), mask.size) > 8 * 2**20  # sees all at once


def test_memory_does_not_grow_with_the_frame() -> None:
    """Of 600x600 pixels at once the network makes 0.6 GiB."""
    command = [sys.executable, "tests/support/large_memory.py", "600"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests" / "support")])}

    def more(mebibytes: int) -> float:
        done = subprocess.run(
            [*command, str(mebibytes)], check=True, capture_output=True, text=True, cwd=ROOT, env=environment
        )  # fmt: skip
        return float(json.loads(done.stdout.splitlines()[-1])["more_mib"])

    assert more(200) < 300.0 < 450.0 < more(4000)
