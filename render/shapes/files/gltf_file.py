"""What a glTF file asks of its reader, looked at before trimesh reads it: trimesh leaves out what it does not know."""

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
_READ_MODES = (0, 1, 2, 3, 4, 5)  # points and lines, which are not surfaces; triangles and triangle strips
_GLB = (b"glTF", 0x4E4F534A)  # magic, type of the JSON chunk


def check(data: bytes, folder: Path | None) -> None:
    """Refuse a glTF file of which trimesh would read something else than is in it.

    Args:
        data: The `.gltf` or `.glb` file; what is neither passes, for the reader to refuse.
        folder: Where the files lie that it names; None where it stands alone.

    Raises:
        InputError: it is compressed, requires an unknown extension, or names a file that is missing.
    """
    tree = _tree(data)
    if tree is None:
        return
    used = {*_as_list(tree.get("extensionsUsed"))}.union(*map(_own, _as_list(tree.get("nodes"))))
    required = set(_as_list(tree.get("extensionsRequired"))) | _without_data(tree)
    for name in sorted(required, key=lambda name: name not in _COMPRESSED):
        if name in _COMPRESSED and not (name == _DRACO and importlib.util.find_spec("DracoPy")):
            raise InputError(f"is compressed with {_COMPRESSED[name]} ({name}); export it without compression")
    if _INSTANCED in used:
        raise InputError(f"places copies of a mesh by {_INSTANCED}, which is not read; export it without instancing")
    if _QUANTISED in used and any(_is_normalised(each) for each in _accessors(tree, ("POSITION", "TEXCOORD_0"))):
        raise InputError(f"has quantised positions or texture coordinates ({_QUANTISED}); export it without")
    read = {*_COMPRESSED, _QUANTISED}
    for name in sorted(required - read):
        if not str(name).startswith(_NO_GEOMETRY):
            raise InputError(f"requires the extension {name}, which is not read; export it without")
    if any("sparse" in each for each in _accessors(tree, ("POSITION", "NORMAL", "TEXCOORD_0"))):
        raise InputError("has positions or indices in sparse accessors, which are not read; export it without")
    modes = {part.get("mode", 4) for part in _primitives(tree)} - {*_READ_MODES}
    if modes:
        raise InputError("has triangle fans, which are not read; export it as triangles")
    _check_files(tree, folder)


def _tree(data: bytes) -> dict[str, Any] | None:
    """Return the JSON of a file, None where there is none."""
    try:
        if data[:4] == _GLB[0]:
            _, _, _, length, kind = struct.unpack("<4sIIII", data[:20])
            if kind != _GLB[1]:
                return None
            data = data[20 : 20 + length]
        tree = json.loads(data.decode("utf-8-sig"))
    except (ValueError, struct.error, RecursionError):
        return None
    return tree if isinstance(tree, dict) else None


def _as_list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _own(value: Any) -> dict[str, Any]:
    """Return the extensions of an object of the tree."""
    extensions = value.get("extensions") if isinstance(value, dict) else None
    return extensions if isinstance(extensions, dict) else {}


def _primitives(tree: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for mesh in _as_list(tree.get("meshes")):
        for part in _as_list(mesh.get("primitives")) if isinstance(mesh, dict) else []:
            if isinstance(part, dict):
                yield part


def _accessors(tree: dict[str, Any], names: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """Yield the accessors of some attributes of all primitives, and of their indices."""
    accessors = _as_list(tree.get("accessors"))
    for part in _primitives(tree):
        attributes = part.get("attributes")
        places = [attributes.get(name) for name in names] if isinstance(attributes, dict) else []
        for place in [*places, part.get("indices")]:
            if isinstance(place, int) and 0 <= place < len(accessors) and isinstance(accessors[place], dict):
                yield accessors[place]


def _is_normalised(accessor: dict[str, Any]) -> bool:
    """Return whether whole numbers stand for fractions of their range, which trimesh reads as plain numbers."""
    return bool(accessor.get("normalized")) and accessor.get("componentType") != 5126


def _without_data(tree: dict[str, Any]) -> set[str]:
    """Return the compressions without which a primitive has no data, whether the file says so or not."""
    found = set()
    accessors = _as_list(tree.get("accessors"))
    for part in _primitives(tree):
        place = (part.get("attributes") or {}).get("POSITION")
        if isinstance(place, int) and 0 <= place < len(accessors) and isinstance(accessors[place], dict):
            bare = "bufferView" not in accessors[place] and "sparse" not in accessors[place]
            found |= {name for name in _own(part) if bare and name in _COMPRESSED}
    for buffer in _as_list(tree.get("buffers")):
        for name, about in _own(buffer).items():
            if name in _COMPRESSED and isinstance(about, dict) and about.get("fallback") and "uri" not in buffer:
                found.add(name)
    return found


def _check_files(tree: dict[str, Any], folder: Path | None) -> None:
    """Refuse a file whose buffers lie in files that are missing."""
    for buffer in _as_list(tree.get("buffers")):
        uri = buffer.get("uri") if isinstance(buffer, dict) else None
        if not isinstance(uri, str) or uri.startswith("data:"):
            continue
        if folder is None or not any((folder / name).is_file() for name in (uri, unquote(uri))):
            raise InputError(f"keeps its mesh in {unquote(uri)!r}, which is not there; copy it there, or export a .glb")
