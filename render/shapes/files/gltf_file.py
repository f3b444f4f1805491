"""Checks of a glTF file before trimesh reads it: trimesh silently leaves out what it does not know."""

import importlib.util
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from render.shared.errors import InputError

_DRACO = "KHR_draco_mesh_compression"
_COMPRESSED = {
    _DRACO: "Draco",
    "EXT_meshopt_compression": "meshopt",
    "KHR_meshopt_compression": "meshopt",
}
_QUANTISED = "KHR_mesh_quantization"
_INSTANCED = "EXT_mesh_gpu_instancing"
_NO_GEOMETRY = ("KHR_materials_", "KHR_texture_", "KHR_lights_", "KHR_xmp", "KHR_animation", "KHR_audio",
                "EXT_materials_", "EXT_texture_", "EXT_lights_", "MSFT_texture_", "ADOBE_materials_", "MSFT_packing_",
                "KHR_techniques_webgl")  # fmt: skip
"""Beginnings of extensions that change how a surface looks, not where it is."""
_FAN = 6
_FLOAT = 5126
_GLB = (b"glTF", 0x4E4F534A)  # magic, type of the JSON chunk


def check(data: bytes, folder: Path | None) -> None:
    """Refuse a glTF file that trimesh would misread.

    Args:
        data: The `.gltf` or `.glb` file; anything else passes, for the reader to refuse.
        folder: Where the files that it names are; None for a file on its own.

    Raises:
        InputError: it is compressed, requires an unknown extension, or names a file that is missing.
    """
    try:
        tree = _tree(data)
        _check_extensions(tree)
        if any("sparse" in each for each in _accessors(tree, "POSITION", "NORMAL", "TEXCOORD_0")):
            raise InputError("has positions or indices in sparse accessors, which are not read; export it without")
        if any(part.get("mode", 4) >= _FAN for part in _primitives(tree)):
            raise InputError("has triangle fans, which are not read; export it as triangles")
        _check_files(tree, folder)
    except (ValueError, TypeError, AttributeError, LookupError, RecursionError, struct.error) as error:
        if isinstance(error, InputError):
            raise


def _tree(data: bytes) -> dict[str, Any]:
    """Return the JSON of a file; raises where there is none."""
    if data[:4] == _GLB[0]:
        _, _, _, length, kind = struct.unpack("<4sIIII", data[:20])
        if kind != _GLB[1]:
            raise ValueError
        data = data[20 : 20 + length]
    tree: dict[str, Any] = json.loads(data.decode("utf-8-sig"))
    return tree


def _check_extensions(tree: dict[str, Any]) -> None:
    used = {*tree.get("extensionsUsed", ())}.union(*(node.get("extensions", ()) for node in tree.get("nodes", ())))
    required = {*tree.get("extensionsRequired", ())} | _without_data(tree)
    for name in sorted(required & _COMPRESSED.keys()):
        if not (name == _DRACO and importlib.util.find_spec("DracoPy")):
            raise InputError(f"is compressed with {_COMPRESSED[name]} ({name}); export it without compression")
    if _INSTANCED in used:
        raise InputError(f"places copies of a mesh by {_INSTANCED}, which is not read; export it without instancing")
    if _QUANTISED in used:  # whole numbers as fractions of their range, which trimesh reads as plain numbers
        accessors = _accessors(tree, "POSITION", "TEXCOORD_0")
        if any(each.get("normalized") and each.get("componentType") != _FLOAT for each in accessors):
            raise InputError(f"has quantised positions or texture coordinates ({_QUANTISED}); export it without")
    for name in sorted(required - {*_COMPRESSED, _QUANTISED}):
        if not name.startswith(_NO_GEOMETRY):
            raise InputError(f"requires the extension {name}, which is not read; export it without")


def _primitives(tree: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for mesh in tree.get("meshes", ()):
        yield from mesh.get("primitives", ())


def _accessors(tree: dict[str, Any], *names: str) -> Iterator[dict[str, Any]]:
    """Yield the accessors of some attributes of all primitives, and of their indices."""
    for part in _primitives(tree):
        places = [part.get("attributes", {}).get(name) for name in names]
        yield from (tree["accessors"][place] for place in (*places, part.get("indices")) if place is not None)


def _without_data(tree: dict[str, Any]) -> set[str]:
    """Return the compressions without which a primitive has no data, whether the file says so or not."""
    found = set()
    for part in _primitives(tree):
        place = part.get("attributes", {}).get("POSITION")
        if place is not None and not {"bufferView", "sparse"} & tree["accessors"][place].keys():
            found |= _COMPRESSED.keys() & part.get("extensions", {}).keys()
    for buffer in tree.get("buffers", ()):
        if "uri" not in buffer:
            extensions = buffer.get("extensions", {})
            found |= {name for name in _COMPRESSED if extensions.get(name, {}).get("fallback")}
    return found


def _check_files(tree: dict[str, Any], folder: Path | None) -> None:
    """Refuse a file whose buffers lie in files that are missing."""
    for buffer in tree.get("buffers", ()):
        uri = buffer.get("uri", "data:")
        if uri.startswith("data:"):
            continue
        if folder is None or not any((folder / name).is_file() for name in (uri, unquote(uri))):
            raise InputError(f"keeps its mesh in {unquote(uri)!r}, which is not there; copy it there, or export a .glb")
