"""The reflectance of textured materials in a kernel; the numpy form is `render.materials.textures.microfacet`."""

from functools import cache
from typing import Any, NamedTuple

from render.backend.arrays import table
from render.backend.jit import dr, mi
from render.materials import model
from render.materials.textures import microfacet

_COLUMNS, _ROWS = microfacet.COSINES, microfacet.ROUGHNESSES


class Appearance(NamedTuple):
    """What a texture says of N points."""

    base: Any  # Color3f (N), linear, in [0, 1]
    roughness: Any  # Float (N)
    metallic: Any  # Float (N)


class Gloss:
    """The BRDF at N points seen from one direction each; a packed family with one material per lane.

    All methods work in the local shading frame (z is the normal); `index` is not used.

    Args:
        values: The 12 Float (N) of `prepare`.
    """

    COUNT = 12

    def __init__(self, values: Any) -> None:
        square, row, share = values[:3]
        self._square, self._row, self._share = square, row, share
        self._zero, self._diffuse, self._again = (mi.Color3f(*values[k : k + 3]) for k in (3, 6, 9))

    @classmethod
    def prepare(cls, appearance: Appearance, cosine: Any) -> list:
        """Return, unevaluated, all that does not depend on the light.

        Args:
            appearance: Of N points.
            cosine: Float (N), of the angle to the viewer.
        """
        metal, base = dr.clip(appearance.metallic, 0, 1), appearance.base
        base = mi.Color3f(*(dr.clip(channel, 0, 1) for channel in base))
        rough = dr.clip(appearance.roughness, microfacet.SMOOTHEST, microfacet.ROUGHEST)
        row = (rough - microfacet.SMOOTHEST) * ((_ROWS - 1) / (microfacet.ROUGHEST - microfacet.SMOOTHEST))
        coat, single = _interpolate_loss(row, cosine)
        mean_coat, mean_single = _mean(row)
        average = base + (1 - base) * (1 / 21)
        repeated = dr.square(average) * (1 - mean_single) / (1 - average * mean_single)
        zero = dr.lerp(mi.Color3f(microfacet.DIELECTRIC), base, metal)
        diffuse = base * ((1 - metal) * coat / mean_coat * dr.inv_pi)
        again = repeated * (metal * single / mean_single * dr.inv_pi)
        # The lobe's share of what is reflected in this direction, up to what Schlick's term adds near grazing.
        mirrored = _luminance(zero + (1 - zero) * _fifth(1 - dr.clip(cosine, 0, 1))) * (1 - single)
        rest = _luminance(diffuse * mean_coat + again * mean_single) * dr.pi
        share = dr.clip(mirrored / dr.maximum(mirrored + rest, 1e-6), 0.1, 0.95)
        return [dr.square(dr.square(rough)), row, share, *zero, *diffuse, *again]

    def eval(self, index: Any, wi: Any, wo: Any, active: Any = True) -> "mi.Color3f":
        """Evaluate f cos(theta_o), zero where either direction is below the horizon."""
        active = mi.Bool(active) & (wi.z > 0) & (wo.z > 0)
        ci, co = dr.maximum(wi.z, 1e-6), dr.maximum(wo.z, 1e-6)
        half = dr.normalize(wi + wo)
        smith = 0.5 / (co * self._slope(ci) + ci * self._slope(co))
        fresnel = _fifth(1 - dr.clip(dr.dot(wi, half), 0, 1))
        value = (self._zero + (1 - self._zero) * fresnel) * (self._density(half) * smith)
        coat, single = _interpolate_loss(self._row, co)
        value += self._diffuse * coat + self._again * single
        return dr.select(active, value * co, 0)

    def sample_lobe(self, index: Any, wi: Any, sample1: Any, sample2: Any, active: Any = True) -> "mi.Vector3f":
        """Draw `wo` from the mixture of visible half vectors (Dupuy and Benyoub 2023) and the cosine."""
        alpha = dr.sqrt(self._square)
        stretched = dr.normalize(mi.Vector3f(alpha * wi.x, alpha * wi.y, wi.z))
        z = (1 - sample2.y) * (1 + stretched.z) - stretched.z
        sine, cosine = dr.sincos(dr.two_pi * sample2.x)
        ring = dr.sqrt(dr.clip(1 - z * z, 0, 1))
        drawn = mi.Vector3f(ring * cosine, ring * sine, z) + stretched
        half = dr.normalize(mi.Vector3f(alpha * drawn.x, alpha * drawn.y, drawn.z))
        mirrored = dr.normalize(2 * dr.dot(wi, half) * half - wi)
        return dr.select(sample1 < self._share, mirrored, mi.warp.square_to_cosine_hemisphere(sample2))

    def pdf(self, index: Any, wi: Any, wo: Any, active: Any = True) -> "mi.Float":
        """Return the density per solid angle with which `sample_lobe` draws `wo`; zero below the horizon."""
        active = mi.Bool(active) & (wi.z > 0) & (wo.z > 0)
        ci = dr.maximum(wi.z, 1e-6)
        visible = self._density(dr.normalize(wi + wo)) / (2 * (ci + self._slope(ci)))
        return dr.select(active, dr.lerp(wo.z * dr.inv_pi, visible, self._share), 0)

    def _density(self, half: Any) -> Any:
        """Return D; sin^2 is taken from the tangential length, which float32 keeps near the normal."""
        sin2 = dr.fma(half.x, half.x, half.y * half.y)
        return self._square * dr.inv_pi / dr.square(dr.fma(self._square - 1, 1 - sin2, 1))

    def _slope(self, cosine: Any) -> Any:
        return dr.sqrt(dr.fma(1 - self._square, dr.square(cosine), self._square))


def _fifth(value: Any) -> Any:
    return dr.square(dr.square(value)) * value


def _luminance(colour: Any) -> Any:
    red, green, blue = (float(weight) for weight in model.LUMINANCE)
    return red * colour.x + green * colour.y + blue * colour.z


@cache
def _tables() -> tuple:
    """Return `microfacet.tables` for gathers; as (R, C, 2) and (R, 2)."""
    return tuple(table(values) for values in microfacet.tables())


def _interpolate_loss(row: Any, cosine: Any) -> list:
    """Interpolate T_d and T_s at a fractional row and a cosine."""
    values, _ = _tables()
    first = dr.minimum(mi.UInt32(row), _ROWS - 2)
    position = dr.clip(cosine, 0, 1) * (_COLUMNS - 1)
    column = dr.minimum(mi.UInt32(position), _COLUMNS - 2)
    a, b = row - mi.Float(first), position - mi.Float(column)
    at = 2 * dr.fma(first, _COLUMNS, column)
    corners = [[dr.gather(mi.Float, values, at + 2 * (k * _COLUMNS + j) + c) for c in (0, 1)]
               for k in (0, 1) for j in (0, 1)]  # fmt: skip
    return [
        dr.lerp(dr.lerp(corners[0][c], corners[1][c], b), dr.lerp(corners[2][c], corners[3][c], b), a) for c in (0, 1)
    ]


def _mean(row: Any) -> list:
    _, values = _tables()
    first = dr.minimum(mi.UInt32(row), _ROWS - 2)
    return [
        dr.lerp(dr.gather(mi.Float, values, 2 * first + c), dr.gather(mi.Float, values, 2 * first + 2 + c),
                row - mi.Float(first))
        for c in (0, 1)
    ]  # fmt: skip
