"""What the browser draws: Lambert's law, the refined model, and the mixing of images; and the command itself."""

import importlib.util

import numpy as np
import pytest
import torch
from sdps_scenes import hemisphere_lights

from pipelines import cli
from pipelines.app.rooms.object_view import shading
from pipelines.app.rooms.studio_tasks import training_preset, triangles, wanted
from pipelines.shared import presets
from render.shared.errors import InputError
from sdps.refinement.image_model import State, difference, factors
from sdps.refinement.modes import factor

RNG = np.random.default_rng(0)


def test_a_white_matt_surface_that_faces_the_light_is_one() -> None:
    light = np.array([0.6, 0.0, 0.8])
    assert np.allclose(shading(light[None, None], np.ones((1, 1, 3)), np.zeros((1, 1)), {}, light), 1.0)


def test_the_refined_model_is_the_one_that_was_fitted() -> None:
    normals, lights = hemisphere_lights(30, RNG), hemisphere_lights(8, RNG)
    lobes = {
        "amplitudes": [0.5, 1.0],
        "sharpness": [20.0, 200.0],
        "body": [0.1, -0.2, 0.05, 0.3],
        "modes": [0.1, -0.2, 0.2, 0.1, -0.3, 0.05],
    }
    albedo, strength = RNG.uniform(0.2, 1, (30, 3)), RNG.uniform(0.1, 1, 30)
    made = np.stack(
        [shading(normals[None], albedo[None], strength[None], lobes, light)[0] for light in lights], axis=-1
    )
    state = State(
        normals=normals, log_albedo=np.log(albedo), log_strength=np.log(strength), body=lobes["body"],
        lobes=np.log(np.expm1(lobes["amplitudes"])), log_sharpness=np.log(lobes["sharpness"]), directions=lights,
        log_intensities=np.zeros((8, 3)), whiteness=0.0, modes=lobes["modes"],
    )  # fmt: skip
    tensors = State(*(torch.as_tensor(np.asarray(part), dtype=torch.float64) for part in state))
    images = torch.as_tensor(made)  # (P, 3, L)
    bent = factor(tensors.normals, tensors.directions, tensors.modes)
    off = difference(factors(tensors), images / bent[:, None], torch.zeros(30, 8, dtype=torch.bool))
    assert float(off.abs().max()) < 0.012  # 0.01 is what the robust difference is where nothing differs


def test_triangles_cover_the_lights() -> None:
    lights = hemisphere_lights(40, RNG)
    assert set(np.ravel(triangles(lights))) == set(range(40))
    assert triangles(lights[:2]) == []


@pytest.mark.parametrize("name", ["/etc/passwd", "../x.ply", "bunny;rm", "meshes:1", ""])
def test_only_known_names_are_rendered(tmp_path, name: str) -> None:
    with pytest.raises(InputError, match="shape"):
        wanted(tmp_path / "studio", shape=name, material="chrome")
    for material in ("/etc/passwd", "x.yaml", "maps:1:folder", "stripes:7:a.binary+b", "lambertian:../x"):
        with pytest.raises(InputError, match="material"):
            wanted(tmp_path / "studio", shape="bunny", material=material)


def test_the_training_preset_can_be_loaded(tmp_path) -> None:
    text = training_preset(str(tmp_path), shape="blobby:4", material="stripes:7:chrome+nylon")
    (tmp_path / "my-scenes.yaml").write_text(text)
    assert presets.load(str(tmp_path / "my-scenes.yaml")).data.families == {"blobby": 200}
    with pytest.raises(InputError, match="many shapes"):
        training_preset(str(tmp_path), shape="bunny", material="chrome")


def test_a_missing_extra_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "uvicorn" else found(name, *rest)
    )
    assert cli.main(["app", "--no-browser"]) == 2
    assert capsys.readouterr().err.strip() == "sdps: uvicorn missing: pip install sdps[app]"
