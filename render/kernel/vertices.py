"""The vertices of camera paths, depth by depth."""

from dataclasses import dataclass
from typing import Any

from render.backend.jit import dr


@dataclass(frozen=True)
class Vertices:
    """Path vertices of one depth, sorted by pixel; all arrays are Dr.Jit, in the object frame.

    `bitmask` is the visibility bitmask: bit b of entry `w * N + i` says whether vertex i sees light 32 w + b.
    It is None until it is asked for, as those of a composition are after all paths have ended.
    """

    count: int
    position: Any  # Point3f (N)
    normal: Any  # Vector3f (N), shading normal
    facet: Any  # Vector3f (N), normal of the triangle
    wi: Any  # Vector3f (N, or 1 at an orthographic camera's hits), to the previous vertex
    prim: Any  # UInt32 (N), triangle
    sample: Any  # UInt32 (N), number of the camera sample
    bitmask: Any  # UInt32 (ceil(L / 32) * N)
    throughput: tuple  # K Color3f (N, or 1 at the camera hits): f cos / density along the path so far
    weights: tuple  # K tuples of Float (N), weights of each surface's materials; None for a single material
    turned: tuple  # K Vector3f (N), normals of surfaces with relief, None for others
    centre: Any  # Point3f (N), centroid of the triangle, or None where no highlight needs it
    spread: Any  # Float (N), d(solid angle of normals) / d(image area), or None where no highlight needs it
    pixels: Any  # UInt32 (Q), pixels with at least one vertex
    start: Any  # UInt32 (Q), first vertex of the pixel
    length: Any  # UInt32 (Q), number of vertices of the pixel

    def normal_of(self, number: int) -> Any:
        """Return the shading normals (N) of a surface."""
        return self.normal if self.turned[number] is None else self.turned[number]


def take(kind: type, source: Any, index: Any) -> Any:
    """Gather the lanes `index` of an array; one that is uniform (width 1) stays so."""
    source = kind(source)
    return dr.gather(kind, source, index) if dr.width(source) > 1 else source
