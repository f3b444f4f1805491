"""The camera for batches on a device against the one in numpy, and its JPEG against OpenCV's."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from sdps_samples import rng

from render.shared.imaging import sensor as reference
from render.shared.imaging.sensor import Sensor
from render.shared.imaging.srgb import from_srgb, to_srgb
from sdps.data.resident import device_sensor
from sdps.data.resident.device_sensor import Sensors, record

CLEAN = Sensor(full_well=1e14, read_noise=0.0, bits=16)


def recorded(images: np.ndarray, *sensors: Sensor, seed: int = 0) -> np.ndarray:
    """Give each camera the same images (Q, H, W, 3): (B, Q, H, W, 3)."""
    batch = torch.from_numpy(images).movedim(-1, 1).expand(len(sensors), -1, -1, -1, -1)
    noise = torch.Generator().manual_seed(seed)
    return record(batch, Sensors.of(sensors, "cpu"), noise).movedim(2, -1).numpy()


def picture(height: int = 64, width: int = 96) -> np.ndarray:  # (1, H, W, 3) float32
    """Return linear colours: slopes, a disc, texture, and as much noise as a dark camera has."""
    row, column = np.mgrid[:height, :width].astype(np.float32) / 64
    smooth = np.stack([0.2 + 0.3 * row, 0.5 - 0.2 * column, 0.3 + 0.2 * row * column], -1)
    smooth[(row - 0.5) ** 2 + (column - 0.6) ** 2 < 0.1] *= np.float32([1.8, 0.5, 0.7])
    texture = 0.08 * np.sin(40 * row + 25 * column)[..., None]
    return np.clip(smooth + texture + 0.02 * rng().standard_normal(smooth.shape), 0, 1).astype(np.float32)[None]


@pytest.mark.parametrize(
    "changes",
    [
        {"blur": 0.3}, {"blur": 0.8}, {"blur": 3.0}, {"field_angle": 24.0}, {"ambient": 0.02, "stops": 0.7},
        {"black_level": 1000.0}, {"black_level": 1000.0, "black_error": 40.0}, {"stops": 3.0},
    ],
    ids=str,
)  # fmt: skip
def test_steps_without_noise_are_those_of_the_numpy_camera(changes: dict[str, float]) -> None:
    images = rng().random((2, 24, 40, 3), dtype=np.float32)
    images[0, :3, :3] = 30.0  # a highlight, in a corner where edges matter
    images[1, 5] = -0.1
    sensor = replace(CLEAN, **changes)
    truth = sensor.record(images, rng())
    found = recorded(images, sensor, replace(CLEAN, blur=2.0), CLEAN)[0]  # others in the batch change nothing
    print(f"{changes}: mean {np.abs(found - truth).mean():.1e}, at most {np.abs(found - truth).max():.1e}")  # noqa: T201
    assert np.abs(found - truth).max() <= 1.01 / (65535 - sensor.black_level)  # one DN where sums round otherwise
    assert np.abs(found - truth).mean() < 1e-6


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_converter_has_the_same_steps(bits: int) -> None:
    ramp = np.linspace(0, 1.5, 9600, dtype=np.float32).reshape(1, 40, 80, 3)
    sensor = replace(CLEAN, bits=bits, black_level=2.0 ** (bits - 5))
    found, truth = recorded(ramp, sensor)[0], sensor.record(ramp, rng())
    off = np.abs(found - truth) > 1e-6
    assert off.mean() < 0.02 and np.abs(found - truth).max() <= 1.01 / (sensor.top - sensor.black_level)
    assert found.max() == 1.0


@pytest.mark.parametrize(("electrons", "read_noise"), [(3.0, 0.0), (10.0, 2.0), (20.0, 15.0), (200.0, 0.0), (5e3, 5.0)])
def test_noise_has_the_moments_of_the_numpy_cameras(electrons: float, read_noise: float) -> None:
    sensor = Sensor(full_well=1e4, read_noise=read_noise, bits=16, black_level=8192)
    flat = np.full((1, 200, 200, 3), electrons / 1e4, np.float32)
    other = Sensor(full_well=2e4, read_noise=50.0)
    found, truth = (
        values * 1e4 for values in (recorded(flat, other, sensor, seed=3)[1], sensor.record(flat, rng(4)))
    )  # fmt: skip
    variance = electrons + read_noise**2
    assert found.mean() == pytest.approx(electrons, abs=5 * np.sqrt(variance / found.size))
    assert found.var() == pytest.approx(truth.var(), rel=0.04)  # 120,000 values: 0.6 % standard error
    skewness, expected = (((x - x.mean()) ** 3).mean() / x.std() ** 3 for x in (found, truth))
    assert skewness == pytest.approx(expected, abs=0.06)


def test_photons_are_counted_where_the_numpy_camera_counts_them() -> None:
    assert device_sensor.SKEWNESS == reference._SKEWNESS


@pytest.mark.parametrize("size", [(64, 96), (128, 128), (45, 53)])
@pytest.mark.parametrize("quality", [20, 75, 90, 98, 100])
def test_jpeg_is_opencvs(quality: int, size: tuple[int, int]) -> None:
    image = picture(*size)
    sensor = replace(CLEAN, jpeg_quality=quality)
    found = np.rint(255 * to_srgb(recorded(image, replace(CLEAN, jpeg_quality=50), sensor)[1, 0]))
    original = np.rint(255 * to_srgb(image[0]))
    truth = np.rint(255 * to_srgb(sensor.record(image, rng())[0]))
    loss, difference = np.abs(truth - original).mean(), np.abs(found - truth)
    print(f"{size} quality {quality}: loss {loss:.3f}, difference {difference.mean():.4f}, at most {difference.max()}")  # noqa: T201
    assert difference.mean() < 0.2 < loss / 10


def test_jpeg_ends_on_the_curve_the_numpy_camera_reads() -> None:
    grey = np.full((1, 16, 16, 3), 0.02, np.float32)
    found = recorded(grey, replace(CLEAN, jpeg_quality=90))
    np.testing.assert_allclose(found[0], from_srgb(np.rint(255 * to_srgb(grey)) / 255), rtol=1e-5)


def test_only_scenes_that_save_jpeg_are_compressed() -> None:
    images, plain = picture(), Sensor(blur=0.5, field_angle=10.0)
    saving = replace(plain, jpeg_quality=75)
    before, among = recorded(images, plain, plain, plain), recorded(images, plain, saving, plain)
    np.testing.assert_array_equal(among[[0, 2]], before[[0, 2]])
    assert np.abs(among[1] - before[1]).mean() > 1e-3


def test_images_stay_as_they_are_and_the_seed_decides() -> None:
    images = torch.from_numpy(picture()).movedim(-1, 1)[None]
    kept, sensors = images.clone(), Sensors.of([Sensor(jpeg_quality=80)], "cpu")
    first, again, other = (record(images, sensors, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert torch.equal(images, kept) and torch.equal(first, again) and not torch.equal(first, other)
    assert first.shape == images.shape and first.dtype == torch.float32


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_gpu_records_the_same_and_is_never_waited_for() -> None:
    sensors = [replace(CLEAN, jpeg_quality=90), replace(CLEAN, blur=0.7, field_angle=20.0)]
    truth = recorded(picture(), *sensors)
    images = torch.from_numpy(picture()).movedim(-1, 1).expand(2, -1, -1, -1, -1).cuda()
    noise = torch.Generator("cuda").manual_seed(0)
    record(images, Sensors.of(sensors, "cuda"), noise)  # the first call copies the tables
    torch.cuda.set_sync_debug_mode("error")
    try:
        found = record(images, Sensors.of(sensors, "cuda"), noise)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert np.abs(found.movedim(2, -1).cpu().numpy() - truth).mean() < 1e-3
