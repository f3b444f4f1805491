"""The Mitsuba plugin `ps_surface`: any surface of this project under Mitsuba's own integrators.

The slow counterpart of `PackedSurfaces`, for `render.kernel.reference`; properties `material` (the name of a
surface, or a file), `to_object` (world to the object's unit sphere) and, for patterns that follow a mesh's pieces,
`shape` (its name).
"""

from functools import cache
from typing import Any

import numpy as np

from render import shapes
from render.backend.jit import dr, mi
from render.materials import surfaces
from render.materials.kernels.packed import PackedSurfaces, cover_of
from render.materials.kernels.patterns import Evaluator
from render.materials.kernels.textures.cover import Place
from render.materials.kernels.textures.gloss import Gloss


@cache
def register() -> None:
    """Register the plugin, once."""
    mi.register_bsdf("ps_surface", SurfaceBSDF)


class SurfaceBSDF(mi.BSDF):
    """One-sided BSDF sum_k w_k(x) f_k of one surface; `mi.traverse` shows the arrays of its packed families."""

    def __init__(self, props: "mi.Properties") -> None:
        mi.BSDF.__init__(self, props)
        surface = surfaces.load(props["material"])
        mesh = shapes.load(props["shape"]) if "shape" in props else None
        self.packed = PackedSurfaces([surfaces.Surface(surface.name, surface.components)], mesh)
        self.cover = cover_of(surface, mesh)
        self.pattern = None if self.cover else surface.pattern and Evaluator(surface.pattern, mesh)
        to_object = props.get("to_object", mi.ScalarTransform4f())
        self.to_object = mi.Transform4f(mi.Matrix4f(np.array(to_object.matrix, np.float32)))
        self.families = self.packed.families
        self.m_flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
        self.m_components = [self.m_flags]

    def parts(self, si: "mi.SurfaceInteraction3f") -> list[tuple]:
        """Return (family, index, weight) of each material at N points; the weights sum to 1."""
        weights = self.pattern.at(self.to_object @ si.p, si.prim_index) if self.pattern else [mi.Float(1)]
        return self._weigh(weights)

    def seen(self, si: "mi.SurfaceInteraction3f") -> tuple[list[tuple], "mi.Frame3f | None"]:
        """Return `parts`, and the frame that a relief turns the shading frame into, in its coordinates, or None."""
        if self.cover is None:
            return self.parts(si), None
        normal = dr.normalize(mi.Vector3f(self.to_object @ mi.Vector3f(si.sh_frame.n)))
        towards = dr.normalize(mi.Vector3f(self.to_object @ si.to_world(si.wi)))
        # `build_mesh` gives Mitsuba no texture coordinates, for which it takes the barycentric ones.
        place = Place(mi.Vector3f(self.to_object @ si.p), normal, si.prim_index, mi.Point2f(si.uv))
        values, moved = self.cover.at(place, towards)
        world = dr.normalize(mi.Vector3f(self.to_object.inverse() @ moved))
        frame = mi.Frame3f(dr.normalize(si.to_local(world)))
        if not self.packed.parts[0]:
            return [(Gloss(values), mi.UInt32(0), mi.Float(1))], frame
        return self._weigh(values), frame

    def _weigh(self, weights: list) -> list[tuple]:
        places = self.packed.parts[0]
        return [(self.families[p.family], mi.UInt32(p.member), w) for p, w in zip(places, weights, strict=True)]

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple:
        """Choose a material by its weight, then a direction from its lobes; the weight is f cos / pdf of the sum."""
        active &= mi.Frame3f.cos_theta(si.wi) > 0
        parts, frame = self.seen(si)
        wi = _local(frame, si.wi)
        wo, reached = mi.Vector3f(0, 0, 1), mi.Float(0)
        for family, index, weight in parts:
            mine = (sample1 >= reached) & (weight > 0)
            rest = dr.clip((sample1 - reached) / dr.maximum(weight, 1e-9), 0, 1)
            wo = dr.select(mine, family.sample_lobe(index, wi, rest, sample2, active & mine), wo)
            reached += weight
        wo = wo if frame is None else frame.to_world(wo)
        value, density = _eval(parts, frame, si, wo, active), _pdf(parts, frame, si, wo, active)
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
        return _eval(*self.seen(si), si, wo, active)

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Return the density of `sample` per solid angle."""
        return _pdf(*self.seen(si), si, wo, active)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple:
        """Return both `eval` and `pdf`."""
        parts, frame = self.seen(si)
        return _eval(parts, frame, si, wo, active), _pdf(parts, frame, si, wo, active)

    def traverse(self, callback: Any) -> None:
        """Expose the families' arrays."""
        for number, family in enumerate(self.families):
            prefix = f"family{number}_" if len(self.families) > 1 else ""
            for name, value in vars(family).items():
                if isinstance(value, mi.Float):
                    callback.put(prefix + name, value, mi.ParamFlags.NonDifferentiable)

    def to_string(self) -> str:
        """Name the surface."""
        return f"SurfaceBSDF[material={self.packed.names[0]}]"


def _local(frame: Any, direction: Any) -> Any:
    return direction if frame is None else frame.to_local(direction)


def _eval(parts: list[tuple], frame: Any, si: Any, wo: Any, active: Any) -> "mi.Color3f":
    total = mi.Color3f(0)
    for family, index, weight in parts:
        total += weight * family.eval(index, _local(frame, si.wi), _local(frame, wo), active & _above(frame, si, wo))
    return total


def _pdf(parts: list[tuple], frame: Any, si: Any, wo: Any, active: Any) -> "mi.Float":
    total = mi.Float(0)
    for family, index, weight in parts:
        total += weight * family.pdf(index, _local(frame, si.wi), _local(frame, wo), active & _above(frame, si, wo))
    return total


def _above(frame: Any, si: Any, wo: Any) -> Any:
    """Where there is a relief, both directions must be above the surface that carries it too."""
    return mi.Bool(True) if frame is None else (mi.Frame3f.cos_theta(si.wi) > 0) & (mi.Frame3f.cos_theta(wo) > 0)
