"""A camera: from exposed radiance to what a file holds, each step in physical units.

The chain is the linear camera model of EMVA Standard 1288 (release 3.1, section 2: photon noise, dark noise,
gain, quantisation) with the lens in front of it and the file behind it:

1. *Lens.* The image is blurred by a Gaussian, stray light is added everywhere, and corners darken by cos^4 of the field
   angle ("natural vignetting").
2. *Exposure.* f-stops, then electrons: 1 fills a pixel (`full_well`).
3. *Noise.* Poisson noise of the electrons and Gaussian noise of reading them.
4. *Converter.* Electrons become whole numbers (DN) above the black level. What exceeds the largest number is lost: so
   saturation comes before anything that scales the images later.
5. *File.* The black level is subtracted, perhaps not exactly; a JPEG rounds to 8 bits on the sRGB curve and compresses.

Plain numpy and OpenCV, used by training (`sdps.data.augment`) and by `sdps regenerate --photographs` alike.
"""

from dataclasses import dataclass, fields

import cv2
import numpy as np

from render.shared.config import check_fields
from render.shared.errors import InputError
from render.shared.imaging.srgb import from_srgb, to_srgb

DEPTHS = (8, 10, 12, 14, 16)
_SKEWNESS = 0.125
"""Skewness of photon and reading noise together up to which they are drawn as one Gaussian: that of 64 electrons read
without noise. Above it photons are counted by a Poisson distribution."""
_REFERENCE_BITS = 12  # whose DN the ranges of black levels are given in


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """One camera at one setting.

    Attributes:
        stops: Exposure in f-stops relative to the images as they come, whose 1 is full scale.
        full_well: Electrons at full scale: of the pixel at base ISO, fewer by the gain at a higher one.
        read_noise: Standard deviation of reading a pixel, electrons.
        bits: Of the converter.
        black_level: DN of no light.
        black_error: DN that are left, or taken too much, when the black level is subtracted.
        ambient: Stray light, in full scales before the exposure's f-stops.
        field_angle: Degrees between the optical axis and the image's corners; 0: no vignetting.
        blur: Standard deviation of the lens's blur in pixels; 0: none.
        jpeg_quality: 1 to 100; 0 saves no JPEG.
    """

    stops: float = 0.0
    full_well: float = 20000.0
    read_noise: float = 5.0
    bits: int = 12
    black_level: float = 0.0
    black_error: float = 0.0
    ambient: float = 0.0
    field_angle: float = 0.0
    blur: float = 0.0
    jpeg_quality: int = 0

    @property
    def top(self) -> int:
        """Largest DN."""
        return 2**self.bits - 1

    @property
    def gain(self) -> float:
        """DN per electron."""
        return (self.top - self.black_level) / self.full_well

    def expected(self, images: np.ndarray) -> np.ndarray:
        """Return the mean number of electrons, float32, before the converter saturates.

        Args:
            images: (Q, H, W, 3) float32 linear, 1 is full scale at 0 stops.
        """
        electrons = images.copy() if self.blur <= 0 else _blur(images, self.blur)
        np.maximum(electrons, 0.0, out=electrons)
        electrons += np.float32(self.ambient)
        if self.field_angle:
            electrons *= vignetting(images.shape[1], images.shape[2], self.field_angle)[..., None]
        electrons *= np.float32(2.0**self.stops * self.full_well)
        return electrons

    def expose(self, images: np.ndarray, rng: np.random.Generator) -> np.ndarray:  # (Q, H, W, 3) float32
        """Return DN, whole numbers in 0..`top`, of images as in `expected`."""
        electrons = self.expected(images)
        read = np.float32(self.read_noise)
        noise = rng.standard_normal(electrons.shape, dtype=np.float32)
        variance = electrons + read**2
        deviation = np.sqrt(variance)
        few = electrons > _SKEWNESS * variance * deviation
        counted = rng.poisson(electrons[few]) + read * noise[few]
        # Sums of independent Gaussians: one draw has the variance of both noises.
        noise *= deviation
        electrons += noise
        electrons[few] = counted
        electrons *= np.float32(self.gain)
        electrons += np.float32(self.black_level)
        np.rint(electrons, out=electrons)
        return np.clip(electrons, 0, self.top, out=electrons)

    def develop(self, numbers: np.ndarray) -> np.ndarray:  # float32
        """Return DN as linear values, 1 for saturation, a little below 0 where noise is."""
        scale = np.float32(1.0 / (self.top - self.black_level))
        return (numbers - np.float32(self.black_level - self.black_error)) * scale

    def record(self, images: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return what a reader of the camera's files gets, (Q, H, W, 3) float32 linear, 1 for saturation.

        Args:
            images: (Q, H, W, 3) float32 linear, 1 is full scale at 0 stops.
            rng: Draws the noise.
        """
        linear = self.develop(self.expose(images, rng))
        if not self.jpeg_quality:
            return linear
        return np.stack([from_srgb(_decode(jpeg(image, self.jpeg_quality))) for image in linear])


@dataclass(frozen=True, kw_only=True)
class SensorModel:
    """Which cameras there are: each draw takes one (`draw`). Ranges are uniform but where a line says otherwise.

    The defaults span what is measured of real cameras. Full scale: a Canon 5D III holds 67,700 electrons at ISO 100,
    4,290 at ISO 1600 and 1,090 at ISO 6400 (Magic Lantern forum, topic 10111); CCDs of machine vision (Sony ICX625)
    5,900 to 7,000 with 8 to 13 electrons of read noise (EMVA 1288 data sheets of Point Grey and Basler). Read noise of
    most cameras is between 2 and 15 electrons (Clark, Digital Camera Sensor Performance Summary). Field angles run from
    a long lens to 24 degrees, the corners of a 50 mm lens on 36 x 24 mm.

    Attributes:
        stops: Exposure in f-stops relative to what a light meter (the training's `mean_level`) says.
        full_well: Electrons at full scale, uniform in the logarithm.
        read_noise: Electrons, uniform in the logarithm.
        bits: Depths of the converter, each as likely: some of 8, 10, 12, 14, 16.
        black_level: DN of a 12-bit converter; other depths have the same share of their range.
        black_error: The same for what the subtraction of the black level leaves.
        ambient: Stray light in full scales.
        field_angle: Degrees from the axis to the corners.
        blur: Pixels, standard deviation.
        jpeg: Share of the cameras that save JPEG.
        jpeg_quality: Of those, 1 to 100.
    """

    stops: tuple[float, float] = (-1.0, 1.0)
    full_well: tuple[float, float] = (4000.0, 60000.0)
    read_noise: tuple[float, float] = (2.0, 15.0)
    bits: tuple[int, ...] = (8, 12, 16)
    black_level: tuple[float, float] = (0.0, 256.0)
    black_error: tuple[float, float] = (-4.0, 4.0)
    ambient: tuple[float, float] = (0.0, 0.01)
    field_angle: tuple[float, float] = (0.0, 24.0)
    blur: tuple[float, float] = (0.0, 0.8)
    jpeg: float = 0.25
    jpeg_quality: tuple[int, int] = (75, 98)

    def __post_init__(self) -> None:
        for field in fields(self):
            values = getattr(self, field.name)
            if isinstance(values, tuple) and field.name != "bits" and not values[0] <= values[1]:
                raise InputError(f"sensor.{field.name} must be two rising numbers, got {values[0]} and {values[1]}")
        for name in ("full_well", "read_noise", "ambient", "field_angle", "blur", "black_level", "jpeg_quality"):
            bound = 1.0 if name == "full_well" else 0.0
            if not getattr(self, name)[0] >= bound:
                raise InputError(f"sensor.{name} must not be below {bound:g}, got {getattr(self, name)[0]}")
        for name, limit in (("field_angle", 60.0), ("black_level", 2048.0), ("jpeg_quality", 100), ("ambient", 1.0)):
            if getattr(self, name)[1] > limit:
                raise InputError(f"sensor.{name} must not exceed {limit:g}, got {getattr(self, name)[1]}")
        if max(abs(value) for value in (*self.stops, *self.blur)) > 10.0:
            raise InputError(f"sensor.stops and sensor.blur must be within 10, got {self.stops} and {self.blur}")
        if not self.bits or any(bits not in DEPTHS for bits in self.bits):
            raise InputError(f"sensor.bits must be some of {', '.join(map(str, DEPTHS))}, got {list(self.bits)}")
        if self.jpeg and self.jpeg_quality[0] < 1:
            raise InputError(f"sensor.jpeg_quality must be 1 to 100, got {self.jpeg_quality[0]}")
        check_fields(self, "not negative", "jpeg", section="sensor")
        if self.jpeg > 1.0:
            raise InputError(f"sensor.jpeg must be in [0, 1], got {self.jpeg}")

    def draw(self, rng: np.random.Generator) -> Sensor:
        """Draw a camera; every field takes the same number of draws, also one with a fixed value."""

        def logarithmic(low: float, high: float) -> float:
            return float(np.exp(rng.uniform(np.log(max(low, 1e-6)), np.log(max(high, 1e-6)))))

        stops, full_well = float(rng.uniform(*self.stops)), logarithmic(*self.full_well)
        read_noise = logarithmic(*self.read_noise)
        bits = self.bits[int(rng.integers(len(self.bits)))]
        unit = 2.0 ** (bits - _REFERENCE_BITS)
        black_level, black_error = (
            unit * float(rng.uniform(*bounds)) for bounds in (self.black_level, self.black_error)
        )
        ambient, angle, blur = (float(rng.uniform(*bounds)) for bounds in (self.ambient, self.field_angle, self.blur))
        saves, quality = rng.random() < self.jpeg, int(rng.integers(*self.jpeg_quality, endpoint=True))
        return Sensor(
            stops=stops, full_well=full_well, read_noise=read_noise, bits=bits, black_level=round(black_level),
            black_error=black_error, ambient=ambient, field_angle=angle, blur=blur, jpeg_quality=quality * saves,
        )  # fmt: skip


def vignetting(height: int, width: int, angle: float) -> np.ndarray:  # (H, W) float32
    """Return the light a lens passes to each pixel, 1 on the axis: cos^4 of the angle to it, `angle` at the corners.

    On a flat sensor a pixel at the share r of the way to the corner sees the angle atan(r tan(angle)).
    """
    row, column = (np.arange(count) + 0.5 - count / 2 for count in (height, width))
    squared = (row[:, None] ** 2 + column**2) / (height**2 + width**2) * 4
    return ((1.0 + squared * np.tan(np.radians(angle)) ** 2) ** -2).astype(np.float32)


def _blur(images: np.ndarray, sigma: float) -> np.ndarray:
    """Convolve each image with a normalised Gaussian that reaches four standard deviations."""
    side = 2 * int(np.ceil(4 * sigma)) + 1
    return np.stack([cv2.GaussianBlur(image, (side, side), sigma, borderType=cv2.BORDER_REFLECT) for image in images])


def jpeg(linear: np.ndarray, quality: int) -> bytes:
    """Return a linear image (H, W, 3) as the bytes of an 8-bit sRGB JPEG file."""
    pixels = np.rint(255 * to_srgb(linear).astype(np.float32)).astype(np.uint8)
    _, encoded = cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return encoded.tobytes()


def _decode(data: bytes) -> np.ndarray:  # (H, W, 3) float32 in [0, 1]
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None  # our own encoder's
    return pixels[..., ::-1].astype(np.float32) / 255
