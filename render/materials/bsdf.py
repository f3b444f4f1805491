"""The reflectance model inside Dr.Jit kernels: packed materials, and the Mitsuba plugin `ps_material`.

Importing this module loads mitsuba. The numpy form, slow and plain, is `render.materials.model.evaluate`.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import drjit as dr
import numpy as np

from render import variant
from render.errors import InputError
from render.materials import highlight, model
from render.materials.library import load
from render.materials.model import Material

mi = variant.load()

_ROWS, _COLUMNS, _SHADOW = model.HALF_KNOTS, model.DIFFERENCE_KNOTS, model.SHADOWING_KNOTS
_LOBE = model.HALF_KNOTS + 1  # lobe probability, then the cumulative distribution at the knots of theta_h


class Coordinates(NamedTuple):
    """What evaluation needs of a pair of directions, whatever the material; from `PackedMaterials.prepare`."""

    corner: Any  # UInt32, first of the four table entries around (theta_h, theta_d)
    weights: tuple  # 4 Float, bilinear weights of the four entries
    azimuth: Any  # Float, cos^2(phi_d)
    shadow_i: tuple  # (UInt32, Float), cell and fraction of theta_i
    shadow_o: tuple  # (UInt32, Float), cell and fraction of theta_o
    cos_o: Any  # Float, zero where either direction is below the horizon
    active: Any  # Bool


class PackedMaterials:
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
        self.names = tuple(material.name for material in materials)
        self.highlight = np.array([narrow_share(material) for material in materials])
        self.tables = upload(np.stack([_packed_tables(material) for material in materials]))
        self.shadowing = upload(np.stack([_packed_shadowing(material) for material in materials]))
        self.lobes = upload(np.stack([lobe_distribution(material) for material in materials]))

    def __len__(self) -> int:
        return len(self.names)

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
        base = 2 * dr.fma(index, _ROWS * _COLUMNS, at.corner)
        value = mi.Color3f(0)
        for offset, weight in zip((0, 1, _COLUMNS, _COLUMNS + 1), at.weights, strict=True):
            zero = load_rgb(self.tables, base + 2 * offset, at.active)
            one = load_rgb(self.tables, base + 2 * offset + 1, at.active)
            value += weight * dr.fma(at.azimuth, one - zero, zero)
        for cell in (at.shadow_i, at.shadow_o):
            value *= self.shadow(index, cell, at.active)
        return value * at.cos_o

    def shadow(self, index: "mi.UInt32", cell: tuple, active: "mi.Bool | bool" = True) -> "mi.Color3f":
        """Return the factor S of the materials `index` at a `shadow_cell`."""
        entry = 2 * dr.fma(index, _SHADOW - 1, cell[0])
        lower = load_rgb(self.shadowing, entry, mi.Bool(active))
        slope = load_rgb(self.shadowing, entry + 1, mi.Bool(active))
        return dr.fma(cell[1], slope, lower)

    def rows(self, index: "mi.UInt32", wi: "mi.Vector3f", directions: "mi.Vector3f") -> list:
        """Reduce the table of one material to a row over theta_h for each of L light directions seen from one side.

        Args:
            index: The material.
            wi: (1) unit vector to the viewer.
            directions: (L) unit vectors to the lights, any common frame.

        Returns:
            Six Float arrays (L * 32): RGB at e = 0, then RGB at e = 1.
        """
        lane = dr.arange(mi.UInt32, dr.width(directions) * _ROWS)
        light = lane // _ROWS
        direction = dr.gather(mi.Vector3f, directions, light)
        column, b = _difference_cell(dr.minimum(dr.dot(wi, dr.normalize(wi + direction)), 1))
        corner = 2 * (dr.fma(index, _ROWS, lane - light * _ROWS) * _COLUMNS + column)
        values = []
        for azimuth_end in range(2):
            left = load_rgb(self.tables, corner + azimuth_end, mi.Bool(True))
            right = load_rgb(self.tables, corner + azimuth_end + 2, mi.Bool(True))
            values += [left[c] + b * (right[c] - left[c]) for c in range(3)]
        dr.eval(values)
        return values

    @staticmethod
    def eval_row(rows: list, light: "mi.UInt32", cell: tuple, azimuth: "mi.Float") -> "mi.Color3f":
        """Evaluate T in the rows of `rows` at a `half_cell`, without the factors S and the cosine."""
        entry = light * _ROWS + cell[0]
        lower = [dr.gather(mi.Float, row, entry) for row in rows]
        upper = [dr.gather(mi.Float, row, entry + 1) for row in rows]
        ends = [low + cell[1] * (high - low) for low, high in zip(lower, upper, strict=True)]
        return mi.Color3f(*(dr.fma(azimuth, ends[c + 3] - ends[c], ends[c]) for c in range(3)))

    def shadow_row(self, index: "mi.UInt32") -> list:
        """Return the factor S of one material as six short Float arrays (8): RGB at the cells, and its change."""
        entry = 2 * dr.fma(index, _SHADOW - 1, dr.arange(mi.UInt32, _SHADOW - 1))
        values = [*load_rgb(self.shadowing, entry, mi.Bool(True)), *load_rgb(self.shadowing, entry + 1, mi.Bool(True))]
        dr.eval(values)
        return values

    @staticmethod
    def eval_shadow(row: list, cell: tuple) -> "mi.Color3f":
        """Evaluate S in a `shadow_row` at a `shadow_cell`."""
        values = [dr.gather(mi.Float, entry, cell[0]) for entry in row]
        return mi.Color3f(*(dr.fma(cell[1], values[c + 3], values[c]) for c in range(3)))

    def eval(
        self, index: "mi.UInt32", wi: "mi.Vector3f", wo: "mi.Vector3f", active: "mi.Bool | bool" = True
    ) -> "mi.Color3f":
        """Evaluate f cos(theta_o), zero where either direction is below the horizon.

        Args:
            index: Material numbers.
            wi: Unit vectors to the camera (or the previous vertex).
            wo: Unit vectors to the light, which carries the cosine.
            active: Lanes to evaluate.
        """
        return self.eval_at(index, self.prepare(wi, wo, active))

    def sample_lobe(
        self,
        index: "mi.UInt32",
        wi: "mi.Vector3f",
        sample1: "mi.Float",
        sample2: "mi.Point2f",
        active: "mi.Bool | bool" = True,
    ) -> "mi.Vector3f":
        """Draw `wo` from the material's mixture of a cosine lobe and a tabulated lobe of half vectors.

        Directions drawn below the horizon are returned as they are: `eval` and `pdf` are zero there.

        Args:
            index: Material numbers.
            wi: Unit vectors to the camera.
            sample1: Uniform variate, chooses the lobe.
            sample2: Two uniform variates, choose the direction.
            active: Lanes to sample.
        """
        active = mi.Bool(active)
        start = index * _LOBE
        probability = dr.gather(mi.Float, self.lobes, start, active)
        cell = dr.binary_search(
            0, _ROWS - 2, lambda k: dr.gather(mi.Float, self.lobes, start + 2 + k, active) <= sample2.x
        )
        low = dr.gather(mi.Float, self.lobes, start + 1 + cell, active)
        high = dr.gather(mi.Float, self.lobes, start + 2 + cell, active)
        fraction = dr.clip((sample2.x - low) / dr.maximum(high - low, 1e-12), 0, 1)
        height = dr.lerp(_knot(cell), _knot(cell + 1), fraction)  # 1 - cos(theta_h)
        sine, cosine = dr.sincos(dr.two_pi * sample2.y)
        sin_h = dr.sqrt(dr.maximum(height * (2 - height), 0))
        half = mi.Vector3f(sin_h * cosine, sin_h * sine, 1 - height)
        reflected = dr.normalize(2 * dr.dot(wi, half) * half - wi)
        return dr.select(sample1 < probability, reflected, mi.warp.square_to_cosine_hemisphere(sample2))

    def pdf(
        self, index: "mi.UInt32", wi: "mi.Vector3f", wo: "mi.Vector3f", active: "mi.Bool | bool" = True
    ) -> "mi.Float":
        """Return the density per solid angle with which `sample_lobe` draws `wo`; zero below the horizon."""
        active = mi.Bool(active) & (wi.z > 0) & (wo.z > 0)
        half = dr.normalize(wi + wo)
        cell, _ = half_cell(dr.fma(half.x, half.x, half.y * half.y), half.z)
        start = index * _LOBE
        probability = dr.gather(mi.Float, self.lobes, start, active)
        low = dr.gather(mi.Float, self.lobes, start + 1 + cell, active)
        high = dr.gather(mi.Float, self.lobes, start + 2 + cell, active)
        lobe = (high - low) / (dr.two_pi * (_knot(cell + 1) - _knot(cell)) * 4 * dr.maximum(dr.dot(wi, half), 1e-8))
        return dr.select(active, dr.lerp(wo.z * dr.inv_pi, lobe, probability), 0)


def half_cell(sin2_h: "mi.Float", cos_h: "mi.Float") -> tuple:
    """Return the cell and fraction of theta_h; its sine is what float32 keeps exact near zero."""
    root = dr.sqrt(dr.sqrt(dr.minimum(sin2_h / (1 + dr.maximum(cos_h, 0)), 1)))
    return _cell(2 * root / (1 + root), _ROWS)


def shadow_cell(cosine: "mi.Float") -> tuple:
    """Return the cell and fraction of an elevation for the factor S."""
    return _cell(1 - cosine, _SHADOW)


def azimuth(cos_i: "mi.Float", cos_o: "mi.Float", sin2_h: "mi.Float", cos_d: "mi.Float") -> "mi.Float":
    """Return e = cos^2(phi_d) (see `model.coordinates`)."""
    product = sin2_h * (1 - cos_d) * (1 + cos_d)
    return dr.minimum(dr.square(cos_i - cos_o) / (4 * dr.maximum(product, 1e-9)), 1)


def _difference_cell(cos_d: "mi.Float") -> tuple:
    return _cell(dr.sqrt(dr.maximum(1 - cos_d, 0)), _COLUMNS)


def load_rgb(source: "mi.Float", entry: "mi.UInt32", active: "mi.Bool") -> "mi.Color3f":
    """Load one RGB entry of four floats.

    One packet load on the GPU. On the CPU three plain loads, which are as fast: Dr.Jit compiles a packet load into
    different code by the alignment of the array, so kernels would be compiled again for other materials.
    """
    if dr.backend_v(mi.Float) == dr.JitBackend.CUDA:
        packet = dr.gather(mi.Vector4f, source, entry, active)
        return mi.Color3f(packet.x, packet.y, packet.z)
    return mi.Color3f(*(dr.gather(mi.Float, source, 4 * entry + channel, active) for channel in range(3)))


def lobe_distribution(material: Material) -> np.ndarray:
    """Return the (33,) sampling table: probability of the half-vector lobe, then its distribution at the 32 knots.

    The lobe is the luminance of T at small theta_d over its floor at moderate theta_h, constant per solid angle inside
    a cell; its probability is its share of an estimate of the albedo, and zero for a material without a highlight.
    """
    luminance = np.array([0.2126, 0.7152, 0.0722]) @ material.bivariate[:, :, :4].mean(2)  # (32,)
    height = model.half_knots()
    floor = luminance[height < 0.5].min()
    excess = np.maximum(luminance - floor, 0)
    mass = (excess[:-1] + excess[1:]) / 2 * (np.diff(height) - np.diff(height**2) / 2)  # over cos(theta_h) d(cos)
    lobe = 8 * np.pi * mass.sum()
    probability = lobe / max(lobe + np.pi * floor, 1e-12)
    if probability < 0.01:
        return np.concatenate([[0.0], np.linspace(0, 1, len(height))])
    return np.concatenate([[min(probability, 0.9)], [0.0], np.cumsum(mass) / mass.sum()])


def narrow_share(material: Material) -> float:
    """Return the share of its light that a narrow highlight reflects (see `highlight.share`)."""
    luminance = np.array([0.2126, 0.7152, 0.0722]) @ material.bivariate[:, :, :4].mean(2)
    return highlight.share(np.arccos(1 - model.half_knots()), luminance)


def register() -> None:
    """Register the Mitsuba BSDF plugin `ps_material` (property `material`: a library name or a YAML path), once."""
    _plugin()


@cache
def _plugin() -> type:
    mi.register_bsdf("ps_material", MERLFitBSDF)
    return MERLFitBSDF


class MERLFitBSDF(mi.BSDF):
    """One-sided Mitsuba BSDF of one `Material`, e.g. `{'type': 'ps_material', 'material': 'chrome'}`."""

    def __init__(self, props: "mi.Properties") -> None:
        mi.BSDF.__init__(self, props)
        self.material = load(props["material"])
        self.packed = PackedMaterials([self.material])
        flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
        self.m_components = [flags]
        self.m_flags = flags

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple:
        """Draw a direction; the weight is f cos / pdf (Mitsuba's `BSDF.sample`)."""
        active &= mi.Frame3f.cos_theta(si.wi) > 0
        wo = self.packed.sample_lobe(mi.UInt32(0), si.wi, sample1, sample2, active)
        value, density = self.eval_pdf(ctx, si, wo, active)
        valid = active & (density > 0)
        sample = dr.zeros(mi.BSDFSample3f, dr.width(density))
        sample.wo = wo
        sample.pdf = dr.select(valid, density, 0)
        sample.eta = 1.0
        sample.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
        sample.sampled_component = mi.UInt32(0)
        return sample, dr.select(valid, value / density, 0)

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Return f cos(theta_o)."""
        return self.packed.eval(mi.UInt32(0), si.wi, wo, active)

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Return the density of `sample` per solid angle."""
        return self.packed.pdf(mi.UInt32(0), si.wi, wo, active)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple:
        """Return both `eval` and `pdf`."""
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    def traverse(self, callback: Any) -> None:
        """Expose the packed tables."""
        for name in ("tables", "shadowing", "lobes"):
            callback.put(name, getattr(self.packed, name), mi.ParamFlags.NonDifferentiable)

    def to_string(self) -> str:
        """Name the material."""
        return f"MERLFitBSDF[material={self.material.name}]"


def _packed_tables(material: Material) -> np.ndarray:
    """Return (32, 6, 2, 4): per knot the RGB table at e = 0 and e = 1, padded to four floats each."""
    both = np.stack(model.azimuth_tables(material))  # (2, 3, 32, 6)
    return np.pad(both.transpose(2, 3, 0, 1), ((0, 0), (0, 0), (0, 0), (0, 1)))


def _packed_shadowing(material: Material) -> np.ndarray:
    """Return (8, 2, 4): per cell RGB at its start and the change over it, padded to four floats each."""
    knots = material.shadowing.T  # (9, 3)
    return np.pad(np.stack([knots[:-1], np.diff(knots, axis=0)], 1), ((0, 0), (0, 0), (0, 1)))


def upload(values: np.ndarray) -> "mi.Float":
    """Upload as a flat float32 array that kernels see as data, not as a literal."""
    array = mi.Float(np.ascontiguousarray(values, np.float32).ravel())
    dr.make_opaque(array)
    return array


def _cell(coordinate: "mi.Float", knots: int) -> tuple:
    """Return the cell of `coordinate` in [0, 1] among uniform knots, and the fraction inside it."""
    position = dr.clip(coordinate, 0, 1) * (knots - 1)
    index = dr.minimum(mi.UInt32(position), knots - 2)
    return index, position - mi.Float(index)


def _knot(index: "mi.UInt32") -> "mi.Float":
    """Return 1 - cos(theta_h) at a knot, as `model.half_knots`."""
    x = mi.Float(index) / (_ROWS - 1)
    root = x / (2 - x)
    return dr.square(dr.square(root))
