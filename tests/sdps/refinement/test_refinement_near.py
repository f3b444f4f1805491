"""Near lamps and perspective in refinement: nearness that is found or known, lines of sight, the grid."""

import numpy as np
import pytest
import torch

from render.shared.imaging.vectors import unit
from sdps.core.first_normals import turn_to_sight
from sdps.core.geometry import ORTHOGRAPHIC, Camera, Capture, Rig, reach
from sdps.core.metrics import angle_degrees
from sdps.refinement.descent import Problem, Weights, solve
from sdps.refinement.image_model import Refined
from sdps.refinement.refine import RefineConfig, build_start, refine
from sdps.refinement.shape.priors import find_neighbours, measure_curl
from sdps.refinement.sites import Grid, Sites

QUICK = RefineConfig(coarse_pixels=700, iterations=500, iterations_before=250, fine_iterations=0)


def ball(side: int = 48, camera: Camera = ORTHOGRAPHIC) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return normals, mask and heights of a sphere of 0.95 half widths, whose heights are 0 on average."""
    radius = 0.95 * side / 2
    points = camera.image_points((side, side))
    towards = -camera.sights((side, side)) if camera.is_perspective else np.broadcast_to([0.0, 0, -1], (side, side, 3))
    start = np.concatenate([points, np.zeros((side, side, 1))], axis=-1)
    # The nearer of the two points where the line of sight meets the sphere about the origin.
    a, b, c = (towards**2).sum(-1), (start * towards).sum(-1), (start**2).sum(-1) - radius**2
    inside = b**2 - a * c
    mask = inside > 0.02 * radius**2
    along = np.where(mask, (-b - np.sqrt(np.maximum(inside, 0))) / a, 0.0)
    normals = (start + along[..., None] * towards) / radius
    depth = np.where(mask, radius * normals[..., 2], 0.0)
    return normals * mask[..., None], mask, depth


def photograph(
    normals: np.ndarray, mask: np.ndarray, heights: np.ndarray, nearness: np.ndarray, camera: Camera = ORTHOGRAPHIC
) -> tuple[np.ndarray, np.ndarray]:
    """Return images (L, H, W, 3) of a matte object under lamps seen from its middle, and their directions."""
    lights = hemisphere(len(nearness), 0.5, np.random.default_rng(3))
    places = Capture.of(mask, camera).places(heights)[mask]
    ways, falloff = reach(places, lights, nearness)
    shade = np.maximum((ways * normals[mask][:, None]).sum(-1), 0.0) * falloff
    images = np.zeros((len(nearness), *mask.shape, 3), np.float32)
    images[:, mask] = shade.T[..., None] * [0.7, 0.5, 0.3]
    return images, lights


def centred(heights: np.ndarray, mask: np.ndarray) -> np.ndarray:
    return np.where(mask, heights - heights[mask].mean(), 0.0)


def errors(found: Refined, normals: np.ndarray, mask: np.ndarray, lights: np.ndarray) -> tuple[float, float]:
    of_normals = float(angle_degrees(found.normals[mask], normals[mask]).mean())
    return of_normals, float(angle_degrees(found.light_directions, lights).mean())


def test_a_matte_ball_tells_how_near_its_lamps_stand() -> None:
    """Its own reflectance could explain much of what near lamps do to a ball; the rest is enough."""
    normals, mask, heights = ball()
    images, lights = photograph(normals, mask, centred(heights, mask), np.full(30, 0.2))
    off = []
    for known in (np.zeros(30), None):  # started as distant
        found = refine(images, mask, normals, lights, np.ones(30), config=QUICK, rig=Rig(nearness=known))
        off.append(errors(found, normals, mask, lights))
    assert found.nearness == pytest.approx(0.2, rel=0.02)
    assert off[0][0] > 2.0 and off[1][0] < 1.0  # 2.8 and 0.7
    assert off[0][1] > 2.5 and off[1][1] < 0.8  # 3.7 and 0.4


def test_distant_lamps_stay_distant() -> None:
    normals, mask, heights = ball()
    images, lights = photograph(normals, mask, centred(heights, mask), np.zeros(30))
    found, known = (
        refine(images, mask, normals, lights, np.ones(30), config=QUICK, rig=rig)
        for rig in (Rig(), Rig(nearness=np.zeros(30)))
    )
    assert not found.nearness.any()
    np.testing.assert_array_equal(found.normals, known.normals)  # and cost nothing


@pytest.mark.parametrize(
    ("near", "told", "kept"),
    [(0.97, 0.0, True), (0.99, 0.0, False), (1.03, 0.05, False), (1.03, 0.1, True), (1.06, 0.1, False)],
)
def test_near_lamps_must_explain_clearly_more_unless_a_network_finds_them_near(
    near: float, told: float, kept: bool, monkeypatch
) -> None:
    normals, mask, heights = ball()
    images, lights = photograph(normals, mask, centred(heights, mask), np.full(12, 0.1))
    answers = iter((near, 1.0))
    monkeypatch.setattr("sdps.refinement.refine.measure_fit", lambda *_: next(answers))
    few = RefineConfig(coarse_pixels=300, iterations=3, iterations_before=2, fine_iterations=0)
    found = refine(images, mask, normals, lights, np.ones(12), config=few, nearness=np.full(12, told))
    assert found.nearness.any() == kept


def test_lamps_that_are_known_stay_where_they_are() -> None:
    normals, mask, heights = ball()
    nearness = np.linspace(0.1, 0.3, 20)
    images, lights = photograph(normals, mask, centred(heights, mask), nearness)
    found = refine(images, mask, normals, lights, np.ones(20), config=QUICK, rig=Rig(nearness=nearness))
    assert found.nearness == pytest.approx(nearness, rel=1e-5)
    assert max(errors(found, normals, mask, lights)) < 1.4  # 0.9; taken for distant, about four


def test_each_lamp_of_a_hand_has_a_distance_of_its_own() -> None:
    normals, mask, heights = ball()
    nearness = 0.2 * np.exp(0.2 * np.random.default_rng(5).standard_normal(30))
    images, lights = photograph(normals, mask, centred(heights, mask), nearness)
    gaps = []
    for each in (False, True):
        found = refine(images, mask, normals, lights, np.ones(30), config=QUICK, rig=Rig(each=each))
        gaps.append(np.log(found.nearness / nearness))
        assert np.ptp(found.nearness) > 0.05 or not each
    assert gaps[1].std() < 0.5 * gaps[0].std()


def test_what_a_pinhole_sees_of_a_surface_has_no_curl() -> None:
    camera, mask = Camera(70.0), np.ones((48, 48), bool)
    x, y = np.moveaxis(camera.image_points(mask.shape), -1, 0)
    points = camera.positions(5 * np.sin(x / 9) * np.cos(y / 11) + 0.3 * x)
    down, across = np.gradient(points, axis=(0, 1))
    normals = np.cross(across, -down)  # rows run down
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    near, inside = find_neighbours(mask), torch.from_numpy(normals[mask].astype(np.float32))
    sights = torch.from_numpy(camera.sights(mask.shape)[mask].astype(np.float32))
    # The measure is a thousandth where there is none.
    assert float(measure_curl(inside, near, sights)) < 0.0011 and float(measure_curl(inside, near)) > 0.002


def test_what_is_turned_as_a_whole_is_refined_alike() -> None:
    """Also near the rim, where normals that the camera sees may point away from its axis."""
    rng, mask = np.random.default_rng(2), np.ones((6, 6), bool)
    normals, lights = hemisphere(36, 0.15, rng), hemisphere(12, 0.5, rng)
    shade = np.maximum(unit(normals + rng.normal(0.0, 0.1, normals.shape)) @ lights.T, 0.02)  # not of the start
    images = torch.from_numpy(shade[:, None] * np.ones((1, 3, 1))).float()
    weights, found = Weights(curl=(1e-9, 1e-9)), []
    sights = torch.tensor([[1.2, 0.3, 1.0]]).expand(36, 3)
    sites = Sites(torch.zeros(36, 3), sights, turn_to_sight(sights))
    for place, turn in ((None, np.eye(3)), (sites, sites.turns[0].numpy().astype(float))):
        problem = Problem(mask, images, torch.ones(36, 12), sites=place)
        state = build_start(problem, normals @ turn, lights @ turn, np.ones((12, 3)), np.zeros(12))
        moved = solve(problem, state, free=frozenset({"normals"}), iterations=800, boost=1.0, weights=weights)
        found.append((moved.normals.numpy() @ turn.T, (normals @ turn)[:, 2]))
    assert found[1][1].min() < -0.3
    assert angle_degrees(found[0][0], normals).max() > 5.0
    assert angle_degrees(found[1][0], found[0][0]).max() < 3.0  # 1.1; 29 where z is taken for the line of sight


def hemisphere(count: int, lowest: float, rng: np.random.Generator) -> np.ndarray:
    """Return unit vectors (N, 3) at least so far up."""
    around, up = rng.uniform(0, 2 * np.pi, count), rng.uniform(lowest, 1.0, count)
    out = np.sqrt(1 - up**2)
    return np.stack([out * np.cos(around), out * np.sin(around), up], axis=-1)


def test_the_grid_lies_where_the_whole_picture_does() -> None:
    _, mask, heights = ball(camera=Camera(70.0))
    grid = Grid(Capture.of(mask, Camera(70.0)), mask, 3)
    few = heights[::3, ::3] / 3
    which = grid.which
    found = grid.sites(few)
    places = grid.capture.places(heights)[which]
    np.testing.assert_allclose(found.places.numpy(), places, atol=1e-5)
    sights = grid.capture.camera.sights(mask.shape)[which]
    np.testing.assert_allclose(found.sights.numpy(), sights, atol=1e-6)
    ahead = np.einsum("pij,pj->pi", found.turns.numpy(), sights / np.linalg.norm(sights, axis=1, keepdims=True))
    np.testing.assert_allclose(ahead, np.tile([0.0, 0.0, 1.0], (len(ahead), 1)), atol=1e-6)
