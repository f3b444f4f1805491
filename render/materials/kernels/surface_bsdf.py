"""The Mitsuba plugin `ps_surface`: any surface of this project under Mitsuba's own integrators.

The slow counterpart of `PackedSurfaces`, for `render.kernel.reference`; properties `material` (a surface name),
`to_object` (world to the object's unit sphere) and, for patterns that follow a mesh's pieces, `shape` (its name).
"""

import numpy as np

from render import shapes
from render.backend.jit import dr, mi
from render.materials import surfaces
from render.materials.kernels import plugin
from render.materials.kernels.packed import PackedSurfaces, cover_of
from render.materials.kernels.patterns import Evaluator
from render.materials.kernels.plugin import FamilyBSDF
from render.materials.kernels.textures.cover import Place
from render.materials.kernels.textures.gloss import Gloss


def register() -> None:
    """Register the plugin, once."""
    plugin.register("ps_surface", SurfaceBSDF)


class SurfaceBSDF(FamilyBSDF):
    """One-sided BSDF sum_k w_k(x) f_k of one surface."""

    def __init__(self, props: "mi.Properties") -> None:
        surface = surfaces.load(props["material"])
        mesh = shapes.load(props["shape"]) if "shape" in props else None
        self.packed = PackedSurfaces([surfaces.Surface(surface.name, surface.components)], mesh)
        self.cover = cover_of(surface, mesh)
        self.pattern = None if self.cover else surface.pattern and Evaluator(surface.pattern, mesh)
        to_object = props.get("to_object", mi.ScalarTransform4f())
        self.to_object = mi.Transform4f(mi.Matrix4f(np.array(to_object.matrix, np.float32)))
        super().__init__(props, self.packed.families)

    def parts(self, si: "mi.SurfaceInteraction3f") -> list[tuple]:
        """Return (family, index, weight) of each material where the pattern is evaluated."""
        weights = self.pattern.at(self.to_object @ si.p, si.prim_index) if self.pattern else [mi.Float(1)]
        return self._weighted(weights)

    def seen(self, si: "mi.SurfaceInteraction3f") -> tuple[list[tuple], "mi.Frame3f | None"]:
        """Return `parts` and the frame of the relief."""
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
        return self._weighted(values), frame

    def _weighted(self, weights: list) -> list[tuple]:
        places = self.packed.parts[0]
        return [(self.families[p.family], mi.UInt32(p.member), w) for p, w in zip(places, weights, strict=True)]

    def to_string(self) -> str:
        """Name the surface."""
        return f"SurfaceBSDF[material={self.packed.names[0]}]"
