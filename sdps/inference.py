"""Using trained networks: images and a mask in, lights and normals out."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from render.errors import InputError
from sdps.augment import normalise_exposure
from sdps.checkpoint import TrainedModel, load_weights
from sdps.estimate import Estimate
from sdps.lighting import ReadOut
from sdps.models.lcnet import resize_input
from sdps.models.nenet import SIZE_MULTIPLE
from sdps.stages import lighting_classes

_TINY = 1e-8


class _Crop(NamedTuple):
    """Rows and columns of the object's box, and the padding that makes its sides multiples of 4."""

    rows: slice
    columns: slice
    pad: tuple[int, int]  # below, right


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimator:
    """A trained pair of networks.

    Attributes:
        lighting: Trained LCNet, or None when lights are always given.
        normals: Trained NENet.
        device: Where both run.
        precision: `bfloat16` runs the networks under autocast.
        read_out: How light classes become lights.
        margin: Pixels kept around the mask's bounding box.
        antialias: Average when LCNet's input is shrunk to 128x128 (the authors' code only interpolates).
        chunk_pixels: Image pixels NENet encodes at once; bounds memory whatever the number of images.
    """

    lighting: TrainedModel | None
    normals: TrainedModel
    device: torch.device
    precision: Literal["float32", "bfloat16"] = "float32"
    read_out: ReadOut = "centre"
    margin: int = 15
    antialias: bool = True
    chunk_pixels: int = 2**20

    def estimate(
        self,
        images: np.ndarray,
        mask: np.ndarray,
        lights: np.ndarray | None = None,
        intensities: np.ndarray | None = None,
    ) -> Estimate:
        """Estimate normals, and whichever of light directions and intensities are not given.

        Args:
            images: (L, H, W, 3) float, linear radiance of any overall scale, L >= 1, any size.
            mask: (H, W) bool.
            lights: (L, 3) known light directions.
            intensities: (L,) or (L, 3) known intensities, of any overall scale.

        Returns:
            The estimate; diagnostics hold `seconds`, `exposure` (factor applied for each network) and, where
            LCNet was asked, `confidence` (L,), the product of its two most probable direction classes.

        Raises:
            InputError: sizes that do not fit, non-finite values, an empty mask, or lights wanted without LCNet.
        """
        _check(images, mask, lights, intensities)
        if self.lighting is None and lights is None:
            raise InputError("no LCNet weights were loaded, so light directions must be given")
        began = time.perf_counter()
        crop = _bounding_box(mask, self.margin)
        inside = mask[crop.rows, crop.columns]
        cropped = images[:, crop.rows, crop.columns].astype(np.float32)
        diagnostics: dict[str, Any] = {"exposure": {}}
        # Given intensities have a scale of their own; those of training have the mean of their range.
        gains = np.ones(len(images), np.float32) if intensities is None else np.asarray(intensities, np.float32)
        gains = gains / gains.mean() * np.float32(np.mean(self.normals.augmentation().intensity_range))
        if self.lighting is not None and (lights is None or intensities is None):
            directions, estimated = self._lights(cropped, inside, diagnostics)
            lights = directions if lights is None else lights
            gains = estimated if intensities is None else gains
        lights = _unit(np.asarray(lights, np.float32))
        normals = np.zeros((*mask.shape, 3), np.float32)
        normals[crop.rows, crop.columns] = self._normals(cropped, inside, crop.pad, lights, gains, diagnostics)
        normals[~mask] = 0.0
        diagnostics["seconds"] = time.perf_counter() - began
        return Estimate(normals, lights, gains if gains.ndim == 1 else gains.mean(1), diagnostics)

    @torch.inference_mode()
    def _lights(
        self, images: np.ndarray, mask: np.ndarray, diagnostics: dict[str, Any]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return directions (L, 3) and intensities (L,) from LCNet."""
        images, scale = normalise_exposure(images, mask, self.lighting.augmentation())
        diagnostics["exposure"]["lighting"] = scale
        with self._autocast():
            logits = self.lighting.network(
                *resize_input(self._tensor(images), self._tensor(mask[None, ..., None])[0], self.antialias)
            )
        directions, intensities = lighting_classes(self.lighting).read_out(*logits, self.read_out)
        peaks = [values.float().softmax(-1).amax(-1)[0] for values in (logits.azimuth, logits.elevation)]
        diagnostics["confidence"] = (peaks[0] * peaks[1]).cpu().numpy()
        return directions[0].cpu().numpy(), intensities[0].cpu().numpy()

    @torch.inference_mode()
    def _normals(
        self,
        images: np.ndarray,
        mask: np.ndarray,
        pad: tuple[int, int],
        lights: np.ndarray,
        intensities: np.ndarray,
        diagnostics: dict[str, Any],
    ) -> np.ndarray:  # (H, W, 3)
        """Return NENet's normals of the crop."""
        images, scale = normalise_exposure(images, mask, self.normals.augmentation())
        diagnostics["exposure"]["normals"] = scale
        gains = (intensities[:, None] if intensities.ndim == 1 else intensities) + _TINY  # (L, 1 or 3)
        network = self.normals.network
        chunk = max(1, self.chunk_pixels // mask.size)
        feature = None
        for start in range(0, len(images), chunk):
            part = slice(start, start + chunk)
            inputs = self._tensor(images[part] / gains[part, None, None])
            inputs = functional.pad(inputs, (0, pad[1], 0, pad[0]))
            with self._autocast():
                encoded = network.encode(inputs, torch.from_numpy(lights[None, part]).to(self.device))
            feature = encoded if feature is None else torch.maximum(feature, encoded)
        with self._autocast():
            normals = network.regress(feature)[0].float().cpu().numpy().transpose(1, 2, 0)
        return normals[: mask.shape[0], : mask.shape[1]]

    def _tensor(self, images: np.ndarray) -> Tensor:
        """Turn (Q, H, W, C) into (1, Q, C, H, W) float32 on the device."""
        array = np.ascontiguousarray(images.transpose(0, 3, 1, 2), dtype=np.float32)
        return torch.from_numpy(array)[None].to(self.device)

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.precision == "bfloat16")


def load_pair(
    lighting_file: str | Path | None,
    normals_file: str | Path,
    *,
    device: str | torch.device | None = None,
    **options: Any,
) -> Estimator:
    """Load LCNet and NENet weights.

    Args:
        lighting_file: LCNet's safetensors, or None for known lights only.
        normals_file: NENet's safetensors.
        device: Torch device; CUDA when there is one, else CPU.
        options: Other fields of `Estimator`.

    Raises:
        InputError: a file is missing, damaged, or of another network.
    """
    device = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    lighting = None if lighting_file is None else load_weights(lighting_file, "lcnet")
    normals = load_weights(normals_file, "nenet")
    for model in (lighting, normals):
        if model is not None:
            model.network.to(device, memory_format=torch.channels_last)  # a third faster on CPUs
    return Estimator(lighting=lighting, normals=normals, device=device, **options)


def _bounding_box(mask: np.ndarray, margin: int) -> _Crop:
    """Return the box around the mask with `margin` pixels, inside the image, and its padding to multiples of 4."""
    slices, pads = [], []
    for axis, size in enumerate(mask.shape):
        inside = np.flatnonzero(mask.any(axis=1 - axis))
        start, stop = max(int(inside[0]) - margin, 0), min(int(inside[-1]) + 1 + margin, size)
        slices.append(slice(start, stop))
        pads.append(-(stop - start) % SIZE_MULTIPLE)
    return _Crop(slices[0], slices[1], (pads[0], pads[1]))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _check(images: np.ndarray, mask: np.ndarray, lights: np.ndarray | None, intensities: np.ndarray | None) -> None:
    """Refuse unusable input in one line."""
    if images.ndim != 4 or images.shape[-1] != 3 or not len(images):
        raise InputError(f"images must be (L, H, W, 3) with L >= 1, got {images.shape}")
    if mask.shape != images.shape[1:3] or mask.dtype != np.bool_:
        raise InputError(f"the mask must be bool of shape {images.shape[1:3]}, got {mask.dtype} of {mask.shape}")
    if not mask.any():
        raise InputError("the mask is empty; mark the object's pixels")
    if not np.isfinite(images[:, mask]).all():
        raise InputError("the images hold NaN or infinite values inside the mask; repair them first")
    if lights is not None and np.shape(lights) != (len(images), 3):
        raise InputError(
            f"{len(images)} images need light directions of shape ({len(images)}, 3), got {np.shape(lights)}"
        )
    if lights is not None and not (np.linalg.norm(lights, axis=-1) > 0.0).all():
        raise InputError("a light direction is zero or NaN; give unit vectors from the surface to the light")
    if intensities is not None:
        if np.shape(intensities) not in ((len(images),), (len(images), 3)):
            raise InputError(f"{len(images)} images need as many intensities, got {np.shape(intensities)}")
        if not (np.asarray(intensities) > 0.0).all():
            raise InputError("light intensities must be positive numbers")
