"""Triangle strips in PLY files, as in the Stanford 3D Scanning Repository's, which trimesh reads as points alone."""

from itertools import chain
from typing import Any

import numpy as np
import trimesh

_ELEMENT = "tristrips"
_SEPARATOR = -1


def from_strips(part: Any) -> Any:
    """Return the mesh of a part that trimesh read as points and whose PLY file has strips; any other part as it is.

    A strip v0 v1 v2 v3 ... is the triangles (v0, v1, v2), (v2, v1, v3), ...; in the list, -1 ends a strip.
    """
    if not isinstance(part, trimesh.PointCloud):
        return part
    element = part.metadata.get("_ply_raw", {}).get(_ELEMENT)
    if element is None or element.get("data") is None:
        return part
    data = element["data"]
    name = next(iter(element["properties"]))
    rows = data[name] if isinstance(data, dict) else data[name]["f1"]  # as trimesh has ASCII and binary lists
    ended = [np.append(np.asarray(row, np.int64).ravel(), _SEPARATOR) for row in rows]
    places = np.fromiter(chain.from_iterable(ended), np.int64)
    runs = np.split(places, np.flatnonzero(places == _SEPARATOR) + 1)
    strips = [run[:-1] for run in runs if len(run) > 3]  # the separator, and fewer than three are not a triangle
    if not strips:
        return part
    return trimesh.Trimesh(part.vertices, trimesh.util.triangle_strips_to_faces(strips), process=False)
