"""Using trained networks: images and a mask in, lights and normals out, in memory that many images do not fill."""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from render.shared.errors import InputError
from render.shared.progress import repeat
from sdps.core.estimate import Estimate
from sdps.core.precision import Arithmetic, arithmetic
from sdps.core.symmetry import SYMMETRIES
from sdps.data.augment import measure_exposure
from sdps.inference.chunked import lighting_prediction, normal_map, pad_to, pixel_normal_map
from sdps.inference.image_source import ImageSource, ObjectImages, View, survey
from sdps.inference.inference_config import InferenceConfig
from sdps.inference.tiles import PIXEL_BYTES, TILE_BYTES, release_memory, tiles
from sdps.inference.turned_views import KeptView, TurnedView, mean_lights, mean_normals
from sdps.models.base import FusionNetwork, LightingNetwork, Lights, NormalNetwork
from sdps.models.checkpoint import TrainedModel, load_weights
from sdps.models.lcnet import INPUT_SIZE, resize_input

_ROLES = {"lighting": ("lighting",), "normals": ("normals", "pixels")}
_CHUNK_PIXELS = {"cpu": 2**17}
"""On CPUs fewer images at once: their feature maps fit the caches, a quarter to a half faster with the same result."""


class _Known(NamedTuple):
    """Lights the caller gave."""

    directions: np.ndarray | None  # (L, 3), unit
    intensities: np.ndarray | None  # (L,), with the mean of the range of training
    balance: np.ndarray | None  # (L, 3), colours with mean 1


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimator(InferenceConfig):
    """Trained networks that work together: any lighting model with any normal model; its options are those of its base.

    Attributes:
        lighting: Trained lighting model, or None when lights are always given or `normals` is told none.
        normals: Trained model that gives normals, by convolution or pixel by pixel; None for lights alone.
        device: Where all networks are.
        chunk_pixels: Image pixels a network encodes at once; bounds memory whatever the number of images. None: what
            suits the device.

    Raises:
        InputError: a model of another role than its place, or an option out of range.
    """

    lighting: TrainedModel | None
    normals: TrainedModel | None
    device: torch.device
    chunk_pixels: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for place, roles in _ROLES.items():
            model = getattr(self, place)
            if model is not None and model.role not in roles:
                raise InputError(f"{place}: {model.name!r} is a model for {model.role!r}, not for {' or '.join(roles)}")
        if self.chunk_pixels is not None and self.chunk_pixels < 1:
            raise InputError(f"chunk_pixels must be at least 1, got {self.chunk_pixels}")

    @property
    def arithmetic(self) -> Arithmetic:
        """What the networks compute in, resolved."""
        return arithmetic(self.precision, self.device)

    @property
    def needs_lights(self) -> bool:
        """Whether the normal model is given the lights; otherwise it works without a lighting model."""
        return cast(NormalNetwork, self._normal_model().network).needs_lights

    def _normal_model(self) -> TrainedModel:
        """Return the normal model, or refuse to work without one."""
        if self.normals is None:
            raise InputError("no normal model was loaded, so only lights can be estimated; load one")
        return self.normals

    @torch.inference_mode()
    def estimate(
        self,
        images: ImageSource,
        mask: np.ndarray,
        lights: np.ndarray | None = None,
        intensities: np.ndarray | None = None,
        *,
        found: Estimate | None = None,
    ) -> Estimate:
        """Estimate normals, and whichever of light directions and intensities are not given.

        Without a lighting model, given directions alone stand for lights of equal intensity. Normal models that are
        told no lights see the images as they are, whatever is given.

        Args:
            images: (L, H, W, 3), linear radiance of any overall scale, L >= 1, any size; an array, or anything that
                gives the images of a slice. It is read several times, a few images at once.
            mask: (H, W) bool.
            lights: (L, 3) known light directions.
            intensities: (L,) or (L, 3) known intensities, of any overall scale.
            found: What `estimate_lights` of an estimator with the same lighting networks and options gave for these
                images and intensities; it saves estimating the lights again, and changes nothing else.

        Returns:
            The estimate. Directions or intensities that nobody gave, estimated or assumed are empty, (0, 3) and (0,),
            so that scoring them is refused. Diagnostics hold `seconds`, `precision` (what was computed in), `exposure`
            (factor applied for each network), `stray_light` (L, 3) (taken off before that) and, where classes of light
            were estimated, `confidence` (L,), the product of the probabilities of the two likeliest direction classes;
            of lighting models that tell it, `expected_light_error` (L,), the error to expect of each direction, and of
            normal models, `expected_error` (H, W), 0 off the object; both in degrees.

        Raises:
            InputError: sizes that do not fit, non-finite values, an empty mask, lights wanted without a lighting
                model, or lights found though they are given.
        """
        if self.needs_lights and self.lighting is None and lights is None:
            raise InputError("no lighting model was loaded, so light directions must be given")
        began = time.perf_counter() - (found.diagnostics["seconds"] if found is not None else 0.0)
        scene, known, diagnostics = self._prepare(images, mask, lights, intensities)
        lit = self._lit(scene, known, found, diagnostics)
        normals = np.zeros((*mask.shape, 3), np.float32)
        normals[scene.rows, scene.columns] = self._box_normals(scene, known, lit, diagnostics)
        return _concluded(normals, known if lit is None else lit, began, diagnostics)

    @torch.inference_mode()
    def estimate_lights(self, images: ImageSource, mask: np.ndarray, intensities: np.ndarray | None = None) -> Estimate:
        """Estimate the lights alone, as `estimate` does on its way.

        Args:
            images, mask, intensities: As in `estimate`.

        Returns:
            An estimate whose normals are empty, (0, 0, 3).

        Raises:
            InputError: as in `estimate`, or no lighting model was loaded.
        """
        if self.lighting is None:
            raise InputError("no lighting model was loaded; load one, or give the lights")
        began = time.perf_counter()
        scene, known, diagnostics = self._prepare(images, mask, None, intensities)
        lights = self._estimate_lights(scene, known, diagnostics)
        return _concluded(np.zeros((0, 0, 3), np.float32), lights, began, diagnostics)

    def _prepare(
        self, images: ImageSource, mask: np.ndarray, lights: np.ndarray | None, intensities: np.ndarray | None
    ) -> tuple[ObjectImages, _Known, dict[str, Any]]:
        """Check the arguments of `estimate`; return the object's images, what is known, and the first diagnostics."""
        check_lights(len(images), lights, intensities)
        scene = survey(images, mask, self.margin_of(mask.shape), stray=self.stray_light)
        precision = self.arithmetic.precision
        diagnostics: dict[str, Any] = {"precision": precision, "stray_light": scene.stray, "exposure": {}}
        return scene, self._known(lights, intensities), diagnostics

    def _lit(
        self, scene: ObjectImages, known: _Known, found: Estimate | None, diagnostics: dict[str, Any]
    ) -> Lights | None:
        """Return the lights (1, L, ...) the normal model is told: found before, estimated or given; None for none."""
        if found is not None:
            return self._taken(found, known, len(scene), diagnostics)
        if self.lighting is not None and (known.directions is None or known.intensities is None):
            return self._estimate_lights(scene, known, diagnostics)
        if not self.needs_lights:
            return None
        assert known.directions is not None  # without a lighting model `estimate` refuses that
        equal = np.full(len(scene), self._mean_intensity(), np.float32)
        return self._lights(known.directions, equal if known.intensities is None else known.intensities)

    def _box_normals(
        self, scene: ObjectImages, known: _Known, lit: Lights | None, diagnostics: dict[str, Any]
    ) -> np.ndarray:
        """Return the normals of the object's box, (h, w, 3) float32, zero outside the mask."""
        multiple, halo, most = self._tiling(len(scene))
        parts = tiles(scene.mask, most, halo, multiple)
        largest = max(scene.mask[tile.outer_rows, tile.outer_columns].size for tile in parts)
        view = self._view(scene, "normals", known.balance, pad_to(multiple), largest, diagnostics)
        box = np.zeros((*scene.mask.shape, 3), np.float32)
        for number, tile in enumerate(parts):
            part = replace(view, images=scene.part(tile.outer_rows, tile.outer_columns))
            with repeat(number, len(parts)):
                normals, expected = self._normals(part, lit)  # padded
            inside = scene.mask[tile.inner]
            box[tile.inner][inside] = normals[0].permute(1, 2, 0).cpu().numpy()[tile.within][inside]
            if expected is not None:
                whole = diagnostics.setdefault("expected_error", np.zeros(scene.shape, np.float32))
                found = expected[0, 0].cpu().numpy()[tile.within] * inside
                whole[scene.rows, scene.columns][tile.inner] = found
            if len(parts) > 1:
                del normals, expected
                release_memory()
        return box

    def _tiling(self, images: int) -> tuple[int, int, int]:
        """Return of which multiple tiles are, how wide their halo is, and how many pixels they have at most."""
        network = cast(NormalNetwork, self._normal_model().network)
        most = TILE_BYTES // (PIXEL_BYTES + images * network.kept_bytes)
        return network.size_multiple, network.reach, most

    def _estimate_lights(self, scene: ObjectImages, known: _Known, diagnostics: dict[str, Any]) -> Lights:
        """Return the lights (1, L, ...); what is known stays."""
        lights = self._found_lights(scene, diagnostics)
        if lights.confidence is not None:
            diagnostics["confidence"] = lights.confidence[0].float().cpu().numpy()
        if lights.expected_error is not None:
            diagnostics["expected_light_error"] = lights.expected_error[0].float().cpu().numpy()
        return self._merged(known, lights.with_errors())

    def _taken(self, found: Estimate, known: _Known, count: int, diagnostics: dict[str, Any]) -> Lights:
        """Return lights (1, L, ...) that were estimated before, and what was noted of them."""
        if known.directions is not None or len(found.light_directions) != count:
            raise InputError("found holds lights of other images, or of images whose lights are given")
        diagnostics["exposure"].update(found.diagnostics["exposure"])
        told = ("confidence", "expected_light_error")
        diagnostics.update({name: found.diagnostics[name] for name in told if name in found.diagnostics})
        lights = self._lights(found.light_directions, found.intensities)
        errors = found.diagnostics.get("expected_light_error")
        return lights._replace(expected_error=None if errors is None else self._tensor(errors)).with_errors()

    def _found_lights(self, scene: ObjectImages, diagnostics: dict[str, Any]) -> Lights:
        """Return the lights (1, L, ...) that the lighting network finds, with test-time augmentation."""
        assert self.lighting is not None
        network = cast(LightingNetwork, self.lighting.network)
        read = self._view(scene, "lighting", None, resize_input, INPUT_SIZE**2, diagnostics)
        views = self.light_views or 1
        view: View | KeptView = KeptView(read) if views > 1 else read
        found = []
        for number, symmetry in enumerate(SYMMETRIES[:views]):
            with repeat(number, views):
                prediction = lighting_prediction(network, TurnedView(view, symmetry), self.arithmetic.autocast, number)
            found.append((symmetry, network.read_lights(prediction, self.read_out)))
        return mean_lights(found)

    def _normals(self, view: View, lights: Lights | None) -> tuple[Tensor, Tensor | None]:
        """Return normals (1, 3, h, w) of a view, with test-time augmentation, and errors to expect, (1, 1, h, w)."""
        model = self._normal_model()
        if model.role == "pixels":
            assert lights is not None  # these models need lights
            autocast = self.arithmetic.autocast
            return pixel_normal_map(model.network, view, lights, autocast, rotations=self.rotations), None
        network, symmetries = cast(FusionNetwork, model.network), SYMMETRIES[: self.normal_views or 1]
        return mean_normals(symmetries, normal_map(network, view, lights, self.arithmetic.autocast, symmetries))

    def _view(
        self,
        scene: ObjectImages,
        place: str,
        balance: np.ndarray | None,
        fit: Any,
        pixels: int,  # of an image as the network sees it
        diagnostics: dict[str, Any],
    ) -> View:
        """Return the scene as the model in `place` saw scenes in training."""
        exposure = measure_exposure(scene.sample, getattr(self, place).augmentation())
        diagnostics["exposure"][place] = exposure.scale
        chunk = self.chunk_pixels or _CHUNK_PIXELS.get(self.device.type, 2**19)
        return View(scene, exposure, balance, fit, max(1, chunk // pixels), self.device)

    def _mean_intensity(self) -> float:
        model = self.lighting if self.normals is None else self.normals
        assert model is not None  # what is estimated needs one of them
        return float(np.mean(model.augmentation().intensity_range))

    def _known(self, lights: np.ndarray | None, intensities: np.ndarray | None) -> _Known:
        """Bring given lights to unit length and given intensities, whose scale is their own, to that of training."""
        directions = balance = strengths = None
        if lights is not None:
            directions = np.asarray(lights, np.float64)
            directions = (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).astype(np.float32)
        if intensities is not None:
            colours = np.asarray(intensities, np.float64)
            colours = colours / colours.mean() * self._mean_intensity()
            strengths = (colours if colours.ndim == 1 else colours.mean(1)).astype(np.float32)
            balance = None if colours.ndim == 1 else (colours / colours.mean(1, keepdims=True)).astype(np.float32)
        return _Known(directions, strengths, balance)

    def _lights(self, directions: np.ndarray, intensities: np.ndarray) -> Lights:
        return Lights(self._tensor(directions), self._tensor(intensities))

    def _tensor(self, values: np.ndarray) -> Tensor:
        """Return values of all images, (L, ...), as (1, L, ...) where the networks are."""
        return torch.from_numpy(values)[None].to(self.device)

    def _merged(self, known: _Known, lights: Lights) -> Lights:
        """Return the lights with what is known in place of what was estimated."""
        pairs = zip(known[:2], lights[:2], strict=True)
        merged = Lights(*(lit.float() if one is None else self._tensor(one) for one, lit in pairs))
        return merged._replace(expected_error=lights.expected_error if known.directions is None else None)


def default_device(device: str | torch.device | None = None) -> torch.device:
    """Return the device asked for, else CUDA where there is one, else the CPU."""
    return torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))


def load_model(file: str | Path, device: torch.device) -> TrainedModel:
    """Load a trained model for inference on `device`.

    Raises:
        InputError: the file is missing or damaged.
    """
    model = load_weights(file)
    # A third faster on CPUs. The stubs of torch lack `memory_format`.
    model.network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    return model


def _concluded(normals: np.ndarray, lights: Lights | _Known, began: float, diagnostics: dict[str, Any]) -> Estimate:
    """Return an estimate; directions or intensities that nobody knows are empty."""
    directions, strengths = (
        lights[:2] if isinstance(lights, _Known) else (part[0].float().cpu().numpy() for part in lights[:2])
    )
    diagnostics["seconds"] = time.perf_counter() - began
    return Estimate(
        normals,
        np.zeros((0, 3), np.float32) if directions is None else directions,
        np.zeros(0, np.float32) if strengths is None else strengths,
        diagnostics,
    )


def check_lights(count: int, lights: np.ndarray | None, intensities: np.ndarray | None = None) -> None:
    """Refuse lights that cannot be those of `count` images.

    Args:
        count: L.
        lights: (L, 3) directions.
        intensities: (L,) or (L, 3).

    Raises:
        InputError: another shape, a direction of no length, or an intensity that is not positive.
    """
    if lights is not None and np.shape(lights) != (count, 3):
        raise InputError(f"{count} images need light directions of shape ({count}, 3), got {np.shape(lights)}")
    if lights is not None:
        lengths = np.linalg.norm(lights, axis=-1)
        if not ((lengths > 0.0) & np.isfinite(lengths)).all():
            raise InputError("a light direction is zero or NaN; give unit vectors from the surface to the light")
    if intensities is not None:
        if np.shape(intensities) not in ((count,), (count, 3)):
            raise InputError(f"{count} images need as many intensities, got {np.shape(intensities)}")
        if not ((np.asarray(intensities) > 0.0) & np.isfinite(intensities)).all():
            raise InputError("light intensities must be positive finite numbers")
