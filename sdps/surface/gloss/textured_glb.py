"""A mesh as `.glb` with base colour, metallic, roughness and normals as pictures (glTF 2.0, 3.9).

All pictures are the photographs' own pixels, cut to the object. The normal map holds normals in the camera's frame: all
vertices face the camera, with tangents to the right, so that the map's tangent space (x right, y up) is that frame.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from PIL import Image
from scipy import ndimage
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from render.shared.files import atomic_path
from render.shared.images import encode_normals, quantise
from sdps.core.geometry import Camera
from sdps.photos.response import display
from sdps.surface.meshing import mesh, step_of, unit_scale

LARGEST = 8192
"""Longest side of the pictures, which graphics cards can hold."""
_TANGENTS = "_TANGENT"  # trimesh writes attributes whose names begin so; glTF's own name follows


class Maps(NamedTuple):
    """Pictures of a surface, (H, W, 3) or (H, W), float; only the mask's pixels count.

    Attributes:
        base: Linear base colour, 0 to 1.
        metallic, roughness: 0 to 1.
        normals: Unit, in the camera's frame.
    """

    base: np.ndarray
    metallic: np.ndarray
    roughness: np.ndarray
    normals: np.ndarray


def write_textured_glb(
    path: str | Path, maps: Maps, depth: np.ndarray, mask: np.ndarray, *, camera: Camera,
    millimetres: float | None = None,
) -> None:  # fmt: skip
    """Write the mesh of a depth map with its pictures, whole or not at all.

    Args:
        path: The file.
        maps: The pictures.
        depth: (H, W) z in pixels towards the camera.
        mask: (H, W) bool.
        camera: What saw it.
        millimetres: As of `sdps.surface.meshing.mesh`, whose frame and unit the vertices have.

    Raises:
        InputError: no three neighbouring pixels, or a disk that refuses the file.
    """
    every = step_of(mask)
    surface = mesh(depth, mask, camera=camera, millimetres=millimetres, every=every)
    box = ndimage.find_objects(mask.astype(np.uint8))[0]
    scale = millimetres or unit_scale(mask.shape)
    count = len(surface.vertices)
    places = _place(surface.vertices / scale, mask.shape, camera, box)
    textured = trimesh.Trimesh(
        vertices=surface.vertices, faces=surface.faces, vertex_normals=np.tile([0.0, 0.0, 1.0], (count, 1)),
        vertex_attributes={_TANGENTS: np.tile(np.array([1, 0, 0, 1], np.float32), (count, 1))},
        visual=TextureVisuals(uv=places, material=_paint(maps, mask, box)), process=False,
    )  # fmt: skip
    data: Any = textured.export(file_type="glb", include_normals=True, tree_postprocessor=_name_tangents)
    with atomic_path(Path(path)) as temporary:
        temporary.write_bytes(data)


def _place(places: np.ndarray, shape: tuple[int, ...], camera: Camera, box: tuple[slice, ...]) -> np.ndarray:
    """Return where vertices (v, 3), in pixels, lie in the pictures, (v, 2): right and up, 0 to 1."""
    column, row = camera.middle((shape[0], shape[1]))
    shrunk = 1.0 - places[:, 2] / camera.focal
    columns, rows = column + places[:, 0] / shrunk, row - places[:, 1] / shrunk
    height, width = (side.stop - side.start for side in box)
    return np.stack([(columns - box[1].start + 0.5) / width, 1.0 - (rows - box[0].start + 0.5) / height], axis=1)


def _paint(maps: Maps, mask: np.ndarray, box: tuple[slice, ...]) -> PBRMaterial:
    """Return the material; around the object the nearest of its pixels go on, so that nothing bleeds in."""
    step = max(1, -(-max(side.stop - side.start for side in box) // LARGEST))
    nearest = ndimage.distance_transform_edt(~mask[box], return_distances=False, return_indices=True)
    base, metallic, roughness, normals = (part[box][tuple(nearest)][::step, ::step] for part in maps)
    packed = np.stack([np.ones_like(roughness), roughness, metallic], axis=-1)
    return PBRMaterial(
        name="fitted",
        baseColorTexture=Image.fromarray(display(base)),
        metallicRoughnessTexture=Image.fromarray(quantise(packed, 8)),
        normalTexture=Image.fromarray(encode_normals(normals)),
        metallicFactor=1.0,
        roughnessFactor=1.0,
    )


def _name_tangents(tree: dict[str, Any]) -> None:
    """Give the tangents of a glTF tree the name that viewers know."""
    for part in tree["meshes"][0]["primitives"]:
        part["attributes"]["TANGENT"] = part["attributes"].pop(_TANGENTS)
