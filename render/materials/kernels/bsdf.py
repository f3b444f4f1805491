"""The reflectance model inside Dr.Jit kernels: packed materials.

Importing this module loads mitsuba. The numpy form, slow and plain, is `render.materials.model.evaluate`.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from render.backend.arrays import interleave, packet, packets
from render.backend.jit import dr, mi
from render.materials import model
from render.materials.kernels.lobes import HalfVectorLobes, cell, half_cell
from render.materials.model import Material
from render.shared.errors import InputError

_ROWS, _COLUMNS, _SHADOW = model.HALF_KNOTS, model.DIFFERENCE_KNOTS, model.SHADOWING_KNOTS
_ROW = 8  # floats of an entry of `PackedMaterials.rows`


class Coordinates(NamedTuple):
    """What evaluation needs of a pair of directions, for any material; from `PackedMaterials.prepare`."""

    corner: Any  # UInt32, first of the four table entries around (theta_h, theta_d)
    weights: tuple  # 4 Float, bilinear weights of the four entries
    azimuth: Any  # Float, cos^2(phi_d)
    shadow_i: tuple  # (UInt32, Float), cell and fraction of theta_i
    shadow_o: tuple  # (UInt32, Float), cell and fraction of theta_o
    cos_o: Any  # Float, zero where either direction is below the horizon
    active: Any  # Bool


class PackedMaterials(HalfVectorLobes):
    """K materials as flat float32 arrays, for kernels that index them by number.

    Number and values are opaque: exchanging materials, or their number, compiles nothing again. All methods work inside
    symbolic loops and calls, in the local shading frame (z is the normal), with `index` in [0, K).

    Args:
        materials: At least one material.

    Raises:
        InputError: no material given.
    """

    def __init__(self, materials: Sequence[Material]) -> None:
        if not materials:
            raise InputError("materials: at least one is needed")
        super().__init__(tuple(material.name for material in materials), list(materials))
        self.tables = packets(np.stack([_pack_tables(material) for material in materials]))
        self.shadowing = packets(np.stack([_pack_shadowing(material) for material in materials]))

    @staticmethod
    def prepare(wi: "mi.Vector3f", wo: "mi.Vector3f", active: "mi.Bool | bool" = True) -> Coordinates:
        """Compute the part of an evaluation that all materials share: cells and weights of the tables."""
        active = mi.Bool(active) & (wi.z > 0) & (wo.z > 0)
        half = dr.normalize(wi + wo)
        sin2_h = dr.fma(half.x, half.x, half.y * half.y)
        cos_d = dr.minimum(dr.dot(wi, half), 1)
        row, a = half_cell(sin2_h, half.z)
        column, b = _difference_cell(cos_d)
        return Coordinates(
            corner=dr.fma(row, _COLUMNS, column),
            weights=((1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b),
            azimuth=azimuth(wi.z, wo.z, sin2_h, cos_d),
            shadow_i=shadow_cell(wi.z),
            shadow_o=shadow_cell(wo.z),
            cos_o=dr.select(active, wo.z, 0),
            active=active,
        )

    def eval_at(self, index: "mi.UInt32", at: Coordinates) -> "mi.Color3f":
        """Evaluate f cos(theta_o) of the materials `index` at prepared coordinates."""
        base = dr.fma(index, _ROWS * _COLUMNS, at.corner)
        value = mi.Color3f(0)
        for offset, weight in zip((0, 1, _COLUMNS, _COLUMNS + 1), at.weights, strict=True):
            zero, one = _two_colours(self.tables, base + offset, at.active)
            value += weight * dr.fma(at.azimuth, one - zero, zero)
        for place in (at.shadow_i, at.shadow_o):
            value *= self.shadow(index, place, at.active)
        return value * at.cos_o

    def shadow(self, index: "mi.UInt32", cell: tuple, active: "mi.Bool | bool" = True) -> "mi.Color3f":
        """Return the factor S of the materials `index` at a `shadow_cell`."""
        lower, slope = _two_colours(self.shadowing, dr.fma(index, _SHADOW - 1, cell[0]), active)
        return dr.fma(cell[1], slope, lower)

    def rows(self, index: "mi.UInt32", wi: "mi.Vector3f", directions: "mi.Vector3f") -> "mi.Float":
        """Reduce the table of one material to a row over theta_h for each of L light directions seen from one side.

        Args:
            index: The material.
            wi: (1) unit vector to the viewer.
            directions: (L) unit vectors to the lights, any common frame.

        Returns:
            Flat Float array (L * 32 * 16) for `packet`: RGB at e = 0 and at e = 1, then both of the next theta_h.
        """
        count = dr.width(directions) * _ROWS
        lane = dr.arange(mi.UInt32, count)
        light = lane // _ROWS
        direction = dr.gather(mi.Vector3f, directions, light)
        column, b = _difference_cell(dr.minimum(dr.dot(wi, dr.normalize(wi + direction)), 1))
        corner = dr.fma(index, _ROWS, lane - light * _ROWS) * _COLUMNS + column
        left, right = (_two_colours(self.tables, corner + offset) for offset in (0, 1))
        values = [left[e][c] + b * (right[e][c] - left[e][c]) for e in range(2) for c in range(3)]
        return interleave(values, _ROW)

    @staticmethod
    def eval_row(rows: "mi.Float", light: "mi.UInt32", cell: tuple, azimuth: "mi.Float") -> "mi.Color3f":
        """Evaluate T in the rows of `rows` at a `half_cell`, without the factors S and the cosine."""
        entry = light * _ROWS + cell[0]
        lower, upper = packet(rows, entry, _ROW), packet(rows, entry + 1, _ROW)
        ends = [lower[k] + cell[1] * (upper[k] - lower[k]) for k in range(6)]
        return mi.Color3f(*(dr.fma(azimuth, ends[c + 3] - ends[c], ends[c]) for c in range(3)))


def shadow_cell(cosine: "mi.Float") -> tuple:
    """Return the cell and fraction of an elevation for the factor S."""
    return cell(1 - cosine, _SHADOW)


def azimuth(cos_i: "mi.Float", cos_o: "mi.Float", sin2_h: "mi.Float", cos_d: "mi.Float") -> "mi.Float":
    """Return e = cos^2(phi_d) (see `model.coordinates`)."""
    product = sin2_h * (1 - cos_d) * (1 + cos_d)
    return dr.minimum(dr.square(cos_i - cos_o) / (4 * dr.maximum(product, 1e-9)), 1)


def _difference_cell(cos_d: "mi.Float") -> tuple:
    return cell(dr.sqrt(dr.maximum(1 - cos_d, 0)), _COLUMNS)


def _two_colours(source: "mi.Float", entry: "mi.UInt32", active: "mi.Bool | bool" = True) -> tuple:
    """Return the two colours of an entry of eight floats."""
    found = packet(source, entry, 8, active)
    return mi.Color3f(found[0], found[1], found[2]), mi.Color3f(found[4], found[5], found[6])


def _pack_tables(material: Material) -> np.ndarray:
    """Return (32, 6, 2, 4): per knot the RGB table at e = 0 and e = 1, padded to four floats each."""
    both = np.stack(model.azimuth_tables(material))  # (2, 3, 32, 6)
    return np.pad(both.transpose(2, 3, 0, 1), ((0, 0), (0, 0), (0, 0), (0, 1)))


def _pack_shadowing(material: Material) -> np.ndarray:
    """Return (8, 2, 4): per cell RGB at its start and the change over it, padded to four floats each."""
    knots = material.shadowing.T  # (9, 3)
    return np.pad(np.stack([knots[:-1], np.diff(knots, axis=0)], 1), ((0, 0), (0, 0), (0, 1)))
