"""Large objects: depth on the grid itself, thinned meshes, shadows and views, work in parts."""

import numpy as np
import pytest
from classical_scenes import lambertian, lights
from classical_scenes import sphere as shaded_sphere
from surface_scenes import balls, grid, sphere, waves

from sdps.core import integration, metrics
from sdps.core.integration import integrate
from sdps.surface import meshing, relight, views
from sdps.surface.meshing import mesh, step_of
from sdps.surface.relight import fit_albedo, relit, residuals, trace_light


def fields() -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Return normals and masks: smooth, with jumps, of many parts, noisy, and of odd sides."""
    rng = np.random.default_rng(0)
    wavy = waves(180, 1)[1]
    noisy = wavy + rng.normal(0, 0.2, wavy.shape)
    noisy[..., 2] = np.abs(noisy[..., 2]) + 0.02
    x, y = grid(173, 201)
    ring = (np.hypot(x, y) < 80) & (np.hypot(x, y) > 30) & ~((np.abs(x) < 2) & (y > 0))
    return [
        ("waves", wavy, np.ones((180, 180), bool)),
        ("jumps", balls(150, 28.0)[1], np.ones((150, 150), bool)),
        ("parts", wavy, rng.random((180, 180)) < 0.7),
        ("noise", noisy, np.hypot(*grid(180, 180)) < 85),
        ("ring", np.pad(wavy, ((0, 0), (0, 21), (0, 0)), mode="edge")[:173], ring),
        ("sphere", *sphere(200, 95.0, 0.999)[1:]),
        ("line", wavy, np.eye(180, dtype=bool) | np.eye(180, k=1, dtype=bool)),
    ]


@pytest.mark.parametrize("case", fields(), ids=lambda case: case[0])
@pytest.mark.parametrize("discontinuities", [False, True])
def test_the_grid_gives_what_the_graph_gives(case: tuple, discontinuities: bool, monkeypatch) -> None:
    _, normals, mask = case
    monkeypatch.setattr("sdps.core.large_depth._COARSE", 2**11)  # so that there are several levels
    graph = integrate(normals, mask, discontinuities=discontinuities)
    monkeypatch.setattr(integration, "LARGE", 0)
    found = integrate(normals, mask, discontinuities=discontinuities)
    # Weights that change are settled to a thousandth only.
    near = 0.04 if discontinuities else 2e-4
    assert np.percentile(np.abs(found.z - graph.z)[mask], 95) < near * max(1.0, np.ptp(graph.z[mask]) / 50)
    assert not found.z[~mask].any() and found.z.dtype == np.float32
    assert found.components == graph.components and np.array_equal(found.labels, graph.labels)
    assert found.residual == pytest.approx(graph.residual, rel=0.03 if discontinuities else 1e-4, abs=1e-3)
    assert np.percentile(np.abs(found.residuals - graph.residuals), 95) < (0.3 if discontinuities else 0.01)
    assert found.below == pytest.approx(graph.below) and found.torn == pytest.approx(graph.torn, abs=2e-3)


def test_the_grid_does_not_depend_on_the_threads_and_few_steps_suffice(monkeypatch) -> None:
    import numba

    _, normals = waves(220, 3)
    mask = np.ones((220, 220), bool)
    monkeypatch.setattr(integration, "LARGE", 0)
    monkeypatch.setattr("sdps.core.large_depth._COARSE", 2**11)
    counted: list[int] = []
    plain = integration.solve_grid
    monkeypatch.setattr(integration, "solve_grid", lambda *a, **k: counted.append(plain(*a, **k)))
    first = integrate(normals, mask).z
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        np.testing.assert_array_equal(integrate(normals, mask).z, first)
    finally:
        numba.set_num_threads(before)
    assert max(counted) < 60


def test_unusable_normals_of_large_objects_are_refused_as_well(monkeypatch) -> None:
    monkeypatch.setattr(integration, "LARGE", 0)
    normals = np.zeros((40, 50, 3), np.float32)
    normals[..., 2] = 1.0
    normals[20, 30] = np.nan
    with pytest.raises(integration.InputError, match="NaN or infinite"):
        integrate(normals, np.ones((40, 50), bool))


def test_a_mesh_of_every_third_pixel_lies_on_the_mesh_of_all(monkeypatch) -> None:
    _, normals, mask = sphere(100, 40.0, 0.95)
    depth = integrate(normals, mask)
    whole, thin = mesh(depth, normals=normals), mesh(depth, normals=normals, every=3)
    assert len(thin.vertices) == pytest.approx(len(whole.vertices) / 9, rel=0.1)
    places = {tuple(np.round(vertex, 5)) for vertex in whole.vertices}
    assert all(tuple(np.round(vertex, 5)) in places for vertex in thin.vertices)
    assert step_of(mask) == 1
    monkeypatch.setattr(meshing, "MOST_VERTICES", 1000)
    assert step_of(mask) == 3 and len(mesh(depth, every=step_of(mask)).vertices) <= 1000


def test_shadows_of_large_objects_are_those_of_small_ones(monkeypatch) -> None:
    z = np.zeros((240, 320), np.float32)
    z[60:180, 150:170] = 40.0
    flat = np.zeros((240, 320, 3), np.float32)
    flat[..., 2] = 1.0
    depth = integrate(flat, np.hypot(*grid(240, 320)) < 150)
    object.__setattr__(depth, "z", np.where(depth.mask, z, 0.0).astype(np.float32))
    for light in ((1.0, 0.0, 1.0), (-0.5, 0.6, 0.5), (0.0, 0.0, 1.0)):
        monkeypatch.setattr(relight, "_TRACED", 2**20)
        whole = trace_light(depth, np.array(light))
        monkeypatch.setattr(relight, "_TRACED", 6000)  # every fourth pixel
        assert (trace_light(depth, np.array(light)) != whole).mean() < 0.02
        assert not trace_light(depth, np.array(light))[~depth.mask].any()


def test_work_in_parts_is_the_whole_work(monkeypatch) -> None:
    normals, mask = shaded_sphere(64)
    albedo = np.random.default_rng(0).uniform(0.1, 0.9, (*mask.shape, 3))
    scene = lambertian(normals, mask, lights(12), albedo=albedo, intensities=np.linspace(0.5, 2, 12))
    arguments = scene.images, scene.mask, scene.normals, scene.lights, scene.intensities

    def everything() -> list[np.ndarray]:
        found = fit_albedo(*arguments)
        left = residuals(*arguments, found)
        angles = metrics.angle_degrees(normals[mask], np.roll(normals[mask], 1, axis=0))
        return [found, left.pixels, left.images, relit(normals, found, np.array([0.3, 0.2, 0.9])), angles]

    whole = everything()
    monkeypatch.setattr(relight, "_PART", 300)
    monkeypatch.setattr(metrics, "_PART", 300)
    for part, one in zip(everything(), whole, strict=True):
        np.testing.assert_allclose(part, one, rtol=1e-5, atol=1e-6)


def test_views_of_large_objects_are_thinned(monkeypatch) -> None:
    _, normals, mask = sphere(400, 190.0, 0.95)
    depth = integrate(normals, mask)
    plain, sides = views._of_the_box, []

    def all_of_it(depth, colour, side):
        sides.append(plain(depth, colour, side)[0].mask.shape[0])
        return plain(depth, colour, 10**6)

    thin = views.turned(depth, 30.0, 24)
    monkeypatch.setattr(views, "_of_the_box", all_of_it)
    assert np.abs(thin.astype(float) - views.turned(depth, 30.0, 24)).mean() < 6.0
    assert sides[0] < 140


def test_bands_of_images_are_the_whole_images(monkeypatch) -> None:
    normals, mask = shaded_sphere(64)
    scene = lambertian(normals, mask, lights(9), albedo=0.6, intensities=np.linspace(0.5, 2, 9))
    noise = 0.02 * np.random.default_rng(0).random(scene.images.shape, np.float32)  # residuals are not rounding alone
    arguments = scene.images + noise, scene.mask, scene.normals, scene.lights, scene.intensities
    whole = fit_albedo(*arguments)
    left = residuals(*arguments, whole)
    monkeypatch.setattr(relight, "_BAND", 640)  # ten rows
    # To rounding: how a product is summed depends on its size on some processors.
    np.testing.assert_allclose(fit_albedo(*arguments), whole, rtol=3e-7)
    cut = residuals(*arguments, whole)
    np.testing.assert_allclose(cut.pixels, left.pixels, atol=2e-7)
    np.testing.assert_allclose(cut.images, left.images, rtol=1e-6)
    assert cut.overall == pytest.approx(left.overall, rel=1e-6)
