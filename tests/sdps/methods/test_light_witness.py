"""What `auto` does about the light: one lamp at a time, or any."""

from pathlib import Path

import numpy as np
import photo_folders as folders
import pytest
import torch
from any_light_weights import write_weights

import sdps
from render.shared.errors import InputError
from sdps.api import choose_method
from sdps.core.metrics import angle_degrees
from sdps.methods import pretrained
from sdps.methods.flat_things import Flatness
from sdps.methods.light_witness import ROOM, is_lit_by_lamps, measure_spread
from sdps.methods.parse import parse
from sdps.methods.runner import Runner


def shade(lights: np.ndarray, ambient: float) -> tuple[np.ndarray, np.ndarray]:
    """Return images (L, 64, 64, 3) of a white ball, and its mask."""
    y, x = np.mgrid[1:-1:64j, -1:1:64j]
    mask = x**2 + y**2 < 0.95
    normals = np.stack([x, y, np.sqrt(np.clip(1.0 - x**2 - y**2, 0.0, 1.0))], axis=-1)
    shading = np.clip(np.einsum("hwk,lk->lhw", normals, lights), 0.0, None) + ambient
    return np.repeat((shading * mask)[..., None], 3, axis=-1).astype(np.float32), mask


RING = np.array([[np.cos(a), np.sin(a), 1.2] for a in np.linspace(0.0, 5.0, 8)], np.float32)
RING /= np.linalg.norm(RING, axis=1, keepdims=True)


@pytest.mark.parametrize("spread", [0.0, 0.1, 0.3, 0.9])
def test_light_from_many_sides_is_not_a_lamp(tmp_path: Path, spread: float) -> None:
    images, mask = shade(RING, 1.0)
    find = pretrained.finder(write_weights(tmp_path, spread))
    assert measure_spread(images, mask, find) == pytest.approx(spread, abs=2e-3)
    assert is_lit_by_lamps(images, mask, find) == (spread < ROOM)
    assert is_lit_by_lamps(images, np.ones_like(mask), find), "what covers the frame may be flat"


def test_networks_that_take_all_light_for_lamps_do_not_speak_against_them(tmp_path: Path) -> None:
    images, mask = shade(RING, 1.0)
    assert measure_spread(images, mask, pretrained.finder(write_weights(tmp_path, None))) == 0.0


def test_auto_takes_the_network_for_any_light_where_no_lamp_is_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, (images, mask) = write_weights(tmp_path), shade(RING, 1.0)
    monkeypatch.setattr("sdps.api.is_lit_by_lamps", lambda *_: False)
    chosen, said = choose_method("auto", images, mask, "auto", False, out)
    assert chosen == "anylight" and "many sides" in said[0].text and "--lit-by lamp" in said[0].text
    assert choose_method("auto", images, mask, "lamp", False, out) == ("auto", ())
    assert choose_method("auto", images, mask, "auto", True, out) == ("auto", ()), "lights are given"
    assert choose_method("pf14", images, mask, "any", False, out) == ("pf14", ()), "a method is named"
    with pytest.raises(InputError, match=r"unknown lit_by 'lamps'; did you mean 'lamp'\?"):
        choose_method("auto", images, mask, "lamps", False, out)
    assert choose_method("auto", images, mask, "auto", False, out, flat=Flatness("yes")) == ("auto", ())
    monkeypatch.setattr("sdps.api.is_lit_by_lamps", lambda *_: True)
    assert choose_method("auto", images, mask, "auto", False, out) == ("auto", ())
    assert choose_method("auto", images, mask, "any", False, out) == ("anylight", ())


def test_without_weights_every_light_counts_as_lamps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing(name: str, out: Path | None = None) -> Path:
        raise InputError(f"{name}: no such weights")

    monkeypatch.setattr(pretrained, "require", nothing)
    images, mask = np.ones((3, 8, 8, 3), np.float32), np.ones((8, 8), bool)
    assert choose_method("auto", images, mask, "auto", False) == ("auto", ())
    with pytest.raises(InputError, match="no such weights"):
        choose_method("auto", images, mask, "any", False)


def test_photographs_in_a_lit_room_are_not_taken_for_those_of_a_lamp(tmp_path: Path) -> None:
    images, mask = shade(RING, 1.0)
    photos = sdps.load(folders.write_folder(tmp_path / "photos", 0.4 * images, mask))
    out = write_weights(tmp_path / "out", spread=0.4)
    found = sdps.infer(photos, models=out, findings=())
    assert found.method == "anylight (lightset-any + frames-any), refined" and not len(found.light_directions)
    assert any("many sides" in finding.text for finding in found.findings)
    assert sdps.plan(photos, models=out).method == found.method
    assert "anylight" not in sdps.plan(photos, models=out, lit_by="lamp").method
    assert choose_method("auto", photos, photos.mask, "auto", False, write_weights(tmp_path / "lamps")) == ("auto", ())


def test_normals_are_found_under_light_that_spreads_as_far_as_was_told(tmp_path: Path) -> None:
    (images, mask), found = shade(RING, 0.5), []
    for spread in (0.0, 0.6):
        find = pretrained.finder(write_weights(tmp_path / str(spread), spread))
        estimator = Runner(parse("anylight", find), find).estimator
        assert estimator is not None and estimator.normals is not None
        network = estimator.normals.network
        torch.manual_seed(0)
        for last in (network.offset, network.about):
            torch.nn.init.normal_(last.weight, std=0.3)
        found.append(estimator.estimate(images, mask))
        covariance = found[-1].light_covariance
        assert covariance is not None
        np.testing.assert_allclose(covariance, np.broadcast_to(spread / 3.0 * np.eye(3), (8, 3, 3)), atol=2e-3)
    assert angle_degrees(found[0].normals[mask], found[1].normals[mask]).mean() > 0.5


def test_of_any_light_nothing_is_taken_off_the_images_and_no_lights_are_told(tmp_path: Path) -> None:
    images, mask = shade(RING, 0.02)
    find = pretrained.finder(write_weights(tmp_path))
    runner = Runner(parse("anylight", find), find)
    found = runner.estimate(images, mask, None, None)
    assert found.stray_light is not None and not found.stray_light.any() and runner.any_light
    assert found.light_directions.shape == (0, 3) and not len(found.intensities)
    assert found.nearness is None and found.light_covariance is None
    lamps = Runner(parse("true+frames-any", find), find).estimate(images, mask, RING, np.ones(8))
    np.testing.assert_allclose(lamps.light_directions, RING, atol=1e-6)  # lamps that are given are kept


def test_photographs_are_looked_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images, mask = shade(RING, 1.0)
    photos, asked = sdps.load(folders.write_folder(tmp_path / "photos", 0.4 * images, mask)), []
    monkeypatch.setattr("sdps.api.is_lit_by_lamps", lambda *_: asked.append(1) or True)
    out = write_weights(tmp_path / "out")
    sdps.plan(photos, models=out)
    sdps.plan(photos, models=out)
    assert len(asked) == 1
