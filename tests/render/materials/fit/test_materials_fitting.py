"""The fitter recovers BRDFs that are known in closed form; the metric and the network reader behave."""

import numpy as np
import pytest
from merl_support import glossy

from lab.studies import fit_library, material_models
from lab.studies.fit_library import NetworkFile, half_difference
from render.materials import model
from render.materials.categories import category
from render.materials.fit import fitting, solver, spheres
from render.shared.errors import InputError
from render.shared.seeds import generator


@pytest.fixture(scope="module")
def fitter() -> fitting.Fitter:
    return fitting.Fitter(samples=16_000)


def test_the_fit_recovers_a_known_glossy_brdf(fitter):
    material = fitter.fit("red-phenolic", glossy)
    assert material.category == "phenolic"
    assert material.fit_error < 0.03
    assert material.fit_error == pytest.approx(fitter.error(material, glossy), abs=1e-4)
    assert model.directional_albedo(material, np.linspace(0.02, 1, 20)).max() <= 1


def test_the_fit_of_a_constant_is_the_constant(fitter):
    material = fitter.fit("white-fabric", lambda wi, wo: np.full((len(wi), 3), 0.6 / np.pi))
    assert material.fit_error < 1e-3


def test_gradient_of_the_objective_is_the_derivative_of_the_cost():
    rng = generator(0, "test")
    samples = spheres.fitting_samples(1500, rng)
    channel = solver.Channel(
        solver.basis(samples.wi, samples.wo), glossy(samples.wi, samples.wo)[:, 0], samples.weight, 1e-4
    )
    p = channel.start() + 0.1 * rng.normal(size=len(channel.start()))
    _, gradient = channel.normal_equations(p)
    direction = rng.normal(size=len(p))
    step = 1e-6
    numeric = (channel.cost(p + step * direction) - channel.cost(p - step * direction)) / (2 * step)
    assert 2 * gradient @ direction == pytest.approx(numeric, rel=1e-4)


def test_weighted_samples_integrate_as_the_sphere_does():
    samples = spheres.fitting_samples(40_000, generator(0, "weights"))
    image = spheres.sphere_image(64, spheres.hemisphere_lights(200, generator(1, "weights")))
    sphere = samples.weight[: len(samples.weight) * 3 // 4], samples.wi[: len(samples.weight) * 3 // 4]
    assert np.average(sphere[1][:, 2], weights=sphere[0]) == pytest.approx(image.wi[:, 2].mean(), rel=0.02)


def test_sphere_error_is_zero_for_equality_and_ignores_what_is_clipped():
    samples = spheres.sphere_image(48, np.array([[0, 0, 1.0]]))
    reference = np.full((len(samples.wi), 3), 0.2)
    assert spheres.sphere_error(reference, reference, samples) == 0
    assert spheres.sphere_error(0.9 * reference, reference, samples) == pytest.approx(0.1, rel=0.02)
    mirror = reference.copy()
    mirror[np.argmax(samples.wi[:, 2])] = 1e4
    brighter = np.where(mirror > 1, 2 * mirror, mirror)
    assert spheres.sphere_error(brighter, mirror, samples) == 0


def test_sphere_normals_follow_the_frame():
    mask, normals = spheres.sphere_normals(33)
    image = np.zeros((33, 33, 3))
    image[mask] = normals
    assert image[16, 0, 0] < -0.9 and image[0, 16, 1] > 0.9 and image[16, 16] == pytest.approx([0, 0, 1])


def test_exchanging_the_vectors_turns_the_difference_vector_half_round():
    rng = np.random.default_rng(0)
    wi, wo = (spheres.hemisphere_lights(200, rng) for _ in range(2))
    wo = rng.permutation(wo)
    half, difference = half_difference(wi, wo)
    same, exchanged = half_difference(wo, wi)
    np.testing.assert_allclose(half, same, atol=1e-12)
    np.testing.assert_allclose(difference * [-1, -1, 1], exchanged, atol=1e-7)


def network_file(path, drop: str = "") -> None:
    """Write a small random network under the name of a MERL material."""
    rng = np.random.default_rng(3)
    shapes = {"fc1": (6, 21), "b1": (21,), "fc2": (21, 21), "b2": (21,), "fc3": (21, 3), "b3": (3,)}
    layers = {f"merl__nylon__{key}": 0.3 * rng.normal(size=shape) for key, shape in shapes.items() if key != drop}
    np.savez(path, **layers)


def test_the_command_line_fits_a_network_file(tmp_path, capsys):
    network_file(tmp_path / "weights.npz")
    brdf = NetworkFile(tmp_path / "weights.npz").brdf("nylon")
    wi, wo = (spheres.hemisphere_lights(50, np.random.default_rng(seed)) for seed in (1, 2))
    np.testing.assert_allclose(brdf(wi, wo), brdf(wo, wi), rtol=1e-9)
    assert fit_library.main(["--networks", str(tmp_path / "weights.npz"), "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "nylon.yaml").exists()
    assert "1 materials" in capsys.readouterr().out


def test_the_command_line_explains_mistakes(tmp_path, capsys):
    network_file(tmp_path / "weights.npz")
    network_file(tmp_path / "broken.npz", drop="b2")
    (tmp_path / "text.npz").write_text("no")
    good = ["--networks", str(tmp_path / "weights.npz"), "--out", str(tmp_path)]
    for arguments, message in (
        ([*good, "--only", "nylom"], "did you mean 'nylon'"),
        (["--networks", str(tmp_path / "broken.npz"), "--out", str(tmp_path)], "merl__nylon__b2"),
        (["--networks", str(tmp_path / "text.npz"), "--out", str(tmp_path)], "cannot be read"),
    ):
        assert fit_library.main(arguments) == 2
        assert message in capsys.readouterr().err


def test_the_models_of_the_study_recover_their_own_form():
    samples = spheres.fitting_samples(3000, generator(0, "candidates"))
    at, target = material_models.angles(samples.wi, samples.wo), glossy(samples.wi, samples.wo)
    fit = material_models.fit_two_ggx(target, material_models.residual_weight(target, samples), at)
    test = spheres.sphere_image(48, spheres.hemisphere_lights(5, generator(1, "candidates")))
    value = fit(material_models.angles(test.wi, test.wo))
    assert spheres.sphere_error(value, glossy(test.wi, test.wo), test) < 0.02


def test_the_study_explains_missing_constants(tmp_path):
    for text, message in (('{"abc": {"nylon": []}, "sgd": {}}', "no constants for 'nylon'"), ("no", "expected JSON")):
        (tmp_path / "published.json").write_text(text)
        with pytest.raises(InputError, match=message):
            material_models.read_published(tmp_path / "published.json", ["nylon"])


def test_categories_of_names():
    assert category("blue-metallic-paint2") == "metallic-paint" and category("pearl-paint") == "paint"
    assert category("dark-specular-fabric") == "fabric" and category("something") == "other"
