"""Each step of the camera against what its physics says."""

from dataclasses import replace

import numpy as np
import pytest

from render.shared.config import build
from render.shared.errors import InputError
from render.shared.imaging.sensor import Sensor, SensorModel, jpeg, vignetting
from render.shared.imaging.srgb import from_srgb, to_srgb
from render.shared.seeds import generator

CLEAN = Sensor(full_well=1e9, read_noise=0.0, bits=16)


def flat(level: float, size: int = 200) -> np.ndarray:
    return np.full((1, size, size, 3), level, np.float32)


def rng(*keys: int | str) -> np.random.Generator:
    return generator(0, "sensor test", *keys)


@pytest.mark.parametrize("level", [0.0005, 0.002, 0.0031, 0.0033, 0.1, 0.6])
def test_variance_follows_the_mean_by_the_gain(level):
    """Photon transfer (EMVA 1288, noise model): variance in DN^2 = gain^2 read^2 + 1/12 + gain x mean above black."""
    sensor = Sensor(full_well=20000, read_noise=6, bits=14, black_level=512)
    numbers = sensor.expose(flat(level), rng("transfer", int(1e6 * level)))
    mean, variance = numbers.mean() - 512, numbers.var()
    assert mean == pytest.approx(level * 20000 * sensor.gain, rel=0.01, abs=0.05)
    expected = sensor.gain**2 * 36 + 1 / 12 + sensor.gain * mean
    assert variance == pytest.approx(expected, rel=0.03)  # 120,000 values: 0.4 % standard error


def test_read_noise_is_what_a_black_image_has():
    sensor = Sensor(full_well=10000, read_noise=8, bits=16, black_level=4096)
    assert sensor.expose(flat(0), rng("read")).std() / sensor.gain == pytest.approx(8, rel=0.02)


@pytest.mark.parametrize(("electrons", "read_noise"), [(3.0, 0.0), (10.0, 2.0), (20.0, 15.0), (200.0, 0.0)])
def test_moments_of_few_electrons_are_those_of_poisson_and_gaussian_noise_together(electrons, read_noise):
    camera = replace(CLEAN, full_well=1e4, read_noise=read_noise, bits=16, black_level=8192.0)
    counted = (camera.expose(flat(electrons / 1e4), rng("moments")) - 8192.0) / camera.gain
    variance = electrons + read_noise**2
    assert counted.mean() == pytest.approx(electrons, abs=5 * np.sqrt(variance / counted.size))
    assert counted.var() == pytest.approx(variance, rel=0.03)
    skewness = ((counted - counted.mean()) ** 3).mean() / counted.std() ** 3
    truth = electrons / variance**1.5
    # Below 0.125 one Gaussian, which has none, stands for both noises.
    assert skewness == pytest.approx(truth if truth > 0.125 else 0.0, abs=0.04)


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_quantisation_step_and_clipping_point(bits):
    ramp = np.linspace(0, 1.5, 300_000, dtype=np.float32).reshape(1, 300, -1, 1) * np.ones(3, np.float32)
    numbers = replace(CLEAN, full_well=1e12, bits=bits).expose(ramp, rng(bits))
    assert numbers.max() == 2**bits - 1 and not np.any(numbers % 1)
    if bits < 16:
        assert set(np.diff(np.unique(numbers))) == {1.0}
    saturated = ramp[numbers == 2**bits - 1]
    assert saturated.min() == pytest.approx(1 - 0.5 / (2**bits - 1), abs=1e-4)
    linear = replace(CLEAN, full_well=1e12, bits=bits).develop(numbers)
    below = ramp < 0.99
    assert np.abs(linear - ramp)[below].max() <= 0.5 / (2**bits - 1) + 6e-6  # linear but for rounding and noise
    assert linear.max() == 1.0


def test_f_stops_double_and_saturation_comes_before_scaling():
    dark, bright = (replace(CLEAN, stops=stops).record(flat(0.2), rng()).mean() for stops in (-1.0, 1.0))
    assert (dark, bright) == (pytest.approx(0.1, rel=1e-3), pytest.approx(0.4, rel=1e-3))
    assert np.all(replace(CLEAN, stops=3.0).record(flat(0.2), rng()) == 1.0)


def test_black_level_leaves_its_error_and_noise_below_zero():
    sensor = Sensor(full_well=10000, read_noise=5, bits=12, black_level=128)
    recorded = sensor.record(flat(0), rng("black"))
    assert abs(recorded.mean()) < 2e-5 and recorded.min() < 0
    off = replace(sensor, black_error=3.0).record(flat(0), rng("black"))
    np.testing.assert_allclose(off - recorded, 3 / (4095 - 128), rtol=1e-3)
    assert (replace(sensor, black_level=0.0).record(flat(0), rng("black")) >= 0).all()


def test_ambient_light_adds_and_is_exposed():
    recorded = replace(CLEAN, ambient=0.02, stops=1.0).record(flat(0.1), rng())
    assert recorded.mean() == pytest.approx(0.24, rel=1e-3)


def test_vignetting_is_cos4_of_the_field_angle():
    falloff = vignetting(301, 401, 20.0)
    assert falloff[150, 200] == pytest.approx(1.0)
    row, column = 37, 310
    distance = np.hypot(row - 150, column - 200) / np.hypot(150.5, 200.5)
    assert falloff[row, column] == pytest.approx(np.cos(np.arctan(distance * np.tan(np.radians(20.0)))) ** 4, rel=1e-5)
    assert falloff[0, 0] == pytest.approx(np.cos(np.radians(20.0)) ** 4, rel=3e-3)
    recorded = replace(CLEAN, field_angle=20.0).record(np.full((1, 301, 401, 3), 0.5, np.float32), rng())
    np.testing.assert_allclose(recorded[0, ..., 1], 0.5 * falloff, atol=2e-4)


def test_blur_has_its_standard_deviation_and_keeps_light():
    image = np.zeros((1, 41, 41, 3), np.float32)
    image[0, 20, 20] = 0.5
    spread = replace(CLEAN, blur=1.7).expected(image)[0, ..., 0] / 1e9
    offset = np.arange(41) - 20
    assert spread.sum() == pytest.approx(0.5, rel=1e-5)
    assert (spread * offset**2).sum() / spread.sum() == pytest.approx(1.7**2, rel=0.01)


def test_srgb_curve_and_jpeg():
    values = np.linspace(0, 1, 1001, dtype=np.float32)
    np.testing.assert_allclose(from_srgb(to_srgb(values)), values, atol=1e-5)
    assert to_srgb(np.float32(0.2140)) == pytest.approx(0.5, abs=1e-3)  # IEC 61966-2-1
    ramp = np.tile(np.linspace(0, 1, 64, dtype=np.float32)[:, None], (1, 1, 64, 3)).reshape(1, 64, 64, 3)
    fine, coarse = (replace(CLEAN, jpeg_quality=quality).record(ramp, rng()) for quality in (98, 10))
    assert np.abs(fine - ramp).max() < 0.02 < np.abs(coarse - ramp).max()
    assert len(jpeg(ramp[0], 98)) > len(jpeg(ramp[0], 10))


def test_cameras_are_drawn_from_their_ranges_and_repeat():
    model = SensorModel()
    drawn = [model.draw(generator(3, "scene", number, "sensor")) for number in range(400)]
    assert drawn == [model.draw(generator(3, "scene", number, "sensor")) for number in range(400)]
    for name in ("stops", "full_well", "read_noise", "ambient", "field_angle", "blur"):
        values, (low, high) = np.array([getattr(one, name) for one in drawn]), getattr(model, name)
        assert low <= values.min() < values.max() <= high
    assert {one.bits for one in drawn} == {8, 12, 16}
    levels = np.array([one.black_level / one.top for one in drawn])
    assert levels.max() <= 16 / 255 + 1e-9 and levels.max() > 200 / 4095
    qualities = np.array([one.jpeg_quality for one in drawn])
    assert 0.18 < (qualities > 0).mean() < 0.32 and qualities[qualities > 0].min() >= 75


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"bits": [9]}, "sensor.bits"),
        ({"stops": [1, -1]}, "sensor.stops must be two rising"),
        ({"full_well": [0, 10]}, "sensor.full_well must not be below 1"),
        ({"jpeg": 1.5}, "sensor.jpeg"),
        ({"jpeg_quality": [50, 101]}, "jpeg_quality must not exceed 100"),
        ({"field_angle": [0, 80]}, "field_angle must not exceed 60"),
        ({"blurr": [0, 1]}, "did you mean"),
        ({"read_noise": [float("nan"), 2]}, "read_noise"),
    ],
)
def test_bad_ranges_are_refused(values, words):
    with pytest.raises(InputError, match=words):
        build(SensorModel, values)
