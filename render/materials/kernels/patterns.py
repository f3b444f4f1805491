"""Weights of the materials of a spatially-varying surface at points of the object, in Dr.Jit.

Coordinates are those of the object in its unit sphere. Parameters are drawn from the seed and opaque to the kernels.
"""

from typing import Any

import numpy as np

from render.backend.arrays import integers, opaque, table
from render.backend.jit import dr, mi
from render.materials.surfaces import Pattern
from render.shapes.geometry.mesh import TriangleMesh
from render.shared.errors import InputError
from render.shared.seeds import generator

_WAVES = 6


class Evaluator:
    """Evaluates the weights of one pattern.

    Args:
        pattern: What to evaluate.
        mesh: The object; only `parts` needs it.

    Raises:
        InputError: `parts` without a mesh.
    """

    def __init__(self, pattern: Pattern, mesh: TriangleMesh | None = None) -> None:
        self.count = pattern.count
        rng = generator(pattern.seed, "pattern", pattern.kind)
        self._weights = getattr(self, f"_{pattern.kind}")
        if pattern.kind == "parts":
            if mesh is None:
                raise InputError(f"pattern {pattern.kind}: needs the mesh it covers")
            self._labels = integers(part_labels(mesh, pattern))
        else:
            self._parameters = getattr(self, f"_draw_{pattern.kind}")(rng)

    def weights(self, position: "mi.Point3f", prim: "mi.UInt32") -> list:
        """Return `count` Float arrays (N), each in [0, 1], that sum to 1.

        Args:
            position: (N) points in the object frame.
            prim: (N) numbers of the triangles they lie on.
        """
        weights = self.at(position, prim)
        dr.eval(weights)
        return weights

    def at(self, position: "mi.Point3f", prim: "mi.UInt32") -> list:
        """Return the same unevaluated, for use inside kernels."""
        return self._weights(mi.Vector3f(position), mi.UInt32(prim))

    def _draw_patches(self, rng: np.random.Generator) -> dict:
        number = int(rng.integers(8, 41))
        centres = rng.normal(size=(number, 3))
        centres *= (rng.uniform(size=(number, 1)) ** (1 / 3)) / np.linalg.norm(centres, axis=1, keepdims=True)
        labels = rng.permutation(np.arange(number) % self.count)
        return _floats(centres=centres, warp=_warp(rng, 0.08)) | {"labels": integers(labels)}

    def _patches(self, position: Any, _: Any) -> list:
        centres, labels = self._parameters["centres"], self._parameters["labels"]
        moved = _displace(position, self._parameters["warp"])
        number = opaque(mi.UInt32(dr.width(labels)))

        def nearer(i: Any, best: Any, label: Any) -> tuple:
            distance = dr.squared_norm(moved - dr.gather(mi.Vector3f, centres, i))
            closer = distance < best
            return i + 1, dr.select(closer, distance, best), dr.select(closer, dr.gather(mi.UInt32, labels, i), label)

        start = (mi.UInt32(0), dr.full(mi.Float, 1e9, dr.width(position)), dr.zeros(mi.UInt32, dr.width(position)))
        _, _, label = dr.while_loop(start, lambda i, *_: i < number, nearer)
        return self._one_hot(label)

    def _draw_stripes(self, rng: np.random.Generator) -> dict:
        bands = rng.uniform(2, 7)  # repetitions over the diameter
        return _floats(wave=np.append(_unit(rng) * bands / 2, rng.uniform()), warp=_warp(rng, 0.12))

    def _stripes(self, position: Any, _: Any) -> list:
        wave = self._parameters["wave"]
        phase = dr.dot(_vector(wave, 0), _displace(position, self._parameters["warp"])) + _scalar(wave, 3)
        label = mi.UInt32((phase - dr.floor(phase)) * self.count)
        return self._one_hot(dr.minimum(label, self.count - 1))

    def _draw_noise(self, rng: np.random.Generator) -> dict:
        waves = rng.normal(size=(self.count, _WAVES, 4)) * rng.uniform(2.0, 5.0)
        waves[..., 3] = rng.uniform(0, 2 * np.pi, waves.shape[:2])
        return _floats(waves=waves, contrast=rng.uniform(3, 12))

    def _noise(self, position: Any, _: Any) -> list:
        waves, contrast = self._parameters["waves"], _scalar(self._parameters["contrast"], 0)
        fields = []
        for k in range(self.count):
            total = mi.Float(0)
            for w in range(_WAVES):
                first = 4 * (k * _WAVES + w)
                total += dr.cos(dr.dot(_vector(waves, first), position) + _scalar(waves, first + 3))
            fields.append(contrast * total / np.sqrt(_WAVES))
        highest = fields[0]
        for field in fields[1:]:
            highest = dr.maximum(highest, field)
        raised = [dr.exp(field - highest) for field in fields]
        return [value / sum(raised) for value in raised]

    def _draw_gradient(self, rng: np.random.Generator) -> dict:
        return _floats(wave=np.append(_unit(rng), rng.uniform(0.5, 0.9)))

    def _gradient(self, position: Any, _: Any) -> list:
        wave = self._parameters["wave"]
        along = dr.clip(0.5 + 0.5 * dr.dot(_vector(wave, 0), position) / _scalar(wave, 3), 0, 1) * (self.count - 1)
        return [dr.maximum(1 - dr.abs(along - k), 0) for k in range(self.count)]

    def _parts(self, _: Any, prim: Any) -> list:
        return self._one_hot(dr.gather(mi.UInt32, self._labels, prim))

    def _one_hot(self, label: Any) -> list:
        return [dr.select(label == k, mi.Float(1), mi.Float(0)) for k in range(self.count)]


def part_labels(mesh: TriangleMesh, pattern: Pattern) -> np.ndarray:  # (F,) uint32
    """Assign a material to every triangle: whole objects of a composition, whole connected pieces of another mesh, or
    regions around points far from each other.

    Objects and pieces are dealt out in turn, largest first, so that every material is seen where there are enough.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    rng = generator(pattern.seed, "pattern", "parts")
    if mesh.objects is not None:
        return _deal(mesh.objects.astype(np.int64), pattern.count, rng)
    faces = mesh.faces.astype(np.int64)
    _, weld = np.unique(np.round(mesh.vertices, 6), axis=0, return_inverse=True)
    welded = weld.ravel()[faces]  # vertices split for their normals still join their pieces
    pairs = np.concatenate([welded[:, :2], welded[:, 1:]])
    graph = coo_matrix((np.ones(len(pairs), np.int8), pairs.T), shape=(welded.max() + 1,) * 2)
    _, piece = connected_components(graph, directed=False)
    piece = piece[welded[:, 0]]
    if piece.max() + 1 >= pattern.count:
        return _deal(piece, pattern.count, rng)
    centroids = mesh.vertices[faces].mean(1)
    regions = pattern.count * int(rng.integers(1, 3))
    seeds = [int(rng.integers(len(centroids)))]
    nearest = np.full(len(centroids), np.inf)
    for _ in range(regions - 1):
        nearest = np.minimum(nearest, ((centroids - centroids[seeds[-1]]) ** 2).sum(1))
        seeds.append(int(nearest.argmax()))
    distance = ((centroids[:, None] - centroids[seeds]) ** 2).sum(2)
    return (distance.argmin(1) % pattern.count).astype(np.uint32)


def _deal(piece: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:  # (F,) uint32
    """Deal materials to pieces numbered from 0, of which each face (F,) has one."""
    names, sizes = np.unique(piece, return_counts=True)
    rank = np.empty(names.max() + 1, np.int64)
    rank[names[np.argsort(-sizes, kind="stable")]] = np.arange(len(names))
    return ((rank[piece] + int(rng.integers(count))) % count).astype(np.uint32)


def _unit(rng: np.random.Generator) -> np.ndarray:  # (3,)
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def _warp(rng: np.random.Generator, size: float) -> np.ndarray:  # (3, 5): wave vector, phase, amplitude per coordinate
    waves = rng.normal(size=(3, 3)) * 4
    return np.concatenate([waves, rng.uniform(0, 2 * np.pi, (3, 1)), np.full((3, 1), size)], axis=1)


def _displace(position: Any, warp: Any) -> Any:
    """Displace points by one wave per coordinate, so that edges are not planes."""
    moves = [
        _scalar(warp, 5 * k + 4) * dr.sin(dr.dot(_vector(warp, 5 * k), position) + _scalar(warp, 5 * k + 3))
        for k in range(3)
    ]
    return position + mi.Vector3f(*moves)


def _floats(**values: Any) -> dict:
    return {name: table(value) for name, value in values.items()}


def _scalar(values: Any, index: int) -> Any:
    return dr.gather(mi.Float, values, mi.UInt32(index))


def _vector(values: Any, first: int) -> Any:
    return mi.Vector3f(*(_scalar(values, first + k) for k in range(3)))
