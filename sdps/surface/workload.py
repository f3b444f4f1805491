"""What an inference will take, in minutes and memory, before it begins; a rough model of every stage.

Seconds are those of one core of a server (AMD EPYC, AVX-512); networks are timed here (`sdps.inference.network_speed`).
Files, disks and what else runs on the machine may double them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from typing import cast

import numpy as np
import torch

from render.shared.errors import InputError
from sdps.classical import registry as classical
from sdps.core.integration import LARGE
from sdps.inference.estimator import AGAIN_SHARE
from sdps.inference.network_speed import time_lights, time_normals
from sdps.inference.tiles import PIXEL_BYTES, TILE_BYTES
from sdps.methods.fusion.fuse import TILE_PIXELS
from sdps.methods.on_box import estimate_bytes
from sdps.methods.relief_sides import MOST
from sdps.methods.runner import Runner
from sdps.models.base import FusionNetwork, NormalNetwork
from sdps.models.registry import TRUE_LIGHTS
from sdps.photos import Photographs
from sdps.refinement import refine
from sdps.refinement.surroundings.low_order import MOST as MOST_ANY
from sdps.surface.meshing import MOST_VERTICES

LIMIT = 4.0
"""GiB that an inference may take."""
LONG = 600.0
"""Seconds from which on a smaller scale is proposed."""
_LEAST = 0.25
_SCALES = (0.5, 0.4, 0.3, 0.25, 0.2, 0.15, 0.1, 0.05)
_GIB = 2.0**30
_BASE = 0.45  # GiB: python, torch, weights, kernels
_NEAR_LAMPS = 1.3
"""How many times as long refinement takes where it looks for near lamps: half of the first steps do."""
_FILES = ("depth.npy", "mask.png", "mesh.glb", "mesh.obj", "mesh.ply", "normal.exr", "normal.npy", "normal.png",
          "relit", "result.json")  # fmt: skip
_DECODED = {"JPEG": 12e-9}
_DECODED_ELSE = 45e-9  # PNG, TIFF, EXR


@dataclass(frozen=True)
class Size:
    """How much there is to do.

    Attributes:
        pixels: Of the object.
        box: Of the rectangle around it.
        frame: Of a picture, once reduced.
        file: Of a picture in its file.
        pictures: How many.
        flat: It may be a flat thing, of which pictures are looked at once more.
    """

    pixels: float
    box: float
    frame: float
    file: float
    pictures: int
    flat: bool = False

    def reduced(self, scale: float) -> "Size":
        """Return what is left at a scale, relative to this one."""
        less = scale**2
        return Size(less * self.pixels, less * self.box, less * self.frame, self.file, self.pictures, self.flat)


@dataclass(frozen=True)
class Workload:
    """What an inference will take.

    Attributes:
        size: How much there is to do.
        shape: (H, W) of a picture.
        scale: At which the pictures are read.
        seconds: By stage, about.
        gib: Most memory at once, about.
        smaller: The largest scale proposed where this takes long or much, and what that takes; else None.
        quick: The largest scale, at least a quarter, that takes under ten minutes and fits, likewise.
        method: Name of the method.
        files: What `Inference.save` will write.
    """

    size: Size
    shape: tuple[int, int]
    scale: float
    seconds: dict[str, float]
    gib: float
    smaller: "tuple[float, float, float] | None" = None
    quick: "tuple[float, float, float] | None" = None
    method: str = ""
    files: tuple[str, ...] = ()

    @property
    def total(self) -> float:
        """Seconds of all stages."""
        return sum(self.seconds.values())

    def describe(self) -> str:
        """Return one line: pixels, pictures, minutes, memory, and a proposal where it takes long or much."""
        text = (
            f"{_count(self.size.pixels)} pixels of object in {self.size.pictures} pictures of {self.shape[1]}x"
            f"{self.shape[0]}: about {_duration(self.total)}, up to {self.gib:.1f} GiB of memory"
        )
        if self.smaller is None:
            return text
        scale, seconds, gib = self.smaller
        return f"{text}; --scale {scale:g} would take about {_duration(seconds)} and {gib:.1f} GiB"

    def summary(self) -> dict[str, float]:
        """Return seconds and GiB in all, JSON ready."""
        return {"seconds": round(self.total), "gib": round(self.gib, 2)}

    def describe_stages(self) -> str:
        """Return one line: every stage that takes five seconds or more, and how long."""
        long = {name: seconds for name, seconds in self.seconds.items() if seconds >= 5.0}
        rest = self.total - sum(long.values())
        parts = [f"{name} {_duration(seconds)}" for name, seconds in long.items()]
        return ", ".join([*parts, f"the rest {_duration(rest)}"] if rest else parts)

    def check(self) -> None:
        """Refuse what does not fit in memory.

        Raises:
            InputError: with the scale that fits.
        """
        if self.gib > LIMIT:
            scale = "a smaller --scale" if self.smaller is None else f"--scale {self.smaller[0]:g}"
            raise InputError(
                f"{_count(self.size.pixels)} pixels of object in {self.size.pictures} pictures would take about "
                f"{self.gib:.1f} GiB of memory, more than {LIMIT:g}; give {scale} (in Python load(..., scale=...)), "
                "fewer pictures, or --anyway"
            )


def workload(photos: Photographs, runner: Runner, *, discontinuities: bool = False) -> Workload:
    """Estimate what an inference will take.

    Args:
        photos: What is looked at.
        runner: The method, with its networks loaded.
        discontinuities: Depth may jump, which takes dozens of solutions.
    """
    mask = photos.mask
    sides = [int(np.ptp(np.flatnonzero(mask.any(axis=axis)))) + 31 for axis in (1, 0)]
    frame = float(mask.size)
    box = float(min(sides[0], mask.shape[0]) * min(sides[1], mask.shape[1]))
    flat = runner.flat.may_apply(mask, lit=photos.light_directions is not None)
    size = Size(float(mask.sum()), box, frame, frame / photos.scale**2, len(photos), flat)
    kind = photos.coding.kind
    seconds, gib = _seconds(size, runner, kind, photos.scale < 1, discontinuities), _memory(size, runner)
    smaller = quick = None
    if sum(seconds.values()) > LONG or gib > LIMIT:
        less = [
            (round(scale * photos.scale, 3), sum(_seconds(part, runner, kind, True, discontinuities).values()),
             _memory(part, runner))
            for scale, part in ((scale, size.reduced(scale)) for scale in _SCALES)
        ]  # fmt: skip
        smaller, quick = next((each for each in less if each[2] <= LIMIT), less[-1]), _choose(less)
    files = list_files(runner)
    return Workload(size, photos.shape, photos.scale, seconds, gib, smaller, quick, runner.method.name, files)


def list_files(runner: Runner) -> tuple[str, ...]:
    """Return the names of the files that `Inference.save` writes of a method, sorted."""
    method, estimator, names = runner.method, runner.estimator, [*_FILES]
    lit = (method.normals in classical.METHODS or method.lighting) and not runner.any_light
    network = None if estimator is None or estimator.normals is None else estimator.normals.network
    names += ["lights.json"] if lit else []
    names += ["albedo.npy"] if method.refined else []
    names += ["highlights.npy", "residual.npy"] if method.refined and lit else []
    names += ["expected-error.npy"] if method.refined or isinstance(network, FusionNetwork) else []
    return tuple(sorted(names))


def _choose(smaller: Sequence[tuple[float, float, float]]) -> tuple[float, float, float]:
    """Return the largest of the scales that fit which is not long, none under a quarter for the time's sake."""
    fit = [each for each in smaller if each[2] <= LIMIT] or [smaller[-1]]
    gentle = [each for each in fit if each[0] >= _LEAST * smaller[0][0] / _SCALES[0]] or fit[:1]
    return next((each for each in gentle if each[1] <= LONG), gentle[-1])


def _seconds(size: Size, runner: Runner, kind: str, reduces: bool, discontinuities: bool) -> dict[str, float]:
    """Return about how long each stage takes."""
    threads, images = max(1, torch.get_num_threads()), size.pictures
    once = images * (size.file * (_DECODED.get(kind, _DECODED_ELSE) + 30e-9 * reduces) + 15e-9 * size.frame)
    found = {"reading": 2 * once + 70e-9 * images * size.frame}
    estimator = runner.estimator
    if estimator is not None and estimator.lighting is not None:
        views = runner.config.light_views or 1
        found["lights"] = 2 * once + images * (40e-9 * size.box + views * time_lights(estimator))
    normals = runner.method.normals
    if normals in classical.METHODS:
        found["normals"] = 8e-7 * size.pixels * images + 1e-5 * size.pixels
    elif estimator is not None and estimator.normals is not None:
        views = runner.config.normal_views or 1
        seconds = _normal_network(runner).inference_seconds(images, size.pixels, size.box, views)
        found["normals"] = time_normals(estimator, images) * seconds + once * _tile_count(size, runner)
    if runner.method.refined:
        found["refinement"] = _refine_seconds(size, runner) / threads + 3 * once
    if size.flat:
        looked = ceil(images / ceil(images / MOST))
        found["flat"] = looked * (once / images + 10e-9 * size.frame + 0.1) + 0.4e-6 * size.pixels
    if runner.method.fused:
        found["second look"] = found["normals"] + 5e-6 * size.box
    found["depth"] = (1.2e-6 if size.pixels > LARGE else 5e-6) * size.pixels * (60 if discontinuities else 1)
    found["albedo"] = 4 * once * ceil(size.pixels / 2**22) + 60e-9 * images * size.pixels
    thin = size.box / ceil((size.box / 2**20) ** 0.5) ** 2
    found["relit pictures"] = 8e-9 * thin**1.5 + 3e-7 * size.frame
    found["files"] = 7e-6 * size.pixels / _step(size) ** 2 + 0.8e-6 * size.frame
    found["page"] = 3.0 + 7e-6 * min(size.box, 2e6)
    return found


def _refine_seconds(size: Size, runner: Runner) -> float:
    if runner.any_light:
        return 1.0 + size.pixels * (24e-6 + 1.4e-6 * min(size.pictures, MOST_ANY))
    each = 0.6e-6 + 38e-9 * size.pictures * (_NEAR_LAMPS if runner.method.lighting != TRUE_LIGHTS else 1.0)
    return 2000 * (1.5e-3 + 2800 * each) + 120 * size.pixels * each


def _normal_network(runner: Runner) -> NormalNetwork:
    assert runner.estimator is not None and runner.estimator.normals is not None
    return cast(NormalNetwork, runner.estimator.normals.network)


def _tile_count(size: Size, runner: Runner) -> int:
    return max(1, ceil(1.3 * size.box / _tile_pixels(size, runner)))


def _tile_pixels(size: Size, runner: Runner) -> float:
    return TILE_BYTES / (PIXEL_BYTES + size.pictures * _normal_network(runner).kept_bytes)


def _memory(size: Size, runner: Runner) -> float:
    """Return about how many GiB are in use at most."""
    kept = 29.0 * size.frame  # normals, mask, error to expect, and what they are cut from
    stages = [16.0 * size.file + 30.0 * size.frame, 70.0 * size.frame]
    if runner.method.normals in classical.METHODS:
        stages.append(estimate_bytes(runner.method.normals, size.pictures, size.box))
    elif runner.estimator is not None:
        tile = min(size.box, _tile_pixels(size, runner)) if runner.estimator.normals is not None else 0.0
        stages.append(kept + tile * TILE_BYTES / _tile_pixels(size, runner) if tile else kept)
    if runner.method.refined:
        kept += 44.0 * size.frame
        each = 1200 + 20 * size.pictures
        stages.append(kept + min(each * size.box, refine.TILE_BYTES) + 12 * size.pixels)
    if runner.method.fused:
        kept += 4.0 * size.frame
        again = 32.0 * size.frame  # the second look, or the joined answer beside it
        tile = size.box * TILE_BYTES / _tile_pixels(size, runner)
        stages.append(kept + again + min(tile, AGAIN_SHARE * TILE_BYTES))
        stages.append(kept + again + 16.0 * size.box + 1200.0 * min(size.box, TILE_PIXELS))
    stages.append(kept + (700 if size.pixels <= LARGE else 80) * size.pixels)
    kept += 25.0 * size.frame  # depth and albedo
    stages.append(kept + 55 * size.pixels)
    stages.append(kept + 750 * size.pixels / _step(size) ** 2)
    return _BASE + max(stages) / _GIB


def _step(size: Size) -> int:
    return max(1, ceil((size.pixels / MOST_VERTICES) ** 0.5))


def _count(pixels: float) -> str:
    return f"{pixels / 1e6:.1f} million" if pixels >= 1e6 else f"{pixels:,.0f}"


def _duration(seconds: float) -> str:
    """Say about how long that is, no more exactly than it is known."""
    if seconds < 90:
        return f"{max(5, round(seconds / 5) * 5)} seconds"
    if seconds < 5400:
        return f"{round(seconds / 60)} minutes"
    return f"{seconds / 3600:.1f} hours" if seconds < 36000 else f"{round(seconds / 3600)} hours"
