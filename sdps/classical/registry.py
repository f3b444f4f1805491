"""The classical methods by name, behind one call; a new one is a module and an entry of classical_methods.yaml."""

import importlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib import resources
from typing import Any

import numpy as np

from render.shared.config import build, read_yaml
from render.shared.errors import InputError, unknown
from sdps.classical.common.near_lamps import NearLamps
from sdps.core.estimate import Estimate


@dataclass(frozen=True, kw_only=True)
class ClassicalMethod:
    """One way from images to normals without learning.

    Attributes:
        module: Module of `sdps.classical`.
        function: Its function.
        paper: Authors, venue and year.
        summary: One line.
        calibrated: Whether it is given the lights; otherwise it finds them.
        by_pixel: Whether what it finds of a pixel depends on no other.
        minimum: Fewest images it works with.
        options: Fixed options of the function.
    """

    module: str
    function: str
    paper: str
    summary: str
    calibrated: bool
    by_pixel: bool = False
    minimum: int = 3
    options: dict[str, Any] = field(default_factory=dict)

    def load(self) -> Callable[..., Estimate]:
        """Import and return the function."""
        return getattr(importlib.import_module(f"sdps.classical.{self.module}"), self.function)


METHODS: dict[str, ClassicalMethod] = {
    name: build(ClassicalMethod, values, name)
    for name, values in read_yaml(str(resources.files("assets") / "classical_methods.yaml")).items()
}


def method(name: str) -> ClassicalMethod:
    """Return a method by name.

    Raises:
        InputError: an unknown name, with the nearest.
    """
    if name not in METHODS:
        raise unknown("classical method", name, METHODS)
    return METHODS[name]


def run(
    name: str,
    images: np.ndarray,
    mask: np.ndarray,
    lights: np.ndarray | None = None,
    intensities: np.ndarray | None = None,
    near: NearLamps | None = None,
    **options: Any,
) -> Estimate:
    """Run a method.

    Args:
        name: A key of `METHODS`.
        images: (L, H, W, 3) or (L, H, W), linear radiance.
        mask: (H, W) bool.
        lights: (L, 3) directions from the surface to the light, for calibrated methods; others ignore them.
        intensities: (L,) or (L, 3) intensities, for calibrated methods; equal ones when absent.
        near: How near the lamps stand, for calibrated methods; None: they are distant.
        options: Options of the method's function.

    Returns:
        Normals, lights and intensities, and the seconds it took.

    Raises:
        InputError: an unknown name, degenerate input, or a calibrated method without lights.
    """
    entry = method(name)
    if entry.calibrated and lights is None:
        raise InputError(f"{name} needs the light directions; give them, or choose an uncalibrated method")
    given = (lights, intensities) if entry.calibrated else ()
    if entry.calibrated and near is not None:
        options = {"near": near} | options
    start = time.perf_counter()
    estimate = entry.load()(images, mask, *given, **(entry.options | options))
    return replace(estimate, seconds=time.perf_counter() - start)
