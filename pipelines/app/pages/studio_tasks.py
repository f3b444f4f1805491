"""What the worker does for the studio: scenes under one light at a time, the gallery of materials, files to keep.

A scene is rendered once under lights spread over the hemisphere. The browser mixes the three images around the light
that is dragged, so nothing is rendered while it moves.
"""

import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from pipelines.shared import pictures
from render.records.manifest import SceneSpec
from render.records.shards import Shard, read_shard, write_shard
from render.shared.config import to_yaml
from render.shared.errors import InputError
from render.shared.files import atomic_path, cache_folder, read_json, write_json
from render.shared.progress import stage

UPLOADS = "uploads"
_LIGHTS, _SPP, _SIZES = "near-uniform:60", 8, (128, 256)
_FINAL_SPP = 64
_HEADROOM = 4.0
"""Largest radiance that is sent, with the brightest 5 % of the object at 0.8; brighter highlights are clipped."""
_SHAPE = re.compile(r"sphere|bunny|(blobby|sculpture):\d{1,9}")
_MATERIAL = re.compile(r"[a-z0-9:.+-]+|lambertian:[0-9.]+(/[0-9.]+){0,2}")
_FILES = re.compile(r"\.(ya?ml|binary|bsdf)\b|\b(maps|uv):")
_TILE = 56
_SEEDED = ("blobby", "sculpture")


def render_gallery() -> dict[str, Any]:
    """Return the built-in materials by category and a strip of spheres, rendered once and kept in the user's cache."""
    import render
    from render.materials import library

    groups = library.categories()
    names = [name for group in groups.values() for name in group]
    picture = cache_folder() / f"studio-materials-{len(names)}-{_TILE}.jpg"
    if not picture.is_file():
        views = render.render_views("sphere", names, np.array([[-0.45, 0.55, 0.70]]), size=_TILE, spp=16, scale=0.95)
        tiles = []
        for number, view in enumerate(views):
            exposure = pictures.auto_exposure(view.images, view.mask)
            tiles.append(pictures.tone_map(view.images[0], exposure))
            stage("materials", number + 1, len(names))
        with atomic_path(picture) as temporary:
            Image.fromarray(np.concatenate(tiles, axis=1)).save(temporary, quality=88)
    return {"groups": groups, "tile": _TILE, "picture": pictures.data_uri(Image.open(picture))}


def render_scene(place: str, direct: bool = False, **asked: Any) -> dict[str, Any]:
    """Render a scene for the page.

    Args:
        place: Its folder; gets `basis.bin` and, with `direct`, `direct.bin`, the same without interreflections.
        direct: Leave interreflections out.
        asked: What `check_choice` takes.

    Returns:
        What the page needs to know.

    Raises:
        InputError: an unknown shape or material, or a scene that cannot be rendered.
    """
    import render

    spec = check_choice(Path(place), **asked)
    stage("rendering")
    view = render.render_view(**_collect_arguments(spec), spp=_SPP, bounces=0 if direct else spec["bounces"])
    if direct:
        stored = read_json(Path(place) / "view.json", "render the scene first")
        _write(Path(place) / "direct.bin", _encode(view.images, stored["exposure"]))
        return {}
    exposure = pictures.auto_exposure(view.images, view.mask)
    about = write_basis(Path(place), view.images, view.light_directions, view.normals, view.depth, view.mask, exposure)
    return about | {"name": f"{spec['shape']}, {spec['material']}"}


def write_basis(
    folder: Path, images: np.ndarray, lights: np.ndarray, normals: np.ndarray, depth: np.ndarray, mask: np.ndarray,
    exposure: float,
) -> dict[str, Any]:  # fmt: skip
    """Write the images that the page mixes, and return what else it needs.

    `basis.bin`: uint8 images (L, h, w, 3), round(255 sqrt(radiance * exposure / 4)), then `truth.bin`: int8 normals
    (h, w, 3), n * 127, and uint8 depth (h, w), 1 to 255 from far to near, 0 outside the mask.
    """
    _write(folder / "basis.bin", _encode(images, exposure))
    inside = depth[mask]
    near = 1 + 254 * (depth - inside.min()) / max(float(np.ptp(inside)), 1e-9)
    parts = np.rint(normals * 127).astype(np.int8), np.where(mask, near, 0).astype(np.uint8)
    _write(folder / "truth.bin", b"".join(part.tobytes() for part in parts))
    about = {
        "lights": np.round(lights.astype(float), 5).tolist(), "triangles": triangulate(lights), "exposure": exposure,
        "headroom": _HEADROOM, "width": mask.shape[1], "height": mask.shape[0],
    }  # fmt: skip
    write_json(folder / "view.json", about)
    return about


def _write(path: Path, data: bytes) -> None:
    """Replace a file in one step, since the server may be sending the last scene's."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def triangulate(lights: np.ndarray) -> list[list[int]]:
    """Return triangles of neighbouring lights (L, 3), by their numbers; none if all are on a line."""
    try:
        return Delaunay(lights[:, :2] / (1.0 + lights[:, 2:])).simplices.tolist()
    except (ValueError, RuntimeError):  # QhullError is a RuntimeError
        return []


def prepare_shard(place: str, shard: str) -> dict[str, Any]:
    """Prepare a shard for the page, as `render_scene` does with what it renders."""
    read: Shard = read_shard(Path(shard))
    images = read.images.astype(np.float32)
    exposure = pictures.auto_exposure(images, read.mask)
    return write_basis(Path(place), images, read.light_directions, read.normals, read.depth, read.mask, exposure)


def pack_scene(place: str, **asked: Any) -> str:
    """Render the scene with little noise and pack shard, preset and a program that repeats it; return the ZIP's name.

    Raises:
        InputError: as `render_scene`.
    """
    import render

    folder, spec = Path(place), check_choice(Path(place), **asked)
    stage("rendering")
    view = render.render_view(**_collect_arguments(spec), spp=_FINAL_SPP, bounces=spec["bounces"])
    write_shard(folder / "scene.exr", view.shard("scene"))
    with (
        atomic_path(folder / "scene.zip") as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as opened,
    ):
        opened.write(folder / "scene.exr", "scene.exr")
        opened.writestr("scene.yaml", _make_test_preset(spec))
        opened.writestr("repeat.py", _make_program(spec, view.scene))
        opened.writestr("README.txt", _ABOUT)
        for name in (Path(spec["shape"]), Path(spec["material"])):
            for file in [name] if name.is_file() else name.glob("*"):
                opened.write(file, file.relative_to(name.parent))
    return "scene.zip"


_ABOUT = """scene.exr   the shard: images under every light, normals, depth, mask
repeat.py   writes the same shard again: python repeat.py
scene.yaml  preset of test scenes of this shape and material, upright: sdps regenerate --preset scene.yaml --out scenes
"""


def make_training_preset(place: str, **asked: Any) -> str:
    """Return the YAML of a preset that trains on such scenes: many shapes of the family in this material.

    Raises:
        InputError: a shape that does not belong to a family.
    """
    spec = check_choice(Path(place), **asked)
    family = spec["shape"].split(":")[0]
    if family not in _SEEDED:
        raise InputError("training needs many shapes; choose blobby or sculpture, or see `meshes` in the guide")
    data = {
        "families": {family: 200}, "views": 2, "materials_per_view": 1, "materials": [_shorten(spec["material"])],
        "bounces": spec["bounces"], "light_count": 64, "size": 128, "spp": 64,
    }  # fmt: skip
    return to_yaml({"name": "my-scenes", "description": f"{family} in {_shorten(spec['material'])}", "data": data})


def check_choice(place: Path, **asked: Any) -> dict[str, Any]:
    """Check and return the chosen shape, material and pose; names of uploads become paths.

    Raises:
        InputError: an unknown name, or a number out of range.
    """
    shape, material = str(asked.get("shape", "")), str(asked.get("material", ""))
    loaded = {path.name: str(path) for path in (place.parent / UPLOADS).glob("*")}
    if shape not in loaded and not _SHAPE.fullmatch(shape):
        raise InputError(f"shape {shape[:60]!r}: choose sphere, bunny, blobby:<seed>, sculpture:<seed> or load a mesh")
    if material not in loaded and (not _MATERIAL.fullmatch(material) or _FILES.search(material)):
        raise InputError(f"material {material[:60]!r}: give a name, lambertian:<albedo> or a pattern, or load a file")
    if Path(loaded.get(shape, "")).is_dir() and shape in loaded:
        raise InputError(f"shape {shape[:60]!r}: is a folder of maps; choose a shape or load a mesh")
    shape, material = loaded.get(shape, shape), loaded.get(material, material)
    try:
        turn = [float(asked.get(name, 0.0)) for name in ("yaw", "pitch", "roll")]
        bounces, size = int(asked.get("bounces", 1)), int(asked.get("size", 256))
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError("yaw, pitch, roll, bounces and size: must be numbers") from error
    if not np.isfinite(turn).all() or not 0 <= bounces <= 8 or size not in _SIZES:
        raise InputError("bounces: must be 0 to 8, and size 128 or 256")
    rotation = Rotation.from_euler("yxz", turn, degrees=True).as_matrix().round(9).tolist()
    return {"shape": shape, "material": material, "rotation": rotation, "bounces": bounces, "size": size}


def _collect_arguments(spec: dict[str, Any]) -> dict[str, Any]:
    rotation = np.array(spec["rotation"])
    return {name: spec[name] for name in ("shape", "material", "size")} | {"lights": _LIGHTS, "rotation": rotation}


def _shorten(name: str) -> str:
    path = Path(name)
    return name if not path.is_absolute() else f"./{path.name}" if path.is_dir() else path.name


def _encode(images: np.ndarray, exposure: float) -> bytes:
    """Return images as uint8, the square root over the headroom."""
    return (255 * np.sqrt(np.clip(images * (exposure / _HEADROOM), 0, 1)) + 0.5).astype(np.uint8).tobytes()


def _make_test_preset(spec: dict[str, Any]) -> str:
    test = {
        "shapes": [_shorten(spec["shape"])], "materials": [_shorten(spec["material"])], "lights": _LIGHTS,
        "size": spec["size"], "spp": _FINAL_SPP, "bounces": spec["bounces"], "scale": 0.9,
    }  # fmt: skip
    return to_yaml({"name": "my-scene", "description": "A scene of the studio.", "test": test})


def _make_program(spec: dict[str, Any], made: SceneSpec) -> str:
    """Return the Python program that writes the shard again."""
    shape, material = repr(_shorten(spec["shape"])), repr(_shorten(spec["material"]))
    return (
        f'"""Writes scene.exr; its manifest line is {made.digest()}."""\n\nimport numpy as np\n\nimport render\n\n'
        f"view = render.render_view(\n    {shape}, {material}, {_LIGHTS!r}, size={spec['size']}, spp={_FINAL_SPP}, "
        f"bounces={spec['bounces']},\n    rotation=np.array({spec['rotation']}),\n)\n"
        'render.write_shard("scene.exr", view.shard("scene"))\n'
    )
