"""Depth from normals: signs, accuracy against analytic surfaces, shapes of masks, steps, and what is refused."""

import numpy as np
import pytest
import scipy.sparse as sparse
from scipy.sparse.linalg import spsolve
from surface_scenes import balls, from_slopes, grid, off_points, plane_before, sphere, sphere_before, waves

from render.shared.errors import InputError
from sdps.core.geometry import Camera
from sdps.core.integration import LARGE, Depth, integrate
from sdps.core.laplacian import laplacian, multigrid, solve


def errors(depth: Depth, truth: np.ndarray) -> np.ndarray:
    """Return |z - truth| (n,) in pixels after each component's mean is taken away."""
    off = depth.z - truth
    for number in range(depth.components):
        off[depth.labels == number] -= off[depth.labels == number].mean()
    return np.abs(off[depth.mask])


@pytest.mark.parametrize("discontinuities", [False, True])
@pytest.mark.parametrize(("slope_x", "slope_y"), [(0.5, 0.0), (0.0, 0.5), (-2.0, 3.0)])
def test_planes_are_exact(slope_x, slope_y, discontinuities):
    x, y = grid(20, 31)
    truth = slope_x * x + slope_y * y
    mask = np.ones(x.shape, bool)
    depth = integrate(from_slopes(slope_x + 0 * x, slope_y + 0 * x), mask, discontinuities=discontinuities)
    assert depth.z.dtype == np.float32
    assert errors(depth, truth).max() < 1e-3
    assert depth.residual < 1e-3


def test_frame():
    mask = np.ones((9, 9), bool)
    right = integrate(from_slopes(np.full((9, 9), 0.5), np.zeros((9, 9))), mask).z
    assert right[4, 8] > right[4, 0]  # nearer to the camera on the right
    up = integrate(from_slopes(np.zeros((9, 9)), np.full((9, 9), 0.5)), mask).z
    assert up[0, 4] > up[8, 4]  # nearer at the top, row 0
    _, normals, mask = sphere(33, 15.0)
    assert integrate(normals, mask).z[16, 16] > 3.0


def test_spheres_are_exact():
    truth, normals, mask = sphere(128, 62.0, 0.95)
    depth = integrate(normals, mask)
    assert errors(depth, truth).max() < 0.01
    assert depth.residual < 0.01
    assert depth.below == 0


def test_whole_hemisphere():
    truth, normals, mask = sphere(128, 62.0)
    off = errors(integrate(normals, mask), truth)
    assert off.mean() < 0.01  # 0.002
    assert off.max() < 1.0  # 0.46, at the rim
    bilateral = errors(integrate(normals, mask, discontinuities=True), truth)
    assert bilateral.mean() < 0.3  # 0.11


def test_paraboloid():
    x, y = grid(80, 100)
    truth = -(x**2 + 0.5 * y**2) / 60
    depth = integrate(from_slopes(-x / 30, -y / 60), np.ones(x.shape, bool))
    assert errors(depth, truth).mean() < 0.02


@pytest.mark.parametrize("discontinuities", [False, True])
@pytest.mark.parametrize("seed", [0, 1])
def test_random_smooth_fields(seed, discontinuities):
    truth, normals = waves(96, seed)
    x, y = grid(96, 96)
    mask = (x**2 + y**2 < 45**2) & ~((x - 10) ** 2 + y**2 < 8**2)  # with a hole
    off = errors(integrate(normals, mask, discontinuities=discontinuities), truth)
    assert off.mean() < 0.02 * truth.std()  # 0.008


def test_noise_stays_bounded():
    truth, normals, mask = sphere(128, 62.0, 0.95)
    noisy = normals + 0.1 * np.random.default_rng(0).normal(size=normals.shape).astype(np.float32)
    depth = integrate(noisy, mask)
    assert errors(depth, truth).mean() < 0.4  # 0.13
    assert 2.0 < depth.residual < 10.0


def test_components_are_centred_and_independent():
    truth, normals, mask = sphere(64, 28.0, 0.9)
    pair, both = np.concatenate([normals, normals], axis=1), np.concatenate([mask, mask], axis=1)
    depth = integrate(pair, both)
    assert depth.components == 2
    assert depth.labels.min() == -1
    for number in range(2):
        assert abs(depth.z[depth.labels == number].mean()) < 1e-4
    assert np.allclose(depth.z[:, :64], integrate(normals, mask).z, atol=1e-3)
    assert errors(depth, np.concatenate([truth, truth + 50], axis=1)).max() < 0.02


def test_thin_parts_and_single_pixels():
    mask = np.zeros((20, 40), bool)
    mask[3, :30] = mask[3:18, 29] = True  # an angle one pixel wide
    mask[10, 5] = mask[12, 7] = mask[13, 8] = True  # alone; diagonal neighbours do not connect
    normals = from_slopes(np.full(mask.shape, 0.3), np.full(mask.shape, -0.7))
    for discontinuities in (False, True):
        depth = integrate(normals, mask, discontinuities=discontinuities)
        x, y = grid(20, 40)
        assert depth.components == 4
        assert errors(depth, 0.3 * x - 0.7 * y).max() < 1e-3
        assert (depth.z[[10, 12, 13], [5, 7, 8]] == 0).all()
        assert (depth.z[~mask] == 0).all()


def test_one_pixel():
    depth = integrate(np.full((1, 1, 3), 1.0), np.ones((1, 1), bool), discontinuities=True)
    assert depth.z.tolist() == [[0.0]]
    assert depth.residual == 0


def test_normals_at_and_beyond_the_horizon():
    truth, normals, mask = sphere(96, 45.0)
    rim = mask & (normals[..., 2] < 0.25)
    normals[rim, 2] = np.where(np.arange(rim.sum()) % 2, -0.02, 0.0)
    depth = integrate(normals, mask)
    assert depth.below == pytest.approx(rim.sum() / mask.sum())
    assert np.isfinite(depth.z).all()
    assert np.abs(depth.z).max() < 200
    inner = mask & (normals[..., 2] > 0.5)
    off = (depth.z - truth)[inner]
    assert np.abs(off - off.mean()).mean() < 1.0


def test_what_lies_outside_the_mask_is_not_read():
    _, normals, mask = sphere(48, 20.0, 0.9)
    expected = integrate(normals, mask).z
    normals[~mask] = np.nan
    assert np.array_equal(integrate(normals, mask).z, expected)


def test_two_steps():
    truth, normals = balls()
    mask = np.ones(truth.shape, bool)
    smooth, bilateral = (integrate(normals, mask, discontinuities=choice) for choice in (False, True))
    assert errors(smooth, truth).mean() > 3.0  # 4.35: smeared
    assert errors(bilateral, truth).mean() < 0.5  # 0.25
    assert bilateral.residual < smooth.residual
    assert 0.002 < bilateral.torn < 0.02
    assert bilateral.iterations > 2
    assert (smooth.torn, smooth.iterations) == (0, 1)


def test_repeatable():
    truth, normals = balls(48, 9.0)
    first, second = (integrate(normals, truth > -99, discontinuities=True) for _ in range(2))
    assert np.array_equal(first.z, second.z)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda n, m: (np.where(m[..., None], np.nan, n), m), "NaN"),
        (lambda n, m: (0 * n, m), "zero"),
        (lambda n, m: (n, m & False), "empty"),
        (lambda n, m: (n[:-1], m), "normals must be"),
        (lambda n, m: (n, m.astype(np.uint8)), "mask bool"),
    ],
)
def test_refusals(change, words):
    _, normals, mask = sphere(24, 10.0)
    with pytest.raises(InputError, match=words) as caught:
        integrate(*change(normals, mask))
    assert "\n" not in str(caught.value)


def test_multigrid_against_a_direct_solve():
    rng = np.random.default_rng(0)
    mask = rng.random((60, 70)) < 0.8
    index = np.full(mask.shape, -1)
    index[mask] = np.arange(mask.sum())
    pairs = [(index[:, :-1], index[:, 1:]), (index[1:], index[:-1])]
    edges = np.concatenate([np.stack([a, b])[:, (a >= 0) & (b >= 0)] for a, b in pairs], axis=1)
    matrix = laplacian(edges, 10 ** rng.uniform(-4, 0, edges.shape[1]), int(mask.sum()))
    shifted = (matrix + sparse.diags_array(np.full(len(index[mask]), 1e-3))).tocsr()
    right = rng.normal(size=matrix.shape[0])
    cycle = multigrid(shifted)
    found, steps = solve(shifted, right, np.zeros_like(right), cycle, tolerance=1e-10)
    assert steps < 150
    expected = spsolve(shifted.tocsc(), right)
    assert np.abs(found - expected).max() < 1e-6 * np.abs(expected).max()
    one, two = rng.normal(size=(2, len(right)))
    assert one @ cycle(two) == pytest.approx(two @ cycle(one))  # symmetric, as conjugate gradients need


@pytest.mark.parametrize("size", [128, 512, pytest.param(1024, marks=pytest.mark.slow)])
def test_a_porous_mask_of_many_components_is_solved(size):
    # Parts that have become single unknowns have rounding errors for a matrix, and every part's mean is free.
    truth, normals, mask = sphere(size, 0.48 * size, 0.95)
    mask &= np.random.default_rng(1).random(mask.shape) < 0.62
    depth = integrate(normals, mask)
    assert depth.components > size
    labels, off = depth.labels[mask], (depth.z - truth)[mask]
    assert np.abs(off - (np.bincount(labels, off) / np.bincount(labels))[labels]).max() < 0.01


@pytest.mark.parametrize("most", [LARGE, 0])
@pytest.mark.parametrize("principal", [None, (30.0, 90.0)])
def test_a_sphere_before_a_pinhole_is_where_it_is(principal, most, monkeypatch):
    monkeypatch.setattr("sdps.core.integration.LARGE", most)
    camera = Camera(1.5 * 128, principal)
    truth, normals, mask = sphere_before(camera, 128, 45.0, (8.0, -5.0, -20.0), 0.97)
    depth = integrate(normals, mask, camera=camera)
    assert depth.camera is camera and depth.components == 1
    off = off_points(camera.positions(depth.z.astype(float)), truth, mask, camera.focal)
    assert off.mean() < 0.01 and off.max() < 0.05
    distant = integrate(normals, mask)
    wrong = off_points(camera.positions(distant.z.astype(float)), truth, mask, camera.focal)
    assert wrong.mean() > 50 * off.mean() and wrong.max() > 1.0
    w = -camera.focal * np.log(1.0 - depth.z[mask].astype(float) / camera.focal)
    assert abs(w.mean()) < 1e-4
    assert integrate(normals, mask, camera=camera, discontinuities=True).below == depth.below == 0


def test_a_slanted_plane_before_a_pinhole_is_flat():
    camera = Camera(150.0)
    truth, normals = plane_before(camera, (80, 100), np.array([-0.5, 0.3, 1.0]))
    mask = np.ones((80, 100), bool)
    for discontinuities in (False, True):
        depth = integrate(normals, mask, camera=camera, discontinuities=discontinuities)
        assert off_points(camera.positions(depth.z.astype(float)), truth, mask, 150.0).max() < 0.02
        assert depth.residual < 0.1
    distant = camera.positions(integrate(normals, mask).z.astype(float))
    assert off_points(distant, truth, mask, 150.0).max() > 5.0


def test_a_very_long_focal_length_is_orthographic():
    _, normals, mask = sphere(64, 29.0, 0.95)
    near = integrate(normals, mask, camera=Camera(1e7)).z
    assert np.allclose(near, integrate(normals, mask).z, atol=1e-3)


def test_the_least_slope_is_that_towards_the_line_of_sight():
    camera = Camera(100.0)
    normals = np.zeros((9, 99, 3), np.float32)
    normals[..., 0], normals[..., 2] = 3.0, 1.0
    x = np.arange(99) - 49.0
    expected = ((1.0 - 0.03 * x) / np.sqrt(10.0) < 0.03).mean()
    assert integrate(normals, np.ones((9, 99), bool), camera=camera).below == pytest.approx(expected)
