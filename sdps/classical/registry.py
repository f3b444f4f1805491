"""The classical methods by name, behind one call."""

import importlib
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from render.shared.errors import InputError, unknown
from sdps.core.estimate import Estimate


@dataclass(frozen=True, kw_only=True)
class ClassicalMethod:
    """One way from images to normals without learning.

    Attributes:
        module: Module of `sdps.classical`.
        function: Its function.
        paper: Authors, venue and year.
        summary: One line.
        calibrated: Whether it is told the lights; otherwise it finds them.
        minimum: Fewest images it works with.
        options: Fixed options of the function.
    """

    module: str
    function: str
    paper: str
    summary: str
    calibrated: bool
    minimum: int = 3
    options: tuple[tuple[str, Any], ...] = ()

    def load(self) -> Callable[..., Estimate]:
        """Import and return the function."""
        return getattr(importlib.import_module(f"sdps.classical.{self.module}"), self.function)


METHODS: dict[str, ClassicalMethod] = {
    "least-squares": ClassicalMethod(
        module="least_squares", function="least_squares", paper="Woodham 1980", calibrated=True,
        summary="Lambert's law per pixel, in the least-squares sense",
    ),
    "least-squares-shadows": ClassicalMethod(
        module="least_squares", function="least_squares", paper="Woodham 1980", calibrated=True,
        summary="the same without observations under 10 % of the pixel's brightest",
        options=(("shadow_threshold", 0.1),),
    ),
    "position-threshold": ClassicalMethod(
        module="robust", function="position_threshold", paper="Coleman & Jain 1982, ordered", calibrated=True,
        summary="least squares on the middle of each pixel's sorted intensities", minimum=5,
    ),
    "robust-least-squares": ClassicalMethod(
        module="robust", function="robust_least_squares", paper="L1 by reweighting", calibrated=True,
        summary="least absolute residuals, by iteratively reweighted least squares",
    ),
    "low-rank-least-squares": ClassicalMethod(
        module="robust", function="low_rank_least_squares", paper="Wu et al. ACCV 2010", calibrated=True,
        summary="least squares after taking highlights and shadows out of the images' low-rank part", minimum=5,
    ),
    "factorisation": ClassicalMethod(
        module="plain", function="factorisation", paper="Hayakawa 1994; Yuille & Snow 1997", calibrated=False,
        summary="integrable factors with the bas-relief transformation of equally strong lights", minimum=4,
    ),
    "am07": ClassicalMethod(
        module="entropy", function="entropy", paper="Alldrin, Mallick & Kriegman CVPR 2007", calibrated=False,
        summary="the bas-relief transformation under which albedos have the least entropy", minimum=4,
    ),
    "sm10": ClassicalMethod(
        module="grouping", function="grouping", paper="Shi et al. CVPR 2010", calibrated=False,
        summary="equal albedo within groups of one colour", minimum=4,
    ),
    "pf14": ClassicalMethod(
        module="diffuse_maxima", function="diffuse_maxima", paper="Favaro & Papadhimitri CVPR 2012, IJCV 2014",
        calibrated=False, summary="at local diffuse maxima the normal points to the light", minimum=4,
    ),
    "pf14-diffuse": ClassicalMethod(
        module="diffuse_maxima", function="diffuse_maxima", paper="Favaro & Papadhimitri CVPR 2012, IJCV 2014",
        calibrated=False, summary="pf14 behind a robust diffuse fit; better on glossy objects without cast shadows",
        minimum=4, options=(("front", "diffuse"),),
    ),
    "wt13": ClassicalMethod(
        module="reflectance_symmetry", function="reflectance_symmetry", paper="Wu & Tan CVPR 2013", calibrated=False,
        summary="highlights are symmetric about the half vector", minimum=4,
    ),
    "lm13": ClassicalMethod(
        module="profile_distances", function="profile_distances", paper="Lu et al. CVPR 2013", calibrated=False,
        summary="distances between intensity profiles are angles between normals", minimum=10,
    ),
    "lc18": ClassicalMethod(
        module="half_vector", function="half_vector", paper="Lu, Chen, Sato & Sato TPAMI 2018", calibrated=False,
        summary="reflectance depends on half and difference angle alone", minimum=10,
    ),
}  # fmt: skip


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
    **options: Any,
) -> Estimate:
    """Run a method.

    Args:
        name: A key of `METHODS`.
        images: (L, H, W, 3) or (L, H, W), linear radiance.
        mask: (H, W) bool.
        lights: (L, 3) directions from the surface to the light, for calibrated methods; others ignore them.
        intensities: (L,) or (L, 3) intensities, for calibrated methods; equal ones when absent.
        options: Options of the method's function.

    Returns:
        Normals, lights and intensities, with the seconds it took in the diagnostics.

    Raises:
        InputError: an unknown name, degenerate input, or a calibrated method without lights.
    """
    entry = method(name)
    if entry.calibrated and lights is None:
        raise InputError(f"{name} needs the light directions; give them, or choose an uncalibrated method")
    given = (lights, intensities) if entry.calibrated else ()
    start = time.perf_counter()
    estimate = entry.load()(images, mask, *given, **(dict(entry.options) | options))
    seconds = time.perf_counter() - start
    return replace(estimate, diagnostics=estimate.diagnostics | {"seconds": seconds})
