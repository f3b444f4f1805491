"""Light mixed from a stage against what integrals of Lambert's cosine give."""

import numpy as np
import pytest

from render.planning import light_sets
from render.shared.errors import InputError
from render.shared.imaging import environments, mixing
from render.shared.imaging.mixing import LightMix, LightStage, mix
from render.shared.seeds import generator

LIGHTS = light_sets.load("stage:256")
STAGE = LightStage(LIGHTS, "test")


def patches(normals: np.ndarray) -> np.ndarray:  # (L, P, 3) white Lambertian under irradiance pi
    return np.repeat(np.maximum(LIGHTS @ np.asarray(normals, float).T, 0)[..., None], 3, axis=2).astype(np.float32)


def tilted(degrees: float, turn: float = 0.0) -> list[float]:
    angle, turn = np.radians(degrees), np.radians(turn)
    return [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)]


def test_a_constant_environment_gives_irradiance_over_pi():
    """Facing the camera 1; tilted by t the part of the hemisphere above the horizon gives (1 + cos t) / 2."""
    weights = STAGE.under(environments.load("constant"))[None]
    np.testing.assert_allclose(weights.sum(1), 2.0, rtol=1e-3)  # 2 pi steradians / pi
    for degrees in (0, 20, 45, 70, 90):
        normals = [tilted(degrees, turn) for turn in (0, 90, 180, 270)]
        found = mix(patches(normals), weights)[0]
        np.testing.assert_allclose(found, (1 + np.cos(np.radians(degrees))) / 2, rtol=0.01)


def test_a_bright_pixel_lights_what_faces_it():
    """One pixel of radiance R and solid angle s gives R s cos / pi, from its side of the frame."""
    for direction, lit, dark in (((0.6, 0.0, 0.8), tilted(40), tilted(60, 180)),
                                 ((0.0, 0.6, 0.8), tilted(40, 90), tilted(60, 270))):  # fmt: skip
        radiance = np.zeros((64, 128, 3), np.float32)
        row, column = np.unravel_index((environments.directions(64) @ direction).argmax(), (64, 128))
        radiance[row, column] = [50.0, 100.0, 150.0]
        light = environments.directions(64)[row, column]
        found = mix(patches([lit, dark]), STAGE.under(radiance)[None])[0]
        expected = radiance[row, column] * environments.solid_angles(64)[row] / np.pi * (light @ lit)
        np.testing.assert_allclose(found[0], expected, rtol=0.12)  # the nearest light, up to 6 degrees off
        assert (found[1] < 0.3 * found[0]).all()


def test_smooth_light_is_exact_to_a_per_cent():
    """E = 1 + x/2: a patch facing +x at 45 degrees, integrated on a fine grid of directions."""
    vectors = environments.directions(256)
    radiance = np.repeat(1 + vectors[..., :1] / 2, 3, axis=2).astype(np.float32)
    normal = np.array(tilted(45))
    cosine = np.maximum(vectors @ normal, 0) * (vectors[..., 2] > 0)
    exact = (radiance[..., 0] * cosine * environments.solid_angles(256)).sum() / np.pi
    assert mix(patches([normal]), STAGE.under(radiance)[None])[0, 0, 0] == pytest.approx(exact, rel=0.01)
    mirrored = mix(patches([normal]), STAGE.under(radiance[:, ::-1])[None])[0, 0, 0]
    assert abs(mirrored / exact - 1) > 0.2  # a mirrored map is noticed


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_black_pixels_are_left_out_and_change_no_other(dtype: type) -> None:
    """Some pixels black under all lights, some under a few, or in one channel, or all of them; against a plain sum."""
    rng = generator(0, "test")
    images = rng.uniform(0.1, 2.0, (5, 40, 3)).astype(dtype)
    images[:, 10:30] = 0
    images[2:, 5] = images[:, 6, 1] = 0
    weights = rng.uniform(0.0, 1.0, (2, 5, 3)).astype(np.float32)
    expected = np.einsum("lpc,qlc->qpc", images.astype(np.float64), weights)
    np.testing.assert_allclose(mix(images, weights), expected, rtol=1e-6)
    np.testing.assert_array_equal(mix(images[:, ::2], weights), mix(images, weights)[:, ::2])
    assert not mix(np.zeros_like(images), weights).any()


def test_discs_lie_around_their_centre_and_sum_to_one():
    for degrees in (0.0, 3.0, 15.0, 40.0):
        weights = STAGE.disc(np.array(tilted(30, 50)), degrees)
        assert weights.sum() == pytest.approx(1) and weights.min() >= 0
        reached = np.degrees(np.arccos(np.clip(LIGHTS[weights > 0] @ tilted(30, 50), -1, 1)))
        assert reached.max() < degrees + 9
    even = STAGE.disc(np.array([0.0, 0.0, 1.0]), 40.0)
    assert mix(patches([[0, 0, 1]]), np.repeat(even[None, :, None], 3, 2))[0, 0, 0] == pytest.approx(
        (1 - np.cos(np.radians(40)) ** 2) / 2 / (1 - np.cos(np.radians(40))), rel=0.01
    )


def test_mixtures_repeat_and_have_the_kinds_asked_for():
    def draw(config: LightMix, seed: int = 0):
        return config.draw(STAGE, 200, generator(seed, "mix"))

    weights, recipes = draw(LightMix())
    np.testing.assert_allclose(weights.mean(2).sum(1), 1, rtol=1e-5)
    assert np.array_equal(weights, draw(LightMix())[0]) and not np.array_equal(weights, draw(LightMix(), 1)[0])
    kinds = [{light["kind"] for light in recipe["lights"]} for recipe in recipes]
    for kind, share in (("environment", 0.6), ("directional", 0.5), ("lamp", 0.3), ("area", 0.3)):
        # An image without light gets one of them: the share is a little higher.
        assert share - 0.1 < np.mean([kind in found for found in kinds]) < share + 0.17
    only = LightMix(environment=0, directional=1, lamp=0, area=0)
    weights, recipes = draw(only)
    assert ((weights > 0).any(2).sum(1) == 1).all()
    direction = np.array([recipe["lights"][0]["direction"] for recipe in recipes])
    nearest = (STAGE.mean_directions(weights) * direction).sum(1)
    assert np.degrees(np.arccos(nearest.min())) < 9


def test_too_few_or_uneven_lights_are_refused_with_what_is_needed():
    with pytest.raises(InputError, match=r"64 lights are too few to mix light from, 128 are needed.*light_count=256"):
        LightStage(light_sets.load("stage:64"), "scene a")
    with pytest.raises(InputError, match="leave a gap"):
        LightStage(light_sets.load("grid:128"), "scene a")
    for name in ("stage:128", "stage:512", "hemisphere:256"):
        LightStage(light_sets.load(name), name)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"environment": 1.5}, "environment must be in"),
        ({"environments": ("stdio",)}, "did you mean 'studio'"),
        ({"environment": 0, "directional": 0, "lamp": 0, "area": 0}, "no light"),
        ({"environments": ()}, "must name a map"),
        ({"turn": -1.0}, "turn must not be negative"),
    ],
)
def test_bad_mixtures_are_refused(values, words):
    with pytest.raises(InputError, match=words):
        LightMix(**values)


def test_light_from_behind_is_reported():
    radiance = np.zeros((32, 64, 3), np.float32)
    radiance[16, 32] = 1.0
    assert mixing.share_behind(radiance) == 0
    radiance[16, 0] = 3.0
    assert mixing.share_behind(radiance) == pytest.approx(0.75, rel=1e-6)
    one = environments.solid_angles(32)[16, 0] / np.pi
    np.testing.assert_allclose(STAGE.under(radiance).sum(0), one, rtol=1e-6)  # the brighter pixel behind gives nothing
