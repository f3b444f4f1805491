"""The Mitsuba plugin `ps_surface`: any surface of this project under Mitsuba's own integrators.

The slow counterpart of `PackedSurfaces`, for `render.reference`; properties `material` (a surface name), `to_object`
(world to the object's unit sphere) and, for patterns that follow a mesh's pieces, `shape` (its name).
"""

from functools import cache
from typing import Any

import drjit as dr
import numpy as np

from render import shapes, variant
from render.materials import surfaces
from render.materials.packed import PackedSurfaces
from render.materials.patterns import Evaluator

mi = variant.load()


def register() -> None:
    """Register the plugin, once."""
    _plugin()


@cache
def _plugin() -> type:
    mi.register_bsdf("ps_surface", SurfaceBSDF)
    return SurfaceBSDF


class SurfaceBSDF(mi.BSDF):
    """One-sided BSDF sum_k w_k(x) f_k of one surface."""

    def __init__(self, props: "mi.Properties") -> None:
        mi.BSDF.__init__(self, props)
        surface = surfaces.load(props["material"])
        self.packed = PackedSurfaces([surfaces.Surface(surface.name, surface.components)])
        mesh = shapes.load(props["shape"]) if "shape" in props else None
        self.pattern = surface.pattern and Evaluator(surface.pattern, mesh)
        to_object = props.get("to_object", mi.ScalarTransform4f())
        self.to_object = mi.Transform4f(mi.Matrix4f(np.array(to_object.matrix, np.float32)))
        self.m_flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
        self.m_components = [self.m_flags]

    def _weights(self, si: Any) -> list:
        if self.pattern is None:
            return [mi.Float(1)]
        return self.pattern.at(self.to_object @ si.p, si.prim_index)

    def _parts(self, si: Any) -> list:
        families, parts = self.packed.families, self.packed.parts[0]
        return [(families[p.family], mi.UInt32(p.index), w) for p, w in zip(parts, self._weights(si), strict=True)]

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple:
        """Choose a material by its weight, then a direction from its lobes; the weight is f cos / pdf."""
        active &= mi.Frame3f.cos_theta(si.wi) > 0
        wo, reached = mi.Vector3f(0, 0, 1), mi.Float(0)
        for family, index, weight in self._parts(si):
            mine = (sample1 >= reached) & (weight > 0)
            rest = dr.clip((sample1 - reached) / dr.maximum(weight, 1e-9), 0, 1)
            wo = dr.select(mine, family.sample_lobe(index, si.wi, rest, sample2, active & mine), wo)
            reached += weight
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
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Return the density of `sample` per solid angle."""
        return self.eval_pdf(ctx, si, wo, active)[1]

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple:
        """Return both `eval` and `pdf`."""
        value, density = mi.Color3f(0), mi.Float(0)
        for family, index, weight in self._parts(si):
            value += weight * family.eval(index, si.wi, wo, active)
            density += weight * family.pdf(index, si.wi, wo, active)
        return value, density

    def to_string(self) -> str:
        """Name the surface."""
        return f"SurfaceBSDF[material={self.packed.names[0]}]"
