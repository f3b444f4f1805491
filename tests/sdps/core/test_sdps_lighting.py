"""Light classes: frame, bin edges, round trips and the errors a perfect classifier still makes."""

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from torch.nn import functional

from render.shared.errors import InputError
from sdps.core.lighting import (
    IRRADIANCE,
    LightClasses,
    azimuth_elevation,
    bin_centre,
    bin_index,
    harmonics,
    unit_direction,
)
from sdps.core.metrics import angle_degrees, intensity_error

LIGHTS = Path(__file__).parents[3] / "assets" / "lights"
AXES = {(1, 0, 0): (90, 0), (0, 1, 0): (0, 90), (0, 0, 1): (0, 0), (0, -1, 0): (0, -90), (1, 0, 1): (45, 0)}


def uniform_hemisphere(count: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    z, angle = rng.random(count), 2.0 * np.pi * rng.random(count)
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=-1)


def quantised(directions: np.ndarray, count: int = 36) -> np.ndarray:
    classes = LightClasses(directions=count)
    return classes.decode(*classes.encode(directions, np.ones(len(directions))))[0]


@pytest.mark.parametrize(("direction", "angles"), AXES.items())
def test_axes_of_the_frame(direction: tuple, angles: tuple) -> None:
    # x right is azimuth +90, y up is elevation +90, z to the camera is the origin of both.
    found = azimuth_elevation(np.array(direction, float))
    np.testing.assert_allclose(found, angles, atol=1e-9)


def test_harmonics_are_orthonormal_and_shade_as_lambert_does() -> None:
    torch.manual_seed(7)
    vectors = functional.normalize(torch.randn(200_000, 3), dim=-1)
    basis = harmonics(vectors)
    torch.testing.assert_close(basis.T @ basis / len(basis), torch.eye(9), atol=0.02, rtol=0)
    lamp, normals = functional.normalize(torch.randn(3), dim=0), vectors[:500]
    shown = harmonics(normals) * torch.tensor(IRRADIANCE) @ harmonics(lamp) / 4
    assert (shown - (normals @ lamp).clamp(min=0.0)).abs().mean() < 0.04  # 0.03: of order two


def test_azimuth_turns_about_the_vertical_axis() -> None:
    # Raising a light keeps its azimuth: turning about the view axis instead would change it.
    low, high = unit_direction(np.array([30.0, 30.0]), np.array([0.0, 60.0]))
    np.testing.assert_allclose(low[0] / low[2], high[0] / high[2])


def test_angles_and_directions_are_inverse() -> None:
    directions = uniform_hemisphere(500)
    np.testing.assert_allclose(unit_direction(*azimuth_elevation(directions)), directions, atol=1e-7)


def test_bin_edges_and_centres() -> None:
    angles = np.array([-90.0, -85.1, -85.0, -0.01, 0.0, 84.99, 85.0, 89.9, 90.0, 95.0])
    np.testing.assert_array_equal(bin_index(angles, -90, 90, 36), [0, 0, 1, 17, 18, 34, 35, 35, 35, 35])
    np.testing.assert_allclose(bin_centre(np.array([0, 1, 35]), -90, 90, 36), [-87.5, -82.5, 87.5])
    intensities = np.array([0.2, 0.28, 0.30, 1.99, 2.0])
    np.testing.assert_array_equal(bin_index(intensities, 0.2, 2.0, 20), [0, 0, 1, 19, 19])
    np.testing.assert_allclose(bin_centre(np.array([0, 19]), 0.2, 2.0, 20), [0.245, 1.955], rtol=1e-6)


def test_classes_survive_decoding_and_encoding() -> None:
    classes = LightClasses()
    azimuth, elevation = (grid.ravel() for grid in np.meshgrid(np.arange(36), np.arange(36)))
    labels = (azimuth, elevation, azimuth % 20)
    for expected, found in zip(labels, classes.encode(*classes.decode(*labels)), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_torch_and_numpy_agree() -> None:
    classes = LightClasses()
    directions, intensities = uniform_hemisphere(200), np.linspace(0.2, 2.0, 200)
    labels = classes.encode(directions, intensities)
    tensors = classes.encode(torch.from_numpy(directions), torch.from_numpy(intensities))
    for label, tensor in zip(labels, tensors, strict=True):
        assert tensor.dtype == torch.int64
        np.testing.assert_array_equal(tensor.numpy(), label)
    for array, tensor in zip(classes.decode(*labels), classes.decode(*tensors), strict=True):
        np.testing.assert_allclose(tensor.numpy(), array, atol=1e-6)


def test_read_outs_of_one_certain_and_one_torn_prediction() -> None:
    classes = LightClasses()
    azimuth, elevation, intensity = (torch.full((2, count), -100.0) for count in (36, 36, 20))
    azimuth[0, 20] = elevation[0, 18] = intensity[0, 3] = 100.0
    azimuth[1, 17] = azimuth[1, 18] = elevation[1, 18] = intensity[1, 3] = intensity[1, 4] = 100.0
    centre, _ = classes.read_out(azimuth, elevation, intensity)
    mean, mean_intensity = classes.read_out(azimuth, elevation, intensity, "expectation")
    torch.testing.assert_close(centre[0], mean[0])
    torch.testing.assert_close(azimuth_elevation(mean[1])[0], torch.tensor(0.0), atol=1e-4, rtol=0)
    torch.testing.assert_close(mean_intensity, torch.tensor([0.515, 0.56]))


# A perfect classifier's mean error; figures of the class grid itself, recomputed here.
@pytest.mark.parametrize(("count", "floor"), [(18, 3.45), (36, 1.73), (60, 1.04), (90, 0.69)])
def test_direction_floor_on_the_uniform_hemisphere(count: int, floor: float) -> None:
    directions = uniform_hemisphere(200_000)
    errors = angle_degrees(quantised(directions, count), directions)
    assert errors.mean() == pytest.approx(floor, abs=0.01)
    # No light can be farther than the corner of its cell.
    assert errors.max() < np.hypot(90.0 / count, 90.0 / count)


@pytest.mark.parametrize(("count", "floor"), [(18, 3.74), (36, 1.86), (60, 1.20), (90, 0.76)])
def test_direction_floor_on_the_lights_of_diligent(count: int, floor: float) -> None:
    directions = np.array(yaml.safe_load((LIGHTS / "diligent.yaml").read_text())["directions"])
    assert directions.shape == (96, 3)
    assert (directions[:, 2] > 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=2e-6)
    assert angle_degrees(quantised(directions, count), directions).mean() == pytest.approx(floor, abs=0.011)


@pytest.mark.parametrize(("count", "floor"), [(20, 0.029), (40, 0.014), (80, 0.007)])
def test_intensity_floor_after_the_scale_fit(count: int, floor: float) -> None:
    intensities = np.random.default_rng(0).uniform(0.2, 2.0, (300, 96))
    labels = bin_centre(bin_index(intensities, 0.2, 2.0, count), 0.2, 2.0, count)
    errors = [intensity_error(*pair) for pair in zip(labels, intensities, strict=True)]
    assert np.mean(errors) == pytest.approx(floor, abs=0.0006)


def test_impossible_class_counts_are_refused() -> None:
    with pytest.raises(InputError, match="at least 2"):
        LightClasses(directions=1)
    with pytest.raises(InputError, match="0 < low < high"):
        LightClasses(low=2.0, high=0.2)


def test_soft_classes_have_the_exact_value_as_their_expectation() -> None:
    classes = LightClasses()
    directions = torch.from_numpy(uniform_hemisphere(200)).float()
    directions = directions[directions[:, 2] > 0.1]
    intensities = torch.linspace(0.25, 1.95, len(directions))
    azimuth, elevation, intensity = classes.encode_soft(directions, intensities)
    for weights, count in ((azimuth, 36), (elevation, 36), (intensity, 20)):
        assert weights.shape == (len(directions), count)
        torch.testing.assert_close(weights.sum(-1), torch.ones(len(directions)))
        assert int((weights > 0).sum(-1).max()) <= 2
    inside = (azimuth_elevation(directions)[0].abs() < 87.5) & (azimuth_elevation(directions)[1].abs() < 87.5)
    found = classes.read_out(azimuth.clamp(min=1e-12).log(), elevation.clamp(min=1e-12).log(),
                             intensity.clamp(min=1e-12).log(), "expectation")  # fmt: skip
    torch.testing.assert_close(found[0][inside], directions[inside], atol=1e-4, rtol=0)
    torch.testing.assert_close(found[1], intensities, atol=1e-4, rtol=0)


def test_the_peak_of_a_sampled_gaussian_is_found_exactly_and_stays_in_its_bin() -> None:
    classes = LightClasses()
    centres = bin_centre(torch.arange(36), -90, 90, 36)
    truth = torch.linspace(-80, 80, 41)
    logits = -0.5 * ((centres - truth[:, None]) / 7.0) ** 2
    flat = torch.zeros(41, 20)
    directions, intensities = classes.read_out(logits, logits, flat, "peak")
    azimuth, elevation = azimuth_elevation(directions)
    torch.testing.assert_close(azimuth, truth, atol=2e-3, rtol=0)
    torch.testing.assert_close(elevation, truth, atol=2e-3, rtol=0)
    assert bool((intensities == intensities[0]).all())  # a plateau keeps its class centre
    edge = torch.zeros(1, 36)
    edge[0, 0] = 5.0
    at_edge, _ = classes.read_out(edge, edge, flat[:1], "peak")
    torch.testing.assert_close(at_edge, classes.read_out(edge, edge, flat[:1], "centre")[0])
