"""Carrying a method out on a scene, and scoring what it estimates and nothing it was given."""

from functools import cache
from pathlib import Path

import numpy as np

from pipelines import methods
from pipelines.methods import Method
from pipelines.presets import TestConfig
from sdps.baselines import constant_estimate
from sdps.checkpoint import TrainedModel
from sdps.classical import registry as classical
from sdps.estimate import Estimate
from sdps.inference import Estimator, default_device, load_model
from sdps.metrics import score
from sdps.models.registry import TRUE_LIGHTS


@cache
def _loaded(path: Path) -> TrainedModel:
    """Load a model once, however many methods use it."""
    return load_model(path, default_device())


class Runner:
    """A method with its networks loaded.

    Args:
        method: What to do.
        out: Folder of the runs.
        config: Read-out, precision and rotations.

    Raises:
        InputError: weights that are missing, damaged, or of another role.
    """

    def __init__(self, method: Method, out: Path, config: TestConfig) -> None:
        self.method = method
        methods.require(out, [method])

        def model(name: str) -> TrainedModel | None:
            return _loaded(methods.file_of(out, name)) if name in method.models() else None

        lighting, normals, second = (model(name) for name in (method.lights, method.normals, method.second))
        self.estimator = None
        if lighting is not None or normals is not None:
            self.estimator = Estimator(
                lighting=lighting,
                normals=normals,
                second=second,
                device=default_device(),
                precision=config.precision,
                read_out=method.read_out or config.read_out,
                rotations=config.rotations,
            )

    def estimate(self, images: np.ndarray, mask: np.ndarray, lights: np.ndarray, intensities: np.ndarray) -> Estimate:
        """Run the method; of the true lights it sees what it is to be given.

        Args:
            images: (L, H, W, 3) float32.
            mask: (H, W) bool.
            lights: (L, 3) true directions.
            intensities: (L,) true intensities.
        """
        method, given = self.method, {}
        if method.lights == TRUE_LIGHTS:
            given["lights"] = lights
        if TRUE_LIGHTS in (method.lights, method.intensities):
            given["intensities"] = intensities
        if method.normals == "constant":
            return constant_estimate(len(images), mask)
        if method.normals in classical.METHODS:
            if not classical.METHODS[method.normals].calibrated:
                return classical.run(method.normals, images, mask)
            found = (given["lights"], given["intensities"]) if method.lights == TRUE_LIGHTS else None
            if found is None:
                estimated = self.estimator.estimate_lights(images, mask, given.get("intensities"))
                found = estimated.light_directions, estimated.intensities
            return classical.run(method.normals, images, mask, *found)
        if not method.normals:
            return self.estimator.estimate_lights(images, mask, given.get("intensities"))
        return self.estimator.estimate(images, mask, **given)

    def score(
        self,
        estimate: Estimate,
        mask: np.ndarray,
        normals: np.ndarray,
        lights: np.ndarray,
        intensities: np.ndarray,
    ) -> dict[str, float]:
        """Return the metrics of what the method estimated itself."""
        method, truth = self.method, {}
        if estimate.normals.size:
            truth["normals"] = normals
        if method.lights != TRUE_LIGHTS and len(estimate.light_directions):
            truth["light_directions"] = lights
        if TRUE_LIGHTS not in (method.lights, method.intensities) and len(estimate.intensities):
            truth["intensities"] = intensities
        return {item.name: item.value for item in score(estimate, mask, **truth)}
