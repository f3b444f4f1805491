"""MERL tables inside Dr.Jit kernels: packed tables.

Importing this module loads mitsuba. The numpy form, slow and plain, is `render.materials.merl.evaluate`.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from render.backend.arrays import packet, packets
from render.backend.jit import dr, mi
from render.materials import merl, model
from render.materials.kernels.lobes import HalfVectorLobes
from render.materials.merl import MerlTable
from render.materials.model import Material
from render.shared.errors import InputError

_CELLS_H, _CELLS_D, _CELLS_P = merl.SHAPE
_STEP_D = _CELLS_P  # entries from one knot of theta_d to the next
_STEP_H = (_CELLS_D + 1) * _STEP_D
_ENTRIES = (_CELLS_H + 1) * _STEP_H
MOST_TABLES = ((1 << 32) - 1) // (4 * _ENTRIES)  # the array is indexed by 32 bits; 24 MB a table


class MerlCoordinates(NamedTuple):
    """What evaluation needs of a pair of directions, for any table; from `PackedMerl.prepare`."""

    entries: tuple  # 2 UInt32, first of the four knots around (theta_h, theta_d) at either of two cells of phi_d
    weights: tuple  # 4 Float, bilinear weights of the four knots
    fraction: Any  # Float, weight of the second cell of phi_d
    cos_o: Any  # Float, zero where either direction is below the horizon
    active: Any  # Bool


class PackedMerl(HalfVectorLobes):
    """K MERL tables as one flat float32 array, for kernels that index them by number.

    Number and values are opaque: exchanging tables, or their number, compiles nothing again. The methods are used as
    those of `PackedMaterials`; sampling and density are the same ones, of a cosine lobe mixed with a lobe of half
    vectors, which is tabulated from each table.

    Args:
        tables: At least one, at most `MOST_TABLES`.

    Raises:
        InputError: no table given, or more than 32-bit indices reach.
    """

    def __init__(self, tables: Sequence[MerlTable]) -> None:
        if not 0 < len(tables) <= MOST_TABLES:
            raise InputError(f"materials: 1 to {MOST_TABLES} MERL tables can be packed together, got {len(tables)}")
        super().__init__(tuple(one.name for one in tables), [coarse_form(one) for one in tables])
        packed = np.zeros((len(tables), _ENTRIES, 4), np.float32)
        for slot, merl_table in zip(packed, tables, strict=True):
            slot[:, :3] = merl.knots(merl_table.values).reshape(3, -1).T
        self.tables = packets(packed)

    @staticmethod
    def prepare(wi: "mi.Vector3f", wo: "mi.Vector3f", active: "mi.Bool | bool" = True) -> MerlCoordinates:
        """Compute the part of an evaluation that all tables share: knots and weights, as `merl.evaluate` does."""
        active = mi.Bool(active) & (wi.z > 0) & (wo.z > 0)
        total = wi + wo
        length = dr.norm(total)
        theta_h = dr.atan2(dr.norm(mi.Vector2f(total.x, total.y)), total.z)
        theta_d = dr.atan2(dr.norm(wi - wo), length)
        x, y = length * (wo.z - wi.z), 2 * (wi.y * wo.x - wi.x * wo.y)
        phi_d = dr.atan2(dr.abs(y), dr.select(y < 0, -x, x))
        row, a = _cell(dr.sqrt(theta_h * (2 / dr.pi)), _CELLS_H)
        column, b = _cell(theta_d * (2 / dr.pi), _CELLS_D)
        position = phi_d * (_CELLS_P / dr.pi) - 0.5
        position = dr.select(position < 0, position + _CELLS_P, position)
        cell = dr.minimum(mi.UInt32(position), _CELLS_P - 1)
        corner = row * _STEP_H + column * _STEP_D
        return MerlCoordinates(
            entries=(corner + cell, corner + dr.select(cell == _CELLS_P - 1, 0, cell + 1)),
            weights=((1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b),
            fraction=dr.clip(position - mi.Float(cell), 0, 1),
            cos_o=dr.select(active, wo.z, 0),
            active=active,
        )

    def eval_at(self, index: "mi.UInt32", at: MerlCoordinates) -> "mi.Color3f":
        """Evaluate f cos(theta_o) of the tables `index` at prepared coordinates."""
        first, second = (index * _ENTRIES + entry for entry in at.entries)
        value = mi.Color3f(0)
        for offset, weight in zip((0, _STEP_D, _STEP_H, _STEP_H + _STEP_D), at.weights, strict=True):
            zero, one = (packet(self.tables, entry + offset, 4, at.active) for entry in (first, second))
            value += weight * mi.Color3f(*(dr.fma(at.fraction, one[c] - zero[c], zero[c]) for c in range(3)))
        return value * at.cos_o


def coarse_form(table: MerlTable) -> Material:
    """Return the mean of a table over phi_d at the knots of the project's model, without shadowing or azimuth.

    It is what importance sampling and the share of light in a narrow highlight are read from.
    """
    theta_h = np.arccos(1 - model.half_knots())
    theta_d = np.arccos(1 - np.linspace(0, 1, model.DIFFERENCE_KNOTS) ** 2)
    return Material(
        name=table.name,
        category=table.category,
        bivariate=merl.bivariate(table, theta_h, theta_d),
        shadowing=np.ones((3, model.SHADOWING_KNOTS)),
        azimuth=np.zeros((3, *(count - 1 for count in model.AZIMUTH_KNOTS))),
    )


def _cell(coordinate: "mi.Float", cells: int) -> tuple:
    """Return the first knot about `coordinate` and the weight of the second, as `merl._cell`."""
    position = coordinate * cells - 0.5
    position = dr.clip(dr.minimum(2 * position + 1, position + 1), 0, cells)
    index = dr.minimum(mi.UInt32(position), cells - 1)
    return index, position - mi.Float(index)
