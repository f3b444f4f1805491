"""What `auto` does about the light: one lamp at a time, or any."""

import logging
from pathlib import Path

import numpy as np
import photo_folders as folders
import pytest
import torch

import sdps
from render.shared.config import to_plain
from render.shared.errors import InputError
from sdps.api import choose_method
from sdps.data.augment import Augmentation
from sdps.methods import light_witness, pretrained
from sdps.methods.light_witness import see_directness
from sdps.models.checkpoint import TrainedModel, save_weights
from sdps.models.registry import create

SMALL = {"width": 16, "blocks": 1, "heads": 2, "channels": 16, "context": 0}


def write_weights(out: Path, directness: float) -> Path:
    """Write a network that sees light of one directness everywhere; return the folder of runs."""
    network = create("anylight", **SMALL)
    with torch.no_grad():
        network.light.weight.zero_()
        network.light.bias.zero_()
        network.light.bias[0], network.light.bias[3] = 1.0, 3.0**0.5 * directness
    model = TrainedModel("anylight", network, SMALL, {"config": {"augmentation": to_plain(Augmentation())}})
    place = out / "models" / "anylight"
    place.mkdir(parents=True)
    save_weights(place / "anylight.safetensors", model)
    return out


@pytest.mark.parametrize("directness", [0.2, 0.9])
def test_a_network_says_how_direct_the_light_is_of_images_of_any_size(tmp_path: Path, directness: float) -> None:
    find = pretrained.finder(write_weights(tmp_path, directness))
    images, mask = np.random.default_rng(0).random((40, 150, 300, 3), np.float32), np.zeros((150, 300), bool)
    mask[20:130, 10:290] = True
    assert see_directness(images, mask, find) == pytest.approx(directness, abs=1e-5)
    mask[:] = False
    mask[5, 7] = True
    assert see_directness(images[:3], mask, find) == pytest.approx(directness, abs=1e-5)


def test_auto_takes_the_network_for_any_light_where_no_lamp_is_alone(tmp_path: Path) -> None:
    mixed, lamps = write_weights(tmp_path / "mixed", 0.2), write_weights(tmp_path / "lamps", 0.95)
    images, mask = np.random.default_rng(0).random((4, 24, 24, 3), np.float32), np.ones((24, 24), bool)
    chosen, said = choose_method("auto", images, mask, "auto", False, mixed)
    assert chosen == "anylight" and "one lamp" in said[0].text and "--lit-by lamp" in said[0].text
    assert choose_method("auto", images, mask, "auto", False, lamps) == ("auto", ())
    assert choose_method("auto", images, mask, "lamp", False, mixed) == ("auto", ())
    assert choose_method("auto", images, mask, "any", False, lamps) == ("anylight", ())
    assert choose_method("auto", images, mask, "auto", True, mixed) == ("auto", ()), "lights are given"
    assert choose_method("pf14", images, mask, "any", False, mixed) == ("pf14", ()), "a method is named"
    with pytest.raises(InputError, match=r"unknown lit_by 'lamps'; did you mean 'lamp'\?"):
        choose_method("auto", images, mask, "lamps", False, mixed)


def test_without_weights_every_light_counts_as_lamps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing(name: str, out: Path | None = None) -> Path:
        raise InputError(f"{name}: no such weights")

    monkeypatch.setattr(pretrained, "require", nothing)
    images, mask = np.ones((3, 8, 8, 3), np.float32), np.ones((8, 8), bool)
    assert choose_method("auto", images, mask, "auto", False) == ("auto", ())
    with pytest.raises(InputError, match="no such weights"):
        choose_method("auto", images, mask, "any", False)


def test_photographs_in_a_lit_room_are_not_taken_for_those_of_a_lamp(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    lights = np.array([[0.5, 0.0, 0.8], [0.0, 0.5, 0.8], [-0.5, 0.0, 0.8], [0.0, -0.5, 0.8]])
    images, mask = folders.matte(lights, size=40)
    photos = sdps.load(folders.write_folder(tmp_path / "photos", images + 0.2, mask))
    out = write_weights(tmp_path / "out", 0.3)
    found = sdps.infer(photos, models=out, findings=())
    assert found.method == "anylight" and not len(found.light_directions)
    assert any("one lamp at a time" in finding.text for finding in found.findings)
    assert sdps.plan(photos, models=out).method == "anylight"
    with caplog.at_level(logging.WARNING):
        assert sdps.infer(photos, models=out, findings=(), lit_by="lamp", refine=False).method != "anylight"
    assert light_witness.DIRECT < 0.95
