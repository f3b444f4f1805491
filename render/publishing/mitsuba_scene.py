"""Saving a planned scene as files that stock Mitsuba 3 renders to the picture of `render.kernel.many_lights`.

Nothing of this project is needed to render them: Lambertian materials become `diffuse`, all others tables that the
`measured` plugin reads (`render.materials.rgl`), and spatially varying surfaces are blended by weights at the vertices
of a mesh that is cut along the edges of the pattern (`render.publishing.pattern_mesh`).
"""

import shutil
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from render import shapes
from render.materials import merl, model, rgl, surfaces
from render.publishing import pattern_mesh
from render.records.manifest import SceneSpec
from render.records.view_geometry import field_of_view
from render.shapes.geometry.mesh import TriangleMesh
from render.shared.errors import InputError
from render.shared.files import atomic_folder

SCENE = "scene.xml"
MESH = "object.ply"
LIGHTS = "lights.txt"
README = "README.txt"

_README = """Scene {id}, for Mitsuba 3.9 as published (no plugin, no other software)

shape     {shape}
material  {material}
pose      rotation {rotation} (row-major, object to camera), scale {scale:g}, offset {offset}
picture   {size}x{size} pixels, {spp} samples each, {bounces} interreflections, {count} lights

scene.xml     the scene under one light, by default the first of lights.txt
object.ply    the posed object with its normals, in the camera frame
lights.txt    one light a line, x y z: {light}
{tables}
Frame: x right, y up, z to the camera, lengths in half image widths; image row 0 is the top. Radiance is linear;
{unit}

One light from the command line (any RGB variant; parameters: lx ly lz {strength} size spp seed):

    mitsuba -m scalar_rgb -Dlx={x:.6g} -Dly={y:.6g} -Dlz={z:.6g}{own} -Dspp=256 -o light000.exr scene.xml

Light k from Python:

    import mitsuba as mi
    mi.set_variant("scalar_rgb")  # or llvm_ad_rgb, cuda_ad_rgb
    {target} = map(float, open("lights.txt").readlines()[k].split())
    scene = mi.load_file("scene.xml", lx=x, ly=y, lz=z{intensity})
    mi.Bitmap(mi.render(scene, spp=256)).write(f"light{{k:03d}}.exr")
"""


_DISTANT = {
    "light": "unit vector from the surface to the light",
    "unit": "under\nthe default irradiance, pi, a white Lambertian surface that faces the light has radiance 1.",
    "strength": "irradiance",
    "target": "x, y, z",
    "intensity": "",
}
_NEAR = {
    "light": "position of the light; then its radiant intensity, the same to all sides",
    "unit": "a white\nLambertian surface at the object's centre, (offset, 0), that faces a light has radiance 1.",
    "strength": "intensity",
    "target": "x, y, z, intensity",
    "intensity": ", intensity=intensity",
}
# Lights have z > 0, so their `up` is never parallel to one. An emitter shines along its local +z.
_DIRECTIONAL = """<emitter type="directional" id="light">
  <transform name="to_world"><lookat origin="$lx, $ly, $lz" target="0, 0, 0" up="0, 1, 0"/></transform>
  <rgb name="irradiance" value="$irradiance"/>
</emitter>"""
_POINT = """<emitter type="point" id="light">
  <point name="position" x="$lx" y="$ly" z="$lz"/><rgb name="intensity" value="$intensity"/>
</emitter>"""
_SCENE = """<scene version="3.0.0">
<default name="lx" value="{x}"/><default name="ly" value="{y}"/><default name="lz" value="{z}"/>
<default name="{strength}" value="{value}"/><default name="size" value="{size}"/>
<default name="spp" value="{spp}"/><default name="seed" value="0"/>
<integrator type="path"><integer name="max_depth" value="{depth}"/><integer name="rr_depth" value="1000"/></integrator>
<sensor type="{camera}">{fov}
  <transform name="to_world"><lookat origin="0, 0, {distance}" target="0, 0, 0" up="0, 1, 0"/></transform>
  <float name="near_clip" value="0.001"/><float name="far_clip" value="{far}"/>
  <film type="hdrfilm">
    <integer name="width" value="$size"/><integer name="height" value="$size"/><rfilter type="box"/>
    <string name="pixel_format" value="rgb"/><string name="component_format" value="float32"/>
  </film>
  <sampler type="independent">
    <integer name="sample_count" value="$spp"/><integer name="seed" value="$seed"/>
  </sampler>
</sensor>
{emitter}
<shape type="ply" id="object"><string name="filename" value="{mesh}"/></shape>
</scene>
"""


def save(folder: str | Path, spec: SceneSpec, mesh: TriangleMesh | None = None) -> Path:
    """Write one scene: `scene.xml`, `object.ply`, `lights.txt`, `README.txt`, and tables of its materials.

    The folder appears whole or not at all; one that holds an earlier scene is replaced.

    Args:
        folder: Folder to write.
        spec: The scene; its first light is the default of `scene.xml`. Edges of a pattern are as sharp as its `size`
            needs, so that a render with many more pixels shows them softer.
        mesh: The object in its unit sphere; `spec.shape` is loaded when omitted.

    Returns:
        The path of `scene.xml`.

    Raises:
        InputError: an unknown shape or material, a folder of other files, or one that cannot be written.
    """
    mesh = shapes.load(spec.shape) if mesh is None else mesh
    surface = surfaces.load(spec.material)
    if surface.textured:
        raise InputError(
            f"scene {spec.id}: {spec.material!r} is textured; stock Mitsuba has no such material, leave it out"
        )
    shares = np.zeros((len(mesh.vertices), 0), np.float32)
    if surface.pattern:
        quarter_pixel = 0.5 / (spec.resolution[0] * spec.view.scale)
        mesh, shares = pattern_mesh.cut(mesh, _weights(surface.pattern, mesh), quarter_pixel)
    folder = Path(folder)
    if folder.exists() and not (folder / SCENE).is_file() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: holds other files; choose a new folder for the Mitsuba scene")
    with atomic_folder(folder) as temporary:
        bsdfs = [_material(temporary, number, material) for number, material in enumerate(surface.components)]
        _write_mesh(temporary / MESH, mesh.pose(spec.view), shares)
        tree = ET.ElementTree(_scene(spec, _blend(bsdfs)))
        ET.indent(tree, space="    ")
        tree.write(temporary / SCENE, encoding="utf-8", xml_declaration=True)
        lights = _light_rows(spec)
        rows = "".join(" ".join(f"{value:.9g}" for value in light) + "\n" for light in lights)
        (temporary / LIGHTS).write_text(rows, encoding="utf-8")
        (temporary / README).write_text(_readme(spec, surface.components), encoding="utf-8")
    return Path(folder) / SCENE


def evaluator(material: Any) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return the BRDF of a fitted material or a MERL table as a function of two (N, 3) directions; see `rgl.write`.

    Raises:
        InputError: a material without a numpy form.
    """
    if isinstance(material, model.Material):
        return partial(model.evaluate, material)
    if isinstance(material, merl.MerlTable):
        return partial(merl.evaluate, material)
    raise InputError(f"material {material.name}: a {type(material).__name__} cannot be converted for Mitsuba")


def _weights(pattern: surfaces.Pattern, mesh: TriangleMesh) -> pattern_mesh.Weights:
    """Return the weights of a pattern as a function of numpy arrays."""
    from render.backend.jit import mi
    from render.materials.kernels import patterns

    evaluate = patterns.Evaluator(pattern, mesh).weights

    def weights(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        columns = (mi.Float(np.ascontiguousarray(column, np.float32)) for column in points.T)
        found = evaluate(mi.Point3f(*columns), mi.UInt32(triangles.astype(np.uint32)))
        return np.stack([np.broadcast_to(np.array(weight), len(points)) for weight in found], axis=1)

    return weights


def _material(folder: Path, number: int, material: Any) -> ET.Element:
    """Describe one material, writing or copying its table; names are not used for files, they may be paths."""
    if getattr(material, "category", "") == "lambertian":
        bsdf = ET.Element("bsdf", type="diffuse")
        albedo = np.pi * material.bivariate[:, 0, 0]
        ET.SubElement(bsdf, "rgb", name="reflectance", value=" ".join(f"{value:.7g}" for value in albedo))
        return bsdf
    file = _table_file(number)
    if isinstance(material, rgl.RglMaterial):
        shutil.copyfile(material.path, folder / file)
    else:
        rgl.write(folder / file, evaluator(material), description=material.name)
    bsdf = ET.Element("bsdf", type="measured")
    ET.SubElement(bsdf, "string", name="filename", value=file)
    return bsdf


def _table_file(number: int) -> str:
    return f"material{number}.bsdf"


def _blend(bsdfs: list[ET.Element]) -> ET.Element:
    """Nest `blendbsdf`: the k-th material takes its share of what the first k + 1 have together."""
    blend = bsdfs[0]
    for number, bsdf in enumerate(bsdfs[1:], start=1):
        outer = ET.Element("bsdf", type="blendbsdf")
        texture = ET.SubElement(outer, "texture", name="weight", type="mesh_attribute")
        ET.SubElement(texture, "string", name="name", value=f"vertex_share{number}")
        outer.extend([blend, bsdf])
        blend = outer
    return blend


def _write_mesh(path: Path, mesh: TriangleMesh, shares: np.ndarray) -> None:
    """Write a binary PLY with normals, and the shares that `_blend` asks for as vertex attributes."""
    ply = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=mesh.normals, process=False)
    for number, share in enumerate(shares.T, start=1):
        ply.vertex_attributes[f"share{number}_0"] = share  # Mitsuba takes the suffix for the channel
    data = ply.export(file_type="ply", vertex_normal=True)
    assert isinstance(data, bytes), type(data)
    path.write_bytes(data)


def _light_rows(spec: SceneSpec) -> np.ndarray:  # (L, 3 or 4)
    """Return the directions to distant lights, or positions of near ones and the intensity that gives irradiance pi."""
    positions = spec.light_positions()
    if positions is None:
        return np.asarray(spec.lights, np.float64).reshape(-1, 3)
    intensity = np.pi * np.square(spec.light_distances)[:, None]
    return np.concatenate([positions.astype(np.float64), intensity], axis=1)


def _scene(spec: SceneSpec, bsdf: ET.Element) -> ET.Element:
    """Return the scene of `render.kernel.reference.scene_dict` as XML, with parameters."""
    x, y, z, *intensity = (f"{value:.9g}" for value in _light_rows(spec)[0])
    distance = spec.view.camera_distance or 4 * spec.view.scale
    camera, fov = "orthographic", ""
    if spec.view.camera_distance is not None:
        camera, angle = "perspective", field_of_view(spec.view.camera_distance)
        fov = f'<float name="fov" value="{angle:.9g}"/><string name="fov_axis" value="x"/>'
    scene = ET.fromstring(
        _SCENE.format(
            x=x, y=y, z=z, strength="intensity" if intensity else "irradiance", camera=camera, fov=fov,
            value=intensity[0] if intensity else f"{np.pi:.9g}", emitter=_POINT if intensity else _DIRECTIONAL,
            size=spec.size, spp=spec.spp, depth=spec.bounces + 2,
            distance=f"{distance:.9g}", far=f"{2 * distance:.9g}", mesh=MESH,
        )
    )  # fmt: skip
    shape = scene.find("shape")
    assert shape is not None  # the template has one
    shape.append(bsdf)
    return scene


def _readme(spec: SceneSpec, materials: Sequence[Any]) -> str:
    tables = "".join(
        f"{_table_file(number)}  BRDF of {material.name}, for the `measured` plugin\n"
        for number, material in enumerate(materials)
        if material.category != "lambertian"
    )
    x, y, z, *intensity = _light_rows(spec)[0]
    words = _NEAR if intensity else _DISTANT
    return _README.format(
        **words,
        own=f" -Dintensity={intensity[0]:.6g}" if intensity else "",
        **{name: getattr(spec, name) for name in ("id", "shape", "material", "size", "spp", "bounces")},
        rotation=" ".join(f"{value:g}" for value in spec.view.rotation),
        scale=spec.view.scale,
        offset=" ".join(f"{value:g}" for value in spec.view.offset),
        count=len(spec.lights),
        tables=tables,
        x=x,
        y=y,
        z=z,
    )
