"""Using trained networks: images and a mask in, lights and normals out, in memory that many images do not fill."""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from render.shared.errors import InputError
from render.shared.imaging.vectors import unit
from render.shared.progress import repeat, share
from sdps.core.estimate import Estimate
from sdps.core.geometry import UNKNOWN, Capture, Rig, are_near
from sdps.core.integration import integrate
from sdps.core.intensities import check_intensities, colour_balance, grey, scale_to_mean
from sdps.core.precision import Arithmetic, arithmetic
from sdps.core.symmetry import SYMMETRIES
from sdps.data.augment import measure_exposure
from sdps.inference.chunked import lighting_prediction, normal_map, pad_to, pixel_normal_map
from sdps.inference.image_source import ImageSource, ObjectImages, Surface, View, survey
from sdps.inference.inference_config import InferenceConfig
from sdps.inference.tiles import PIXEL_BYTES, TILE_BYTES, release_memory, tiles
from sdps.inference.turned_views import KeptView, TurnedView, mean_lights, mean_normals
from sdps.models.base import FusionNetwork, LightingNetwork, Lights, NormalNetwork
from sdps.models.checkpoint import TrainedModel, load_weights
from sdps.models.lcnet import INPUT_SIZE, resize_input

AGAIN_SHARE = 0.5
"""Of the memory for a part of an object, when it is looked at again: what was found before is kept beside it."""
_NEAR = 0.04
"""Nearness below which a network's word is not worth the second look that near lamps need."""
_ROLES = {"lighting": ("lighting",), "normals": ("normals", "pixels")}
_CHUNK_PIXELS = {"cpu": 2**17}
"""On CPUs fewer images at once: their feature maps fit the caches, a quarter to a half faster with the same result."""


class _Known(NamedTuple):
    """Lights the caller gave."""

    directions: np.ndarray | None  # (L, 3), unit
    intensities: np.ndarray | None  # (L,), with the mean of the range of training
    balance: np.ndarray | None  # (L, 3), colours with mean 1
    nearness: np.ndarray | None = None  # (L,)
    capture: Capture | None = None

    def place_lamps(self, found: Estimate) -> Estimate:
        """Return lights with the nearness that is known, if it is."""
        if self.nearness is None:
            return found
        near = np.asarray(self.nearness, np.float32)
        return replace(found, nearness=near if are_near(near) else None)


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimator(InferenceConfig):
    """Trained networks that work together: any lighting model with any normal model; its options are those of its base.

    Attributes:
        lighting: Trained lighting model, or None when lights are always given or `normals` needs none.
        normals: Trained model that gives normals, by convolution or pixel by pixel; None for lights alone.
        device: Where all networks are.
        chunk_pixels: Image pixels a network encodes at once; bounds memory for any number of images. None: what
            suits the device.
        tile_share: Of the memory for what a network makes of a part of an object, how much it takes.

    Raises:
        InputError: a model of another role than its place, or an option out of range.
    """

    lighting: TrainedModel | None
    normals: TrainedModel | None
    device: torch.device
    chunk_pixels: int | None = None
    tile_share: float = 1.0

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
        rig: Rig = UNKNOWN,
    ) -> Estimate:
        """Estimate normals, and whichever of light directions and intensities are not given.

        Without a lighting model, given directions alone stand for lights of equal intensity. Normal models that are
        given no lights see the images as they are, even where lights are given.

        Args:
            images: (L, H, W, 3), linear, of any overall scale; an array, or anything that gives those of a slice.
            mask: (H, W) bool.
            lights, intensities: (L, 3) directions and (L,) or (L, 3) intensities that are known; of any overall scale.
            found: What `estimate_lights` of an estimator with the same lighting networks and options gave for these
                images and intensities; it saves estimating the lights again, and changes nothing else.
            rig: The camera, and the lamps' nearness where it is known; else it is what the lighting network finds.
                Networks that do not see where pixels lie take lamps for distant, and cameras for orthographic.

        Returns:
            The estimate. What nobody gave, estimated or assumed is empty, (0, 3) or (0,): scoring it is refused.

        Raises:
            InputError: sizes that do not fit, non-finite values, an empty mask, lights wanted without a lighting
                model, or lights found though they are given.
        """
        if self.needs_lights and self.lighting is None and lights is None and found is None:
            raise InputError("no lighting model was loaded, so light directions must be given")
        began = time.perf_counter() - (found.seconds if found is not None else 0.0)
        scene, known = self._prepare(images, mask, lights, intensities, rig)
        if found is None:
            found = self._estimate_lights(scene, known)
        elif known.directions is not None or len(found.light_directions) != len(scene):
            raise InputError("found holds lights of other images, or of images whose lights are given")
        found = known.place_lamps(found)
        normals, expected, exposure = self._place_normals(scene, known, self._lights(found, known))
        return replace(
            found,
            normals=scene.in_frame(normals),
            expected_error=None if expected is None else scene.in_frame(expected),
            precision=self.arithmetic.precision,
            stray_light=scene.stray,
            exposure=found.exposure | {"normals": exposure},
            seconds=time.perf_counter() - began,
        )

    def look_again(self, images: ImageSource, mask: np.ndarray, lit: Estimate, *, rig: Rig = UNKNOWN) -> Estimate:
        """Estimate normals once more, under lights that something else found.

        Args:
            images, mask, rig: As in `estimate`; nearness comes with the lights.
            lit: Directions, intensities, nearness, and the errors to expect of directions; None: they are exact.

        Raises:
            InputError: as in `estimate`.
        """
        scaled = scale_to_mean(lit.intensities.astype(np.float64), self._mean_intensity()).astype(np.float32)
        errors = np.zeros(len(images), np.float32) if lit.expected_light_error is None else lit.expected_light_error
        found = replace(lit, intensities=scaled, expected_light_error=errors, seconds=0.0)
        less = replace(self, tile_share=AGAIN_SHARE)
        return less.estimate(images, mask, found=found, rig=replace(rig, nearness=lit.nearness))

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
        scene, known = self._prepare(images, mask, None, intensities)
        found = self._estimate_lights(scene, known)
        precision = self.arithmetic.precision
        return replace(found, precision=precision, stray_light=scene.stray, seconds=time.perf_counter() - began)

    def _prepare(
        self, images: ImageSource, mask: np.ndarray, lights: np.ndarray | None, intensities: np.ndarray | None,
        rig: Rig = UNKNOWN,
    ) -> tuple[ObjectImages, _Known]:  # fmt: skip
        """Check the arguments of `estimate`; return the object's images, and what is known of the lights.

        Directions become of unit length; intensities, whose scale is their own, come to that of training.
        """
        check_lights(len(images), lights, intensities)
        scene = survey(images, mask, self.margin_of(mask.shape), stray=self.stray_light)
        directions = strengths = balance = None
        if lights is not None:
            directions = unit(np.asarray(lights, np.float64)).astype(np.float32)
        if intensities is not None:
            scaled = scale_to_mean(np.asarray(intensities, np.float64), self._mean_intensity())
            strengths, colours = grey(scaled).astype(np.float32), colour_balance(scaled)
            balance = None if colours is None else colours.astype(np.float32)
        camera = rig.camera.crop(mask.shape, scene.rows.start, scene.columns.start)
        return scene, _Known(directions, strengths, balance, rig.nearness, Capture.of(scene.mask, camera))

    def _estimate_lights(self, scene: ObjectImages, known: _Known) -> Estimate:
        """Return the lights, without normals: what is known, and what the lighting network finds of the rest.

        Directions or intensities that nobody knows are empty. Without a lighting model lights are equally strong for a
        normal model that needs them.
        """
        directions, intensities = known.directions, known.intensities
        exposure, confidence, errors, nearness, covariance = {}, None, None, None, None
        if self.lighting is not None and (directions is None or intensities is None):
            view = self._view(scene, self.lighting, None, resize_input, INPUT_SIZE**2)
            lights = self._run_lighting(cast(LightingNetwork, self.lighting.network), view)
            exposure["lighting"] = view.exposure.scale
            directions = _to_numpy(lights.directions) if directions is None else directions
            intensities = _to_numpy(lights.intensities) if intensities is None else intensities
            confidence = None if lights.confidence is None else _to_numpy(lights.confidence)
            errors = None if lights.expected_error is None else _to_numpy(lights.expected_error)
            if known.directions is None:
                nearness = None if lights.nearness is None else share_nearness(_to_numpy(lights.nearness))
                covariance = None if lights.covariance is None else _to_numpy(lights.covariance)
        elif intensities is None and self.needs_lights:
            intensities = np.full(len(scene), self._mean_intensity(), np.float32)
        return Estimate(
            np.zeros((0, 0, 3), np.float32),
            np.zeros((0, 3), np.float32) if directions is None else directions,
            np.zeros(0, np.float32) if intensities is None else intensities,
            expected_light_error=errors,
            confidence=confidence,
            nearness=nearness,
            light_covariance=covariance,
            exposure=exposure,
        )

    def _lights(self, found: Estimate, known: _Known) -> Lights | None:
        """Return lights (1, L, ...) as the normal model is given them; None for one that is given none."""
        if not self.needs_lights:
            return None
        lights = Lights(self._tensor(found.light_directions), self._tensor(found.intensities))
        if found.nearness is not None:
            lights = lights._replace(nearness=self._tensor(found.nearness))
        if found.light_covariance is not None:
            lights = lights._replace(covariance=self._tensor(found.light_covariance))
        if known.directions is not None or self.lighting is None:
            return lights
        errors = found.expected_light_error
        return lights._replace(expected_error=None if errors is None else self._tensor(errors)).with_errors()

    def _place_normals(
        self, scene: ObjectImages, known: _Known, lights: Lights | None
    ) -> tuple[np.ndarray, np.ndarray | None, float]:
        """Return `_box_normals`, of networks that see near lamps and perspective with the pixels in their places.

        Near lamps reach each pixel from where it lies, which the normals tell: they are found once for that, all pixels
        taken to lie at the object's mean depth.
        """
        capture, network = known.capture, self._normal_model().network
        near = lights is not None and lights.nearness is not None
        sees = isinstance(network, FusionNetwork) and network.sees_places
        if capture is None or not sees or not (near or capture.camera.is_perspective):
            return self._box_normals(scene, known, lights)
        surface = Surface(capture)
        if near:
            with share(0.0, 0.4):
                rough = replace(self, normal_views=1)._box_normals(scene, known, lights, surface)[0]
            heights = integrate(rough, scene.mask, discontinuities=True, camera=capture.camera).z
            surface = Surface(capture, heights)
        with share(0.4 if near else 0.0, 1.0):
            return self._box_normals(scene, known, lights, surface)

    def _box_normals(
        self, scene: ObjectImages, known: _Known, lights: Lights | None,
        surface: Surface | None = None,
    ) -> tuple[np.ndarray, np.ndarray | None, float]:  # fmt: skip
        """Return what is found in the object's box: normals (h, w, 3) float32, zero outside the mask, the errors to
        expect, (h, w) float32 where the network predicts them, and the factor of the exposure.
        """
        multiple, halo, most = self._tiling(len(scene))
        parts = tiles(scene.mask, most, halo, multiple)
        largest = max(scene.mask[tile.outer_rows, tile.outer_columns].size for tile in parts)
        view = self._view(scene, self._normal_model(), known.balance, pad_to(multiple), largest)
        box, errors = np.zeros((*scene.mask.shape, 3), np.float32), np.zeros(scene.mask.shape, np.float32)
        predicted = False
        for number, tile in enumerate(parts):
            window = tile.outer_rows, tile.outer_columns
            part = replace(view, images=scene.part(*window), placement=surface and surface.place(*window))
            with repeat(number, len(parts)):
                normals, expected = self._normals(part, lights)  # padded
            inside = scene.mask[tile.inner]
            box[tile.inner][inside] = normals[0].permute(1, 2, 0).cpu().numpy()[tile.within][inside]
            if expected is not None:
                predicted = True
                errors[tile.inner] = expected[0, 0].cpu().numpy()[tile.within] * inside
            if len(parts) > 1:
                del normals, expected
                release_memory()
        return box, errors if predicted else None, view.exposure.scale

    def _tiling(self, images: int) -> tuple[int, int, int]:
        """Return of which multiple tiles are, how wide their halo is, and how many pixels they have at most."""
        network = cast(NormalNetwork, self._normal_model().network)
        most = int(self.tile_share * TILE_BYTES) // (PIXEL_BYTES + images * network.kept_bytes)
        return network.size_multiple, network.reach, most

    def _run_lighting(self, network: LightingNetwork, read: View) -> Lights:
        """Return the lights (1, L, ...) that a network finds, with test-time augmentation."""
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
        model: TrainedModel,
        balance: np.ndarray | None,
        fit: Any,
        pixels: int,  # of an image as the network sees it
    ) -> View:
        """Return the scene as a model saw scenes in training."""
        exposure = measure_exposure(scene.sample, model.augmentation())
        chunk = self.chunk_pixels or _CHUNK_PIXELS.get(self.device.type, 2**19)
        return View(scene, exposure, balance, fit, max(1, chunk // pixels), self.device)

    def _mean_intensity(self) -> float:
        model = self.lighting if self.normals is None else self.normals
        assert model is not None  # what is estimated needs one of them
        return float(np.mean(model.augmentation().intensity_range))

    def _tensor(self, values: np.ndarray) -> Tensor:
        """Return values of all images, (L, ...), as (1, L, ...) where the networks are."""
        return torch.from_numpy(values)[None].to(self.device)


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


def share_nearness(found: np.ndarray) -> np.ndarray | None:
    """Return one nearness for all lamps (L,) of what a network says of each; None where they are as good as distant."""
    shared = float(np.median(found))
    return np.full_like(found, shared) if shared >= _NEAR else None


def _to_numpy(values: Tensor) -> np.ndarray:
    """Return values of all images, (1, L, ...), as (L, ...) float32."""
    return values[0].float().cpu().numpy()


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
        check_intensities(count, intensities)
