"""What reflectance of real materials adds to the model."""

import numpy as np
import pytest
import torch

from sdps.core.metrics import angle_degrees
from sdps.refinement.image_model import State, build_model
from sdps.refinement.modes import ASSET, evaluate_modes, fit_modes
from sdps.refinement.refine import RefineConfig, refine
from sdps.refinement.reflectance import LOBES, MODES, SHAPES, evaluate_factor, measure_angles

FABRIC = torch.tensor([0.1, -0.5, 0.3, 0.1, -0.6, 0.2])
"""Of the size that fitted materials have."""


def sphere(side: int = 40, lights: int = 50) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mask, normals (P, 3) and lights (L, 3)."""
    y, x = np.mgrid[1 : -1 : side * 1j, -1 : 1 : side * 1j]
    mask = np.hypot(x, y) < 0.97
    normals = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)[mask]
    rng = np.random.default_rng(0)
    found = rng.normal(size=(lights, 3))
    found[:, 2] = np.abs(found[:, 2]) + 0.3
    return mask, normals.astype(np.float32), (found / np.linalg.norm(found, axis=1, keepdims=True)).astype(np.float32)


def test_modes_that_images_were_made_with_are_found() -> None:
    _, normals, lights = (torch.from_numpy(part) for part in sphere())
    state = State(
        normals=normals, log_albedo=torch.zeros(len(normals), 3), log_strength=torch.full((len(normals),), -20.0),
        body=torch.zeros(SHAPES), lobes=torch.full((LOBES,), -20.0), log_sharpness=torch.ones(LOBES),
        directions=lights, log_intensities=torch.zeros(len(lights), 3), whiteness=torch.tensor(0.0),
        modes=torch.zeros(MODES), log_nearness=torch.tensor(-torch.inf), uneven=torch.zeros(len(lights)),
    )  # fmt: skip
    model = build_model(state)
    shade = (normals @ lights.T).clamp_min(0.0)
    expected, seen = evaluate_modes(model, FABRIC), model.see(None)
    images = (shade * expected)[:, None].repeat(1, 3, 1)
    found = evaluate_modes(
        model, fit_modes(model, images, torch.ones_like(shade), seen, measure_angles(normals, lights))
    )
    ratio = torch.log(found / expected)[shade > 0.1]
    # A constant is the albedo's; what is left of the logarithms' spread:
    assert float(ratio.std()) < 0.3 * float(expected.log()[shade > 0.1].std())


def test_a_sphere_that_is_neither_matte_nor_glossy_keeps_its_shape(monkeypatch: pytest.MonkeyPatch) -> None:
    mask, normals, lights = sphere()
    bent = evaluate_factor(measure_angles(normals, lights), FABRIC.numpy())
    images = np.zeros((len(lights), *mask.shape, 3), np.float32)
    images[:, mask] = (np.maximum(normals @ lights.T, 0.0) * bent).T[..., None] * [0.5, 0.4, 0.3]
    truth = np.zeros((*mask.shape, 3), np.float32)
    truth[mask] = normals
    off = []
    for known in (False, True):
        if not known:
            monkeypatch.setattr("sdps.refinement.descent.fit_modes", lambda *_, **__: torch.zeros(MODES))
        config = RefineConfig(coarse_pixels=800, iterations=200, iterations_before=0, fine_iterations=0)
        found = refine(images, mask, truth, lights, np.ones(len(lights)), config=config)
        off.append(float(angle_degrees(found.normals[mask], normals).mean()))
        monkeypatch.undo()
    assert off[1] < 0.6 * off[0]


def test_the_asset_is_a_matrix_of_second_moments() -> None:
    from render.shared.config import read_yaml

    moments = np.array(read_yaml(str(ASSET))["second_moments"])
    assert moments.shape == (MODES, MODES) and np.allclose(moments, moments.T)
    assert np.linalg.eigvalsh(moments).min() > -1e-4
