"""The reflectance model and the library: physics, names, and the errors a user can meet."""

import dataclasses

import numpy as np
import pytest

from render.materials import library, model
from render.materials.fit.fitting import conserve_energy, to_yaml
from render.shared.errors import InputError
from render.shared.files import write_text


def hemisphere(count: int, seed: int) -> np.ndarray:
    """Return (count, 3) directions uniform in projected solid angle."""
    rng = np.random.default_rng(seed)
    radius, azimuth = np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.sqrt(1 - radius**2)], 1)


def mirrored(directions: np.ndarray, spread: float) -> np.ndarray:
    """Return directions near the mirror direction of `directions`, `spread` in radians."""
    noise = np.random.default_rng(7).normal(scale=spread, size=directions.shape)
    near = directions * [-1, -1, 1] + noise
    return near / np.linalg.norm(near, axis=1, keepdims=True)


def test_the_library_has_the_hundred_merl_materials_and_the_groups_of_the_paper():
    groups = library.categories()
    assert len(library.names()) == 100 and library.names() == sorted(library.names())
    assert {key: len(groups[key]) for key in ("fabric", "plastic", "phenolic")} == {
        "fabric": 12,
        "plastic": 9,
        "phenolic": 12,
    }
    assert sorted(name for group in groups.values() for name in group) == library.names()
    assert "other" not in groups


def test_fit_errors_of_the_library_meet_the_aim():
    errors = np.array([library.load(name).fit_error for name in library.names()])
    assert (errors > 0).all()
    assert (errors <= 0.10).sum() >= 80 and (errors <= 0.20).sum() >= 95


@pytest.mark.parametrize("name", ["chrome", "pink-fabric", "red-phenolic", "lambertian:0.8/0.3/0.1"])
def test_brdf_is_reciprocal_non_negative_and_isotropic(name):
    material, wi = library.load(name), hemisphere(2000, 1)
    wo = np.concatenate([hemisphere(1000, 2), mirrored(wi[1000:], 0.01)])
    value = model.evaluate(material, wi, wo)
    assert (value >= 0).all()
    np.testing.assert_allclose(value, model.evaluate(material, wo, wi), rtol=1e-9)
    turn = np.array([[np.cos(1.0), -np.sin(1.0), 0], [np.sin(1.0), np.cos(1.0), 0], [0, 0, 1]])
    np.testing.assert_allclose(value, model.evaluate(material, wi @ turn.T, wo @ turn.T), rtol=1e-6)


def test_brdf_vanishes_below_the_horizon():
    up, down = np.array([[0.0, 0, 1]]), np.array([[0.6, 0, -0.8]])
    material = library.load("chrome")
    assert not model.evaluate(material, up, down).any() and not model.evaluate(material, down, up).any()


def test_no_material_of_the_library_reflects_more_light_than_it_receives():
    cosine = np.array([0.01, 0.1, 0.3, 0.6, 1.0])
    for name in library.names():
        albedo = model.directional_albedo(library.load(name), cosine, points=3, azimuths=48)
        assert albedo.max() <= 1.0, name
        assert albedo.min() > 0, name


def test_directional_albedo_agrees_with_monte_carlo():
    material, wo = library.load("gold-metallic-paint"), hemisphere(400_000, 3)
    wi = np.broadcast_to([np.sqrt(1 - 0.49), 0, 0.7], wo.shape)
    estimate = np.pi * model.evaluate(material, wi, wo).mean(0)
    np.testing.assert_allclose(model.directional_albedo(material, np.array([0.7]))[0], estimate, rtol=0.02)


def test_lambertian_is_exact():
    wi, wo = hemisphere(500, 4), hemisphere(500, 5)
    value = model.evaluate(library.load("lambertian:0.8/0.3/0.1"), wi, wo)
    np.testing.assert_allclose(value, np.broadcast_to(np.array([0.8, 0.3, 0.1]) / np.pi, value.shape), rtol=1e-12)
    gray = library.load("lambertian:0.5")
    np.testing.assert_allclose(model.evaluate(gray, wi, wo), 0.5 / np.pi, rtol=1e-12)
    np.testing.assert_allclose(model.directional_albedo(gray, np.array([0.2, 0.5, 1.0])), 0.5, rtol=2e-3)


def test_half_coordinate_resolves_the_peak_and_inverts_the_knots():
    knots = model.half_knots()
    np.testing.assert_allclose(model.half_coordinate(knots), np.linspace(0, 1, model.HALF_KNOTS), atol=1e-12)
    angle = np.degrees(np.arccos(1 - knots))
    assert angle[1] < 0.05 and (angle < 1).sum() >= 5 and angle[-1] == pytest.approx(90)


def test_conserve_energy_lowers_only_what_is_too_bright():
    bright = dataclasses.replace(model.lambertian(1.0), shadowing=np.tile(np.linspace(1, 3, 9), (3, 1)))
    tamed = conserve_energy(bright)
    assert model.directional_albedo(bright, np.array([0.1])).max() > 1
    assert model.directional_albedo(tamed, np.linspace(0.02, 1, 40)).max() <= 1.0
    dim = library.load("blue-rubber")
    assert conserve_energy(dim) is dim


def test_yaml_round_trip(tmp_path):
    material = library.load("steel")
    write_text(tmp_path / "copy.yaml", to_yaml(material))
    copy = library.load(tmp_path / "copy.yaml")
    for field in dataclasses.fields(material):
        np.testing.assert_array_equal(getattr(copy, field.name), getattr(material, field.name))
    assert not copy.bivariate.flags.writeable


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("crome", "did you mean 'chrome'"),
        ("pink-fabrik", "pink-fabric"),
        ("lambertian:0", r"\(0, 1\]"),
        ("lambertian:1.2", r"\(0, 1\]"),
        ("lambertian:0.5/0.5", "lambertian:0.8/0.3/0.1"),
        ("lambertian", "lambertian:0.5"),
        ("lambertian:nan", r"\(0, 1\]"),
        ("missing.yaml", "no such file"),
    ],
)
def test_bad_names_are_explained(name, message):
    with pytest.raises(InputError, match=message):
        library.load(name)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("model: 1", "model: 9", "model"),
        ("shadowing:", "shadow:", r"shadow.*did you mean"),
        ("category: metal", "category: metal\nroughness: 0.1", "roughness"),
        ("- [1, ", "- [-1, ", r"shadowing: values must be >= 0"),
        ("- [1, ", "- [.nan, ", r"shadowing: every value must be finite"),
        ("- [1, ", "- [1, 1, ", r"shadowing: expected"),
        ("- [1, ", "- [one, ", r"shadowing: expected numbers"),
        ("- [1, ", "- [80, ", r"more light than it receives"),
    ],
)
def test_bad_files_are_explained_by_file_and_field(tmp_path, old, new, message):
    text = to_yaml(library.load("nickel"))
    assert old in text
    path = tmp_path / "mine.yaml"
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=message) as caught:
        library.load(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
