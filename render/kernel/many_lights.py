"""All lights of a scene from one set of paths: the fast renderer.

Neither the camera path nor the shadow rays depend on the BRDF, and the path does not depend on the
light. So `render.kernel.paths` follows the camera paths once, keeps their vertices, and records one bit per (vertex,
light): lit or not. `render.kernel.shading` then sums BRDF x visibility over the vertices of each pixel, surface by
surface, without a single ray. Many lights, and many materials per view, share all rays.

The sum over a pixel runs in one lane in a fixed order, so the same seed gives the same bytes whatever the
number of threads. Noise is correlated between the lights and materials of a view, which share paths.

Estimator: next-event estimation at every vertex (Kajiya 1986; Veach 1997, eq. 8.10), with bounce directions drawn from
the mixture of the sampling lobes of all materials of the view, weighted by the mixture's density (one-sample balance
heuristic, Veach 1997, eq. 9.15), and narrow highlights sampled from the lights' side as well
(`render.kernel.highlights`). The slow counterpart is `render.kernel.reference`.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from render.kernel.paths import Paths, trace
from render.kernel.scene import Scene
from render.kernel.shading import shade
from render.materials.kernels.packed import PackedSurfaces
from render.records.manifest import View

SAMPLES_PER_PASS = 1 << 21  # bounds the memory of one pass (about 0.3 GB) at any size and sample count


@dataclass(frozen=True)
class GroundTruth:
    """Camera-frame truth of a view; arrays as in `render.records.shards.Shard`."""

    normals: np.ndarray  # (H, W, 3) float32
    depth: np.ndarray  # (H, W) float32
    mask: np.ndarray  # (H, W) bool
    coverage: np.ndarray  # (H, W) float32
    weights: tuple  # per surface (M, H, W) float32, weights of its materials, or None for a single material
    turned: tuple  # per surface (H, W, 3) float32, normals with its relief, or None where it has none
    objects: np.ndarray | None = None  # (H, W) uint32, 1 + number of the object, 0 outside; None where there is one

    def normals_of(self, number: int) -> np.ndarray:
        """Return the normals (H, W, 3) float32 that a surface shows."""
        return self.normals if not self.turned or self.turned[number] is None else self.turned[number]


def render(
    scene: Scene,
    view: View,
    surfaces: PackedSurfaces,
    lights: np.ndarray,
    *,
    size: int,
    spp: int,
    bounces: int,
    seed: int,
    distances: np.ndarray | None = None,
    only: Sequence[int] | None = None,
    probe: bool = True,
) -> tuple[GroundTruth, Iterator[tuple[int, np.ndarray]]]:
    """Render one view of `scene` with every surface under every light.

    Args:
        scene: One object in the unit sphere (see `render.kernel.scene.build`).
        view: Pose.
        surfaces: K surfaces; each in turn covers the object.
        lights: (L, 3) unit vectors to the lights, camera frame; to near lights, from the object's centre.
        size: Image side in pixels.
        spp: Camera samples per pixel.
        bounces: Interreflection bounces after the first hit.
        seed: Sampler seed (32 bits).
        distances: (L,) of near lights from the object's centre, in half image widths; None for distant lights.
        only: Surface numbers to shade, in any order; all by default. The bytes do not depend on it.
        probe: Let the samples of a pixel share what its first samples agree on of a light (`render.kernel.visibility`).

    Returns:
        The ground truth, and an iterator over (surface number, images), numbers rising, with images
        (L, size, size, 3) float32, linear radiance under irradiance pi (of near lights, at the object's centre).
        Passes over many samples are averaged.
    """
    wanted = range(len(surfaces)) if only is None else only
    per_pass = 1 << max(0, (SAMPLES_PER_PASS // size**2).bit_length() - 1)  # so that every pass is stratified
    passes = (
        trace(scene, view, surfaces, lights, size=size, spp=min(per_pass, spp - first), bounces=bounces,
              seed=seed, distances=distances, first=first, probe=probe)
        for first in range(0, spp, per_pass)
    )  # fmt: skip
    if per_pass >= spp:  # shaded one by one as they are asked for, so that a hundred materials need no more memory
        (only_pass,) = passes
        images = ((index, _average(stack, spp)) for index, stack in shade(only_pass, surfaces, wanted))
        return _ground_truth([only_pass], size, spp), images
    truths, stacks = _sum_passes(passes, surfaces, wanted)
    images = ((index, _average(stacks.pop(index), spp)) for index in wanted)
    return _ground_truth(truths, size, spp), images


def _sum_passes(
    passes: Iterable[Paths], surfaces: PackedSurfaces, wanted: Sequence[int]
) -> tuple[list[Paths], dict[int, np.ndarray]]:
    """Return the passes without their vertices, whose memory is freed one by one, and the sums of their images."""
    truths: list[Paths] = []
    stacks: dict[int, np.ndarray] = {}
    for paths in passes:
        truths.append(replace(paths, depths=(), glints=None))
        for index, stack in shade(paths, surfaces, wanted):
            if index in stacks:
                stacks[index] += stack
            else:
                stacks[index] = stack
    return truths, stacks


def _average(image: np.ndarray, spp: int) -> np.ndarray:
    """Divide by the samples in place: the stack is the largest array there is."""
    image /= spp
    return image


def _ground_truth(passes: list[Paths], size: int, spp: int) -> GroundTruth:
    """Average the passes; a pixel belongs to the mask when at least half of its samples hit the object."""
    hits = np.asarray(sum(paths.hits for paths in passes), np.float64)
    normals = np.asarray(sum(paths.normal_sum for paths in passes))
    depth = sum(paths.depth_sum for paths in passes) / np.maximum(hits, 1)
    mask = (2 * hits >= spp) & (np.linalg.norm(normals, axis=1) > 0)

    def unit(summed: np.ndarray) -> np.ndarray:
        length = np.linalg.norm(summed, axis=1)
        whole = np.where(mask[:, None], summed / np.maximum(length, 1e-12)[:, None], 0)
        return whole.reshape(size, size, 3).astype(np.float32)

    weights = tuple(
        None if sums[0] is None else np.where(mask, sum(sums) / np.maximum(hits, 1), 0).astype(np.float32)
        for sums in zip(*(paths.weight_sums for paths in passes), strict=True)
    )
    return GroundTruth(
        normals=unit(normals),
        depth=np.where(mask, depth, 0).reshape(size, size).astype(np.float32),
        mask=mask.reshape(size, size),
        coverage=(hits / spp).reshape(size, size).astype(np.float32),
        weights=tuple(weight if weight is None else weight.reshape(-1, size, size) for weight in weights),
        turned=tuple(
            None if sums[0] is None else unit(sum(sums))
            for sums in zip(*(paths.turned_sums for paths in passes), strict=True)
        ),
        objects=_objects(passes, mask, size),
    )


def _objects(passes: list[Paths], mask: np.ndarray, size: int) -> np.ndarray | None:
    """Return the object that most samples of each pixel hit, of equal ones the first."""
    found = [paths.object_hits for paths in passes if paths.object_hits is not None]
    if not found:
        return None
    return np.where(mask, 1 + np.sum(found, axis=0).argmax(1), 0).reshape(size, size).astype(np.uint32)
