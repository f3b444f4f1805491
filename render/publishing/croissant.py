"""Croissant metadata of a data folder: JSON-LD that dataset search and loaders read (mlcommons.org/croissant/1.1).

The scenes are records read from `manifest.jsonl`; the shards are a file set whose names refer to them. What all data
folders share lies in `assets/croissant.yaml`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from render.records.shards import file_hash
from render.shared.config import read_yaml

CONFORMS_TO = "http://mlcommons.org/croissant/1.1"
FILE = "croissant.json"
SPLITS = {"train": "cr:TrainingSplit", "val": "cr:ValidationSplit", "test": "cr:TestSplit"}
_FORMATS = {".jsonl": "application/jsonlines", ".yaml": "application/yaml", ".txt": "text/plain"}


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
    common = read_yaml(str(resources.files("assets") / "croissant.yaml"))
    rows = [{"splits/name": name, "splits/url": SPLITS.get(name, "")} for name in splits]
    return {
        "@context": common["@context"],
        "@type": "sc:Dataset",
        "conformsTo": CONFORMS_TO,
        "name": text.name,
        "description": text.about,
        "license": text.license,
        "version": text.version,
        "datePublished": text.date,
        "keywords": ["photometric stereo", "surface normals", "rendered images", "BRDF"],
        **{key: value for key, value in optional.items() if value},
        "distribution": [*(_file_object(folder, name, about) for name, about in files.items()), common["shards"]],
        "recordSet": [common["splits"] | {"data": rows}, common["scenes"], common["shard-files"]],
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
