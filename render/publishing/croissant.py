"""Croissant metadata of a data folder: JSON-LD that dataset search and loaders read (mlcommons.org/croissant/1.1).

The scenes are records read from `manifest.jsonl`; the shards are a file set whose names refer to them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from render.records.shards import file_hash

CONFORMS_TO = "http://mlcommons.org/croissant/1.1"
FILE = "croissant.json"
SPLITS = {"train": "cr:TrainingSplit", "val": "cr:ValidationSplit", "test": "cr:TestSplit"}
_FORMATS = {".jsonl": "application/jsonlines", ".yaml": "application/yaml", ".txt": "text/plain"}
# The context the specification recommends (appendix 1), with the prefixes of the types used here.
CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "arrayShape": "cr:arrayShape",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "containedIn": "cr:containedIn",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "description": {"@container": "@language"},
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileObject": "cr:fileObject",
    "fileProperty": "cr:fileProperty",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isArray": "cr:isArray",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "name": {"@container": "@language"},
    "parentField": "cr:parentField",
    "path": "cr:path",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}


@dataclass(frozen=True)
class FieldSpec:
    """One field of the scene records: where it stands in a manifest line, its type and, for arrays, its shape."""

    name: str
    kind: str
    about: str
    column: str = ""
    path: str = ""
    shape: str = ""


SCENE_FIELDS = (
    FieldSpec("id", "sc:Text", "Name of the scene; its shard is shards/<id>.exr."),
    FieldSpec("split", "sc:Text", "train, val or test."),
    FieldSpec("shape", "sc:Text", "Shape: a family with its seed, or a mesh file."),
    FieldSpec("material", "sc:Text", "Material, or pattern:seed:materials of a spatially-varying surface."),
    FieldSpec("seed", "sc:Integer", "Seed of the sampler."),
    FieldSpec("size", "sc:Integer", "Image side in pixels."),
    FieldSpec("spp", "sc:Integer", "Camera samples per pixel."),
    FieldSpec("bounces", "sc:Integer", "Interreflection bounces; 0 is direct light only."),
    FieldSpec("rotation", "sc:Float", "Row-major rotation, object to camera frame.", "view", "$.rotation", "9"),
    FieldSpec("scale", "sc:Float", "Radius of the object's unit sphere, half image widths.", "view", "$.scale"),
    FieldSpec("offset", "sc:Float", "Translation in the image plane, half image widths.", "view", "$.offset", "2"),
    FieldSpec("lights", "sc:Float", "Unit directions to the lights: x right, y up, z to the camera.", shape="-1,3"),
)


@dataclass(frozen=True, kw_only=True)
class Description:
    """What the maker of a data set says about it; empty text is left out of the metadata.

    Attributes:
        name: Name of the data set.
        about: One or two sentences.
        license: Identifier or URL.
        url: Page of the data set.
        creator: Person or group.
        cite: Citation, BibTeX by preference.
        date: ISO date of the description.
        version: Version of the data set.
    """

    name: str
    about: str
    license: str
    date: str
    url: str = ""
    creator: str = ""
    cite: str = ""
    version: str = "1.0.0"


def describe(folder: Path, text: Description, splits: Sequence[str], files: Mapping[str, str]) -> dict[str, Any]:
    """Build the JSON-LD of a data folder.

    Args:
        folder: Data folder; the files are hashed now.
        text: What its maker says.
        splits: Splits the manifest has.
        files: {file name: description} of the single files to list, present in the folder; `manifest.jsonl` among them.
    """
    optional: dict[str, Any] = {"url": text.url, "citeAs": text.cite}
    if text.creator:
        optional["creator"] = {"@type": "sc:Person", "name": text.creator}
    return {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": CONFORMS_TO,
        "name": text.name,
        "description": text.about,
        "license": text.license,
        "version": text.version,
        "datePublished": text.date,
        "keywords": ["photometric stereo", "surface normals", "rendered images", "BRDF"],
        **{key: value for key, value in optional.items() if value},
        "distribution": [*(_file_object(folder, name, about) for name, about in files.items()), _shards()],
        "recordSet": [_split_records(splits), _scene_records(), _shard_records()],
    }


def _file_object(folder: Path, name: str, about: str) -> dict[str, Any]:
    path = folder / name
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "description": about,
        "contentUrl": name,
        "contentSize": f"{path.stat().st_size} B",
        "encodingFormat": _FORMATS.get(path.suffix, "application/octet-stream"),
        "sha256": file_hash(path),
    }


def _shards() -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": "shards",
        "name": "shards",
        "description": "One multi-part OpenEXR file per scene; checksums.txt holds the SHA-256 of each.",
        "encodingFormat": "image/x-exr",
        "includes": "shards/*.exr",
    }


def _split_records(splits: Sequence[str]) -> dict[str, Any]:
    return {
        "@type": "cr:RecordSet",
        "@id": "splits",
        "name": "splits",
        "description": "The splits of the data set.",
        "dataType": "cr:Split",
        "key": {"@id": "splits/name"},
        "field": [
            {"@type": "cr:Field", "@id": "splits/name", "name": "name", "dataType": "sc:Text"},
            {"@type": "cr:Field", "@id": "splits/url", "name": "url", "dataType": "sc:URL"},
        ],
        "data": [{"splits/name": name, "splits/url": SPLITS.get(name, "")} for name in splits],
    }


def _scene_records() -> dict[str, Any]:
    return {
        "@type": "cr:RecordSet",
        "@id": "scenes",
        "name": "scenes",
        "description": "One record per planned scene.",
        "key": {"@id": "scenes/id"},
        "field": [_scene_field(field) for field in SCENE_FIELDS],
    }


def _scene_field(field: FieldSpec) -> dict[str, Any]:
    """Describe one field; nested ones are taken out of their column by a JSONPath."""
    source: dict[str, Any] = {
        "fileObject": {"@id": "manifest.jsonl"},
        "extract": {"column": field.column or field.name},
    }
    if field.path:
        source["transform"] = {"jsonPath": field.path}
    entry: dict[str, Any] = {
        "@type": "cr:Field",
        "@id": f"scenes/{field.name}",
        "name": field.name,
        "description": field.about,
        "dataType": field.kind,
        "source": source,
    }
    if field.shape:
        entry |= {"isArray": True, "arrayShape": field.shape}
    if field.name == "split":
        entry["references"] = {"field": {"@id": "splits/name"}}
    return entry


def _shard_records() -> dict[str, Any]:
    files = {"fileSet": {"@id": "shards"}}
    return {
        "@type": "cr:RecordSet",
        "@id": "shard-files",
        "name": "shard-files",
        "description": "One record per rendered scene: its file, and the scene it holds.",
        "key": {"@id": "shard-files/path"},
        "field": [
            {
                "@type": "cr:Field",
                "@id": "shard-files/path",
                "name": "path",
                "description": "Path of the shard in the data folder.",
                "dataType": "sc:Text",
                "source": {**files, "extract": {"fileProperty": "fullpath"}},
            },
            {
                "@type": "cr:Field",
                "@id": "shard-files/scene",
                "name": "scene",
                "description": "Id of the scene.",
                "dataType": "sc:Text",
                "source": {
                    **files,
                    "extract": {"fileProperty": "filename"},
                    "transform": {"regex": r"^(.+)\.exr$"},
                },
                "references": {"field": {"@id": "scenes/id"}},
            },
        ],
    }
