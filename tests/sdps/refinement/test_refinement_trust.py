"""What refinement is expected to be worth, and when the start is kept."""

from dataclasses import replace

import numpy as np
import pytest

from sdps.api import make_runner
from sdps.core.estimate import Estimate
from sdps.core.metrics import angle_degrees
from sdps.methods import pretrained
from sdps.methods.parse import parse
from sdps.methods.runner import Runner
from sdps.refinement import refine as refining
from sdps.refinement.image_model import Refined
from sdps.refinement.trust import FEWEST_IMAGES, Trust, trust

SIDE, COUNT = 24, 40


def dome() -> tuple[np.ndarray, np.ndarray]:
    """Return normals (SIDE, SIDE, 3) and mask of a half sphere."""
    y, x = np.mgrid[1 : -1 : SIDE * 1j, -1 : 1 : SIDE * 1j]
    mask = x**2 + y**2 < 0.9
    normals = np.stack([x, y, np.sqrt(np.maximum(1.0 - x**2 - y**2, 0.0))], axis=-1)
    return (normals * mask[..., None]).astype(np.float32), mask


def around(count: int = COUNT) -> np.ndarray:
    """Return lights (count, 3) all around, 40 degrees off the camera."""
    turns = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return np.stack([0.64 * np.cos(turns), 0.64 * np.sin(turns), np.full(count, 0.77)], axis=1).astype(np.float32)


def tilted(vectors: np.ndarray, degrees: float) -> np.ndarray:
    """Return vectors turned about the y axis."""
    sine, cosine = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    return vectors @ np.array([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]], np.float32)


def found(residual: float, lights: np.ndarray) -> Refined:
    normals, mask = dome()
    images = np.full(len(lights), residual, np.float32)
    return Refined(
        normals=normals, light_directions=lights, intensities=np.ones((len(lights), 3)), albedo=normals,
        strength=mask.astype(np.float32), body=np.zeros(4), amplitudes=np.zeros(8), sharpness=np.ones(8),
        modes=np.zeros(6), nearness=np.zeros(len(lights)), image_residual=images,
        pixel_residual=np.where(mask, residual, 0.0).astype(np.float32), used=mask.astype(np.float32),
    )  # fmt: skip


def begun(normals: np.ndarray, lights: np.ndarray, **told: np.ndarray) -> Estimate:
    return Estimate(normals, lights, np.ones(len(lights), np.float32), **told)


def test_more_is_expected_of_a_model_that_fits_and_of_more_images() -> None:
    normals, mask = dome()
    start, lights = tilted(normals, 5.0) * mask[..., None], around()
    good, bad = (trust(found(residual, lights), mask, begun(start, tilted(lights, 5.0))) for residual in (0.015, 0.1))
    assert good.normals[mask].mean() < 0.5 * bad.normals[mask].mean() and good.lights.mean() < 0.5 * bad.lights.mean()
    assert not good.normals[~mask].any() and good.normals.shape == mask.shape and good.lights.shape == (COUNT,)
    few = around(10)
    assert trust(found(0.015, few), mask, begun(start, tilted(few, 5.0))).normals.max() > good.normals.max()
    assert good.doubt == "" and 2.0 < good.start < 10.0


def test_what_the_network_expects_to_be_off_counts() -> None:
    normals, mask = dome()
    lights, start = around(), tilted(normals, 3.0) * mask[..., None]
    sure, unsure = np.full(mask.shape, 2.0, np.float32), np.full(mask.shape, 2.0, np.float32)
    unsure[: SIDE // 2] = 8.0

    def expected(own: np.ndarray, given: bool = False) -> Trust:
        told = begun(start, tilted(lights, 3.0), expected_error=own)
        return trust(found(0.02, lights), mask, told, given=given)

    of_sure, of_unsure, given = expected(sure), expected(unsure), expected(sure, given=True)
    raised = of_unsure.normals[mask] / of_sure.normals[mask]  # everywhere, and most where the network is not sure
    assert (raised > 1.3).all() and (raised[unsure[mask] > 2.0] > 1.5 * raised[unsure[mask] == 2.0].max()).all()
    # It does not decide whether the start is kept, and under lights that are given it already counts that they are.
    assert of_sure.start == of_unsure.start and not expected(20.0 * sure).doubt
    assert given.lights is None  # given is not exact
    np.testing.assert_array_equal(given.normals, of_sure.normals)


@pytest.mark.parametrize(
    ("normals", "lights", "residual", "doubt"),
    [
        ("dome", around(FEWEST_IMAGES - 1), 0.015, "too few"),
        ("dome", around() * np.array([1.0, 0.0, 1.0], np.float32), 0.015, "one plane"),
        ("flat", around(), 0.015, "flat"),
        ("dome", around(), 0.5, "does not explain the photographs"),
    ],
    ids=["few images", "coplanar lights", "flat object", "misfit"],
)
def test_what_cannot_be_trusted_is_doubted(normals: str, lights: np.ndarray, residual: float, doubt: str) -> None:
    curved, mask = dome()
    lights = lights / np.linalg.norm(lights, axis=1, keepdims=True)
    flat_or_not = curved if normals == "dome" else np.where(mask[..., None], np.array([0.0, 0.0, 1.0], np.float32), 0.0)
    start = tilted(flat_or_not, 1.0) * mask[..., None]
    said = trust(found(residual, lights), mask, begun(start, lights)).doubt
    assert doubt in said and "\n" not in said


@pytest.mark.parametrize(("told", "astray"), [(9.0, True), (11.0, False), (None, False)])
def test_lights_that_turn_further_than_the_network_expects_are_not_believed(told: float | None, astray: bool) -> None:
    normals, mask = dome()
    lights = around()
    turned = tilted(lights, 20.0)
    moved = float(angle_degrees(turned, lights).mean())
    errors = {} if told is None else {"expected_light_error": np.full(COUNT, told * moved / 20.0, np.float32)}
    said = trust(found(0.015, turned), mask, begun(tilted(normals, 3.0) * mask[..., None], lights, **errors))
    assert said.void == astray and bool(said.doubt) == astray
    if astray:
        assert f"turned the lights by {moved:.0f} degrees" in said.doubt and "\n" not in said.doubt


@pytest.mark.parametrize("count", [FEWEST_IMAGES - 1, FEWEST_IMAGES], ids=["doubted", "trusted"])
def test_a_doubted_refinement_leaves_what_the_method_found(count: int) -> None:
    normals, mask = dome()
    lights = around(count)
    images = np.maximum(np.einsum("hwc,lc->lhw", normals, lights), 0.0)[..., None].repeat(3, axis=-1).astype(np.float32)
    quick = refining.RefineConfig(coarse_pixels=200, iterations=3, fine_iterations=0)
    runner = Runner(parse("true+least-squares+refine", pretrained.require), pretrained.require, refining=quick)
    estimate = runner.estimate(images, mask, lights, np.ones(count, np.float32))
    start, expected = estimate.start, estimate.trust
    assert isinstance(start, Estimate) and bool(expected.doubt) == (count < FEWEST_IMAGES)
    assert (estimate.normals is start.normals) == bool(expected.doubt)


def test_refinement_is_the_default_where_a_network_finds_the_normals() -> None:
    cases = {("auto", False): True, ("lcnet+psfcn", False): True, ("auto", True): True, ("pf14", False): False}
    for (method, lit), wanted in cases.items():
        runner = make_runner(method, (lit, False), None, None, None, images=FEWEST_IMAGES)
        assert runner.method.refined == wanted, method
    assert not make_runner("lcnet+psfcn", (False, False), None, None, None, images=FEWEST_IMAGES - 1).method.refined
    assert not make_runner("auto", (False, False), None, None, False, images=96).method.refined
    assert make_runner("pf14", (False, False), None, None, True, images=96).method.refined


def test_channels_that_the_object_hardly_reflects_say_little_of_intensities() -> None:
    _, mask = dome()
    of_channels = np.array([[1.0, 2.0, 9.0], [1.0, 2.0, 0.1]], np.float32)
    albedo = np.where(mask[..., None], np.array([0.75, 0.25, 0.0], np.float32), 0.0)
    one = replace(found(0.02, around(2)), intensities=of_channels, albedo=albedo)
    assert np.allclose(one.grey_intensities, 1.25)
