"""The camera of `render.shared.imaging.sensor`, for a batch of scenes on the device they are on.

Samples that are made on a GPU should not go back to the processor to be photographed, scene by scene, in numpy. Here
all scenes of a batch pass each step at once, each with its own camera, and nothing waits for the device. Each step is
that of `Sensor.record`; the noise is other draws of the same distribution. A JPEG is not written: what its encoder and
decoder lose (libjpeg's, as OpenCV calls it: 4:2:0, tables of Annex K of ITU-T T.81, whole numbers between the steps) is
computed, and only the coding in between, which loses nothing, is left out.
"""

from collections.abc import Sequence
from functools import cache
from math import ceil
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from render.shared.imaging.sensor import Sensor

SKEWNESS = 0.125
"""As in `render.shared.imaging.sensor`: above it photons are counted, up to it photon and reading noise are one
Gaussian."""
_BLOCK = 8  # pixels a side that JPEG transforms together
_LUMINANCE = (
    16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55, 14, 13, 16, 24, 40, 57, 69, 56,
    14, 17, 22, 29, 51, 87, 80, 62, 18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113, 92,
    49, 64, 78, 87, 103, 121, 120, 101, 72, 92, 95, 98, 112, 100, 103, 99,
)  # fmt: skip
_CHROMINANCE = (
    17, 18, 24, 47, 99, 99, 99, 99, 18, 21, 26, 66, 99, 99, 99, 99, 24, 26, 56, 99, 99, 99, 99, 99,
    47, 66, 99, 99, 99, 99, 99, 99, *(99,) * 32,
)  # fmt: skip


class Sensors(NamedTuple):
    """One camera per scene. Fields are those of `Sensor`, float32 (B,) on the device, but for the last two.

    Attributes:
        saving: (S,) int64 on the device, the scenes whose camera saves JPEG. Their number is known without asking it.
        reach: Pixels that the widest blur reaches, four standard deviations.
    """

    stops: Tensor
    full_well: Tensor
    read_noise: Tensor
    bits: Tensor
    black_level: Tensor
    black_error: Tensor
    ambient: Tensor
    field_angle: Tensor
    blur: Tensor
    jpeg_quality: Tensor
    saving: Tensor
    reach: int

    @classmethod
    def of(cls, sensors: Sequence[Sensor], device: torch.device | str) -> "Sensors":
        """Return the cameras of a batch's B scenes on the device, without waiting for it."""
        rows = [[float(getattr(sensor, name)) for sensor in sensors] for name in cls._fields[:-2]]
        fields = torch.tensor(rows, dtype=torch.float32).to(device, non_blocking=True)  # (10, B)
        saving = torch.tensor([scene for scene, one in enumerate(sensors) if one.jpeg_quality], dtype=torch.int64)
        reach = max(ceil(4 * max(sensor.blur, 0.0)) for sensor in sensors)
        return cls._make((*fields.unbind(), saving.to(device, non_blocking=True), reach))


@torch.no_grad()
def record(images: Tensor, sensors: Sensors, noise: torch.Generator) -> Tensor:
    """Return what a reader of the cameras' files gets: (B, Q, 3, H, W) float32 linear, 1 for saturation.

    Args:
        images: (B, Q, 3, H, W) float32 linear, 1 is full scale at 0 stops. They are not changed.
        sensors: The B scenes' cameras, on the images' device.
        noise: Draws the noise; of the images' device.
    """
    with torch.autocast(images.device.type, enabled=False):
        linear = _develop(_expose(_expected(images.float(), sensors), sensors, noise), sensors)
        if sensors.saving.shape[0]:
            saved = linear.index_select(0, sensors.saving)
            quality = sensors.jpeg_quality.index_select(0, sensors.saving)
            linear.index_copy_(0, sensors.saving, _from_srgb(_compress(_to_srgb(saved), quality)))
        return linear


def _of_scenes(values: Tensor) -> Tensor:
    """Let one value per scene, (B,), meet images: (B, 1, 1, 1, 1)."""
    return values[:, None, None, None, None]


def _expected(images: Tensor, sensors: Sensors) -> Tensor:  # (B, Q, 3, H, W) electrons
    """`Sensor.expected`: the lens and the exposure."""
    height, width = images.shape[-2:]
    if sensors.reach:
        rows, columns = (_blurring(size, sensors.blur, sensors.reach) for size in (height, width))
        images = rows[:, None, None] @ images @ columns[:, None, None].mT
    light = images.clamp(min=0.0).add_(_of_scenes(sensors.ambient))
    light.mul_(_vignetting(height, width, sensors.field_angle)[:, None, None])
    return light.mul_(_of_scenes(torch.exp2(sensors.stops) * sensors.full_well))


def _blurring(size: int, sigma: Tensor, reach: int) -> Tensor:
    """Return per scene the matrix that blurs along an axis, (B, size, size): edges repeat as in cv2.BORDER_REFLECT.

    One product with it reads the images once, where a sum of shifted images reads them once per tap.
    """
    taps = torch.arange(-reach, reach + 1, device=sigma.device)  # (K,)
    weights = torch.exp(-0.5 * (taps / sigma.clamp(min=1e-3)[:, None]) ** 2)  # (B, K); no blur leaves the middle one
    weights = weights * (taps.abs() <= torch.ceil(4 * sigma)[:, None])
    weights = weights / weights.sum(1, keepdim=True)
    pixels = torch.arange(size, device=sigma.device)
    sources = (pixels + taps[:, None]) % (2 * size)  # (K, size): of the image followed by its mirror image
    sources = torch.minimum(sources, 2 * size - 1 - sources)
    chosen = (sources[..., None] == pixels).float()  # (K, size, size)
    return (weights @ chosen.flatten(1)).unflatten(1, (size, size))


def _vignetting(height: int, width: int, angle: Tensor) -> Tensor:  # (B, H, W)
    """`render.shared.imaging.sensor.vignetting` of each scene."""
    row, column = (torch.arange(size, device=angle.device) + 0.5 - size / 2 for size in (height, width))
    squared = (row[:, None] ** 2 + column**2) / (height**2 + width**2) * 4
    return (1.0 + squared * torch.tan(torch.deg2rad(angle))[:, None, None] ** 2) ** -2


def _scale(sensors: Sensors) -> tuple[Tensor, Tensor]:
    """Return the largest DN and the black level, both (B, 1, 1, 1, 1)."""
    return _of_scenes(torch.round(torch.exp2(sensors.bits)) - 1), _of_scenes(sensors.black_level)


def _expose(electrons: Tensor, sensors: Sensors, noise: torch.Generator) -> Tensor:  # (B, Q, 3, H, W) DN
    """`Sensor.expose` of the mean number of electrons: noise and converter."""
    top, black = _scale(sensors)
    read = _of_scenes(sensors.read_noise)
    drawn = torch.randn(electrons.shape, generator=noise, device=electrons.device)
    variance = electrons + read**2
    deviation = variance.sqrt()
    few = electrons > SKEWNESS * variance * deviation
    counted = torch.poisson(torch.where(few, electrons, 0.0), generator=noise).addcmul_(read, drawn)
    numbers = torch.where(few, counted, drawn.mul_(deviation).add_(electrons))
    numbers.mul_((top - black) / _of_scenes(sensors.full_well)).add_(black).round_()
    return torch.minimum(numbers.clamp_(min=0.0), top)


def _develop(numbers: Tensor, sensors: Sensors) -> Tensor:
    """`Sensor.develop`."""
    top, black = _scale(sensors)
    return (numbers - (black - _of_scenes(sensors.black_error))) * (1.0 / (top - black))


def _to_srgb(linear: Tensor) -> Tensor:  # whole numbers in 0..255
    linear = linear.clamp(0.0, 1.0)
    curve = torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return torch.round(255 * curve)


def _from_srgb(pixels: Tensor) -> Tensor:
    values = pixels / 255
    return torch.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def _compress(pixels: Tensor, quality: Tensor) -> Tensor:
    """Return what is left of RGB pixels (S, Q, 3, H, W), whole numbers in 0..255, in JPEGs of the qualities (S,)."""
    height, width = pixels.shape[-2:]
    right, below = -width % (2 * _BLOCK), -height % (2 * _BLOCK)
    if right or below:
        pixels = pad(pixels.flatten(0, 1), (0, right, 0, below), mode="replicate").unflatten(0, pixels.shape[:2])
    red, green, blue = pixels.unbind(2)
    luminance = torch.round(0.299 * red + 0.587 * green + 0.114 * blue)
    chrominance = torch.stack((
        128 - 0.168735892 * red - 0.331264108 * green + 0.5 * blue,
        128 + 0.5 * red - 0.418687589 * green - 0.081312411 * blue,
    ), 2).round_()  # fmt: skip  # (S, Q, 2, H, W)
    # Means of 2 x 2, halves rounded down and up in turn.
    summed = chrominance.unflatten(-1, (-1, 2)).sum(-1).unflatten(-2, (-1, 2)).sum(-2)
    halves = torch.floor((summed + 1 + torch.arange(summed.shape[-1], device=pixels.device) % 2) / 4)
    steps = _steps(quality)
    luminance = _requantised(luminance, steps[:, None, 0])[..., :height, :width]
    halves = _requantised(halves, steps[:, None, None, 1])[..., : (height + 1) // 2, : (width + 1) // 2]
    first, second = (_doubled(halves) - 128)[..., :height, :width].unbind(2)  # blue's and red's difference
    decoded = (
        luminance + 1.402 * second,
        luminance - 0.344136286 * first - 0.714136286 * second,
        luminance + 1.772 * first,
    )
    return torch.stack(decoded, 2).round_().clamp_(0, 255)


@cache
def _constants(device: torch.device) -> tuple[Tensor, Tensor]:
    """Return Annex K's tables, (2, 8, 8), and the DCT of 8 values, (8, 8), a row per frequency; float32.

    The DCT is sqrt(8) times the orthonormal one, like libjpeg's: rows of ones then stay exact.
    """
    tables = torch.tensor((_LUMINANCE, _CHROMINANCE), dtype=torch.float32).unflatten(1, (_BLOCK, _BLOCK))
    frequency = torch.arange(_BLOCK, dtype=torch.float64)[:, None]
    waves = torch.cos(torch.pi / _BLOCK * frequency * (torch.arange(_BLOCK) + 0.5)) * 2**0.5
    waves[0] /= 2**0.5
    return tables.to(device), waves.float().to(device)


def _steps(quality: Tensor) -> Tensor:
    """Return the coefficients' steps, (S, 2, 8, 8), of luminance and chrominance at qualities (S,) of 1 to 100."""
    percent = torch.where(quality < 50, torch.floor(5000 / quality), 200 - 2 * quality)
    scaled = _constants(quality.device)[0] * percent[:, None, None, None]
    return torch.floor((scaled + 50) / 100).clamp_(1, 255)


def _requantised(planes: Tensor, steps: Tensor) -> Tensor:
    """Round the DCT of planes (..., H, W) in 0..255 to whole `steps` (..., 8, 8) and return pixels again.

    Between rows and columns libjpeg keeps two binary digits, of the coefficients three.
    """
    repeats = (planes.shape[-2] // _BLOCK, planes.shape[-1] // _BLOCK)
    steps = steps.repeat(*(1,) * (steps.ndim - 2), *repeats)  # (..., H, W)
    waves = _constants(planes.device)[1]
    coefficients = _rounded(_along_columns(_rounded(_along_rows(planes - 128, 4 * waves)), waves / 4))  # eightfold
    levels = torch.floor((coefficients.abs() + 4 * steps) / (8 * steps)).copysign_(coefficients)
    columns = _rounded(_along_columns(levels.mul_(steps), 4 * waves.mT))
    return _rounded(_along_rows(columns, waves.mT / 32)).add_(128).clamp_(0, 255)


def _along_rows(planes: Tensor, basis: Tensor) -> Tensor:  # (..., H, W)
    """Multiply each block's rows by the basis (8, 8)."""
    return (planes.unflatten(-1, (-1, _BLOCK)) @ basis.mT).flatten(-2)


def _along_columns(planes: Tensor, basis: Tensor) -> Tensor:  # (..., H, W)
    return (basis @ planes.unflatten(-2, (-1, _BLOCK))).flatten(-3, -2)


def _rounded(values: Tensor) -> Tensor:
    """Round to whole numbers in place, halves up as libjpeg does: at low steps they are frequent."""
    return values.add_(0.5).floor_()


def _doubled(planes: Tensor) -> Tensor:
    """Enlarge planes (..., H, W) of whole numbers twofold as libjpeg does: 3/4 of the nearest, 1/4 of the next one."""
    above = torch.cat((planes[..., :1, :], planes[..., :-1, :]), -2)
    below = torch.cat((planes[..., 1:, :], planes[..., -1:, :]), -2)
    tall = torch.stack((3 * planes + above, 3 * planes + below), -2).flatten(-3, -2)  # (..., 2 H, W)
    left = torch.cat((tall[..., :1], tall[..., :-1]), -1)
    right = torch.cat((tall[..., 1:], tall[..., -1:]), -1)
    wide = torch.stack((3 * tall + left + 8, 3 * tall + right + 7), -1).flatten(-2)
    return torch.floor(wide / 16)
