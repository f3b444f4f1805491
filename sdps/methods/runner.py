"""A method with its networks loaded: images in, normals and lights out."""

import hashlib
import logging
import time
from collections.abc import Callable, Hashable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from render.records.shards import file_hash
from render.shared.progress import retell
from sdps.classical import registry as classical
from sdps.classical.common.near_lamps import settle
from sdps.core.estimate import Estimate, constant_estimate
from sdps.core.geometry import UNKNOWN, Rig, are_near
from sdps.core.metrics import score
from sdps.inference.estimator import Estimator, default_device, load_model
from sdps.inference.image_source import ImageSource
from sdps.inference.inference_config import InferenceConfig
from sdps.methods.flat_things import NOT_FLAT, Flatness
from sdps.methods.method import CONSTANT, NONE, VIEWS, Method
from sdps.methods.on_box import Box
from sdps.models.registry import MODELS, TRUE_LIGHTS

if TYPE_CHECKING:
    from sdps.methods.fusion.evidence import Evidence
    from sdps.models.checkpoint import TrainedModel
    from sdps.refinement.refine import RefineConfig
    from sdps.refinement.trust import RefinedEstimate

_digest = cache(file_hash)
_log = logging.getLogger(__name__)
_PLACES = ("lighting", "normals")
Found = dict[tuple[Hashable, ...], Estimate]
"""Estimated lights by what they depend on."""


@cache
def _load(path: Path) -> "TrainedModel":
    """Load a model once, however many methods use it."""
    return load_model(path, default_device())


class Runner:
    """A method with its networks loaded.

    Args:
        method: What to do.
        find: Gives the weights file of a name, or raises InputError.
        config: How networks are used; what the method itself says of its read-out and views is filled in.
        refining: How it is refined, if it is.
        flat: What is done with flat things.

    Attributes:
        any_light: It sees images under any light, and tells no lights.

    Raises:
        InputError: weights that are missing, damaged, or of another role.
    """

    def __init__(
        self, method: Method, find: Callable[[str], Path], config: InferenceConfig | None = None,
        refining: "RefineConfig | None" = None, flat: Flatness = NOT_FLAT,
    ) -> None:  # fmt: skip
        self.method, self.config = method, _fill_config(config or InferenceConfig(), method)
        self.refining, self.flat, self.any_light = refining, flat, False
        self.files = {name: find(name) for name in sorted(method.models())}

        def model(name: str) -> "TrainedModel | None":
            return _load(self.files[name]) if name in self.files else None

        lighting, normals = (model(getattr(method, place)) for place in _PLACES)
        if normals is not None and MODELS[normals.name].any_light:  # it has learned what a room adds
            self.config, self.any_light = replace(self.config, stray_light=False), method.lighting != TRUE_LIGHTS
        self.estimator = None
        if lighting is not None or normals is not None:
            self.estimator = Estimator(
                lighting=lighting, normals=normals, device=default_device(), **self.config.options()
            )

    def identity(self) -> str:
        """Return a digest of what results depend on besides images and code: weights, settings and arithmetic."""
        method = self.method
        names = {place: getattr(method, place) for place in _PLACES}
        parts: list[Any] = [method.intensities, method.refined, self.refining]
        if method.fused:
            from sdps.methods.fusion.fuse import WEIGHTS

            parts.append(_digest(WEIGHTS))
        parts += [(place, _digest(self.files[name]) if name in self.files else name) for place, name in names.items()]
        if self.estimator is not None:
            used = self.config.options() | {"precision": self.estimator.arithmetic.precision}
            parts += [used, str(self.estimator.device)]
        return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]

    def estimate(
        self,
        images: ImageSource,
        mask: np.ndarray,
        lights: np.ndarray | None,
        intensities: np.ndarray | None,
        found: Found | None = None,
        saturation: float = float("inf"),
        *,
        rig: Rig = UNKNOWN,
    ) -> Estimate:
        """Run the method; of the lights it sees what it is to be given.

        Args:
            images: (L, H, W, 3) linear radiance, an array or what reads it a few images at a time.
            mask: (H, W) bool.
            lights: (L, 3) directions, or None where the method is given none.
            intensities: (L,) or (L, 3), or None where they are not known.
            found: Lights that methods found of these very images, by what they depend on; read, and added to.
            saturation: Radiance from which on a channel is clipped, which refinement then leaves out.
            rig: What is known of the camera and the lamps' distance.

        Raises:
            InputError: images or lights the method cannot work with, in one line.
        """
        method = self.method
        given: dict[str, Any] = {}
        rig.check(len(images))
        if method.lighting == TRUE_LIGHTS:
            given["lights"] = lights
        if TRUE_LIGHTS in (method.lighting, method.intensities) and intensities is not None:
            given["intensities"] = intensities
        estimate, lit = self._estimate(images, mask, given, found, rig), given.get("lights") is not None
        if self.any_light:
            estimate = estimate.without_lights()
        if self.flat.applies(mask, estimate.normals, lit=lit):
            estimate = self.flat.begin(estimate, mask, lit=lit, images=images)
        if method.refined:
            estimate = self._refine(images, mask, estimate, given, saturation, rig)
        if estimate.tilt is None:
            return estimate
        trust = getattr(estimate, "trust", None)  # of those refined with lamps, whose intensities move
        free = trust is not None and not trust.doubt and not are_near(estimate.nearness)
        return self.flat.finish(estimate, mask, given.get("intensities") if free else None, lit=lit)

    def _estimate(
        self, images: ImageSource, mask: np.ndarray, given: dict[str, Any], found: Found | None, rig: Rig
    ) -> Estimate:
        """Run the method proper on what it is given."""
        method = self.method
        if method.normals == CONSTANT:
            return constant_estimate(len(images), mask)
        if method.normals in classical.METHODS:
            return self._classical(images, mask, given, found, rig)
        if not method.normals:
            return self._lights(images, mask, given, found)
        if found is not None and method.lighting not in (NONE, TRUE_LIGHTS):
            given["found"] = self._lights(images, mask, given, found)
        assert self.estimator is not None  # the method has a normal model
        return self.estimator.estimate(images, mask, **given, rig=rig)

    def _lights(self, images: ImageSource, mask: np.ndarray, given: dict[str, Any], found: Found | None) -> Estimate:
        """Estimate the lights, or take what another method with the same lighting networks found."""
        found = {} if found is None else found
        options = self.config.options() | {"normal_views": None, "rotations": None}
        key = (_digest(self.files[self.method.lighting]), *options.items(), "intensities" in given)
        if key not in found:
            assert self.estimator is not None  # the method has a lighting model
            found[key] = self.estimator.estimate_lights(images, mask, given.get("intensities"))
        return found[key]

    def _classical(
        self, images: ImageSource, mask: np.ndarray, given: dict[str, Any], found: Found | None, rig: Rig
    ) -> Estimate:
        """Run a classical method, which holds the object's box of all images at once; of near lamps, several times."""
        name = self.method.normals
        arguments: tuple[Any, ...] = ()
        if classical.METHODS[name].calibrated:
            if self.method.lighting == TRUE_LIGHTS:
                arguments = given["lights"], given.get("intensities")
            else:
                lit = self._lights(images, mask, given, found)
                arguments = lit.light_directions, lit.intensities

        began = time.perf_counter()
        if isinstance(images, np.ndarray):
            run = partial(classical.run, name, images, mask, *arguments)
        else:
            run = partial(Box(name, images, mask).run, arguments)

        if not are_near(rig.nearness):
            return run()
        if not classical.METHODS[name].calibrated:
            _log.warning("%s takes the lamps for distant; how near they stand is not used", name)
            return run()
        found_near = settle(lambda near: run(near=near), mask, rig.nearness, rig.camera)
        return replace(found_near, seconds=time.perf_counter() - began)

    def _refine(
        self, images: ImageSource, mask: np.ndarray, estimate: Estimate, given: dict[str, Any], saturation: float,
        rig: Rig,
    ) -> Estimate:  # fmt: skip
        """Refine an estimate, or keep it where refinement cannot be trusted; light directions it was given stay."""
        if not len(estimate.light_directions):
            from sdps.refinement.surroundings.outcome import refine_estimate

            return refine_estimate(images, mask, estimate, rig.camera, saturation)
        from sdps.refinement.refine import refine
        from sdps.refinement.trust import choose, trust

        begun = given.get("intensities")
        if begun is None:
            begun = estimate.intensities if len(estimate.intensities) else np.ones(len(images), np.float32)
        lit = given.get("lights") is not None
        refined = refine(
            images, mask, estimate.normals, estimate.light_directions, begun,
            directions_given=lit, config=self.refining, stray=self.config.stray_light, saturation=saturation,
            rig=rig, nearness=estimate.nearness, rim_known=estimate.expected_error is not None,
        )  # fmt: skip
        expected = trust(refined, mask, estimate, given=lit, level=estimate.tilt is not None)
        if not self.method.fused or expected.void:
            return choose(estimate, refined, expected)
        # What is doubted of the normals, joining weighs pixel by pixel; refined lights are better even then.
        from sdps.methods.fusion.fuse import fuse

        found = choose(estimate, refined, expected._replace(doubt=""))
        return fuse(found, self.ask_again(images, mask, found, lit=lit, rig=rig), mask)

    def ask_again(
        self, images: ImageSource, mask: np.ndarray, found: "RefinedEstimate", *, lit: bool, rig: Rig = UNKNOWN
    ) -> "Evidence":
        """Ask the network again under refined lights; return what it and refinement say.

        Args:
            images, mask, rig: As in `estimate`.
            found: By this method, and not doubted.
            lit: Light directions were given.
        """
        from sdps.methods.fusion.evidence import gather

        assert self.estimator is not None  # the method has a network
        lights = Estimate(found.normals, found.light_directions, found.intensities, nearness=found.nearness)
        with retell("normals", "second look"):
            again = self.estimator.look_again(images, mask, lights, rig=rig)
        return gather(mask, found.start, found.refined, again, found.trust, lit=lit)

    def score(
        self,
        estimate: Estimate,
        mask: np.ndarray,
        normals: np.ndarray | None,
        lights: np.ndarray | None,
        intensities: np.ndarray | None,
    ) -> dict[str, float]:
        """Return the metrics of what the method estimated itself, and nothing it was given."""
        method, truth = self.method, {}
        if estimate.normals.size and normals is not None:
            truth["normals"] = normals
        if method.lighting != TRUE_LIGHTS and len(estimate.light_directions) and lights is not None:
            truth["light_directions"] = lights
        found = len(estimate.intensities) and TRUE_LIGHTS not in (method.lighting, method.intensities)
        if found and intensities is not None:
            truth["intensities"] = intensities
        return {item.name: item.value for item in score(estimate, mask, **truth)}


def _fill_config(config: InferenceConfig, method: Method) -> InferenceConfig:
    """Return the configuration with what the method says where it says nothing, one view where neither does."""
    views: dict[str, Any] = {name: getattr(config, name) or getattr(method, name) or 1 for name in VIEWS}
    return replace(config, read_out=method.read_out or config.read_out, **views)
