"""The dataset card: one Markdown page, from what a data folder holds, with front matter as Hugging Face reads it."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from render.checks.folder_checks import CHECKSUMS
from render.planning import provenance
from render.planning.plan_counts import PlanCounts
from render.publishing import croissant
from render.publishing.croissant import Description
from render.records.manifest import MANIFEST, SceneSpec
from render.records.mirror import shard_path
from render.records.shards import file_hash
from render.shared.config import read_yaml, to_yaml
from render.shared.errors import InputError
from render.shared.files import atomic_path, read_json
from render.shared.progress import progress_bar
from render.shared.templates import fill

CARD, CONFIG, _SHARDS = "DATASET_CARD.md", "config.yaml", "shards/<id>.exr"
UNKNOWN = "unknown"
_SIZES = ((1e3, "n<1K"), (1e4, "1K<n<10K"), (1e5, "10K<n<100K"), (1e6, "100K<n<1M"))
_FILES = {
    MANIFEST: "one line per scene: id, seed, split, shape, material, view, lights, size, samples",
    CONFIG: "the resolved configuration",
    _SHARDS: "one scene: part `gt` (float32: `normal.X/Y/Z`, depth `Z`, `mask`, `coverage`; weights of "
    "spatially-varying scenes), parts `L000`, `L001`, ... (half RGB, light direction in `ps:light_dir`)",
    CHECKSUMS: "SHA-256 of each file, as `sha256sum -c` reads it",
    croissant.FILE: "Croissant metadata",
    "validation.json": "result of `sdps data validate`",
    "preview.html": "plots and sample scenes",
}
_TEMPLATE = Path(__file__).with_name("dataset_card.md.j2")


def write_checksums(folder: Path, there: Sequence[SceneSpec]) -> dict[str, str]:
    """Write `checksums.txt` in the form of `sha256sum` (check it with `sha256sum -c checksums.txt`).

    Args:
        folder: Data folder.
        there: Scenes that have a shard.

    Returns:
        {path relative to the folder: SHA-256} of the shards, the manifest and the configuration.
    """
    names = [name for name in (MANIFEST, CONFIG) if (folder / name).is_file()]
    sums = {name: file_hash(folder / name) for name in names}
    for scene in progress_bar(there, unit="file", desc="checksums"):
        sums[scene.file] = file_hash(shard_path(folder, scene))
    with atomic_path(folder / CHECKSUMS) as temporary, open(temporary, "w", encoding="utf-8") as handle:
        handle.writelines(f"{digest}  {name}\n" for name, digest in sums.items())
    return sums


def render_card(
    folder: Path, scenes: Sequence[SceneSpec], there: Sequence[SceneSpec], counts: PlanCounts, text: Description
) -> str:
    """Compose the card.

    Args:
        folder: Data folder.
        scenes: The manifest.
        there: Its scenes that have a shard.
        counts: What the manifest holds.
        text: What the maker of the data says.
    """
    rendered = provenance.headers(folder, there)
    config = _config(folder)
    splits = Counter(shape for shape, _ in {(scene.shape, scene.split) for scene in scenes})
    return fill(
        _TEMPLATE,
        head=_front_matter(text, counts),
        text=text,
        counts=counts,
        there=len(there),
        rendered=rendered,
        files=[(f"`{name}`", about) for name, about in _FILES.items()
               if name in (_SHARDS, croissant.FILE) or (folder / name).is_file()],
        shared=sum(number > 1 for number in splits.values()),
        provenance=_provenance(folder, rendered, config),
        # Of a preset only the part that determines the data.
        config=to_yaml({key: config[key] for key in ("name", "description", "data") if key in config} or config)
        if config else "",
        terms=provenance.material_terms(list(counts.materials)),
        meshes=provenance.mesh_terms(counts, _mesh_licence(config)).items(),
        validation=_validation(folder),
    )  # fmt: skip


def _front_matter(text: Description, counts: PlanCounts) -> dict[str, Any]:
    """Return what Hugging Face reads; a licence that is no short identifier is given by name or link."""
    licence = {"license": text.license.lower()}
    if text.license.startswith(("http://", "https://")):
        licence = {"license": "other", "license_name": "see-link", "license_link": text.license}
    elif " " in text.license:
        licence = {"license": "other", "license_name": text.license.replace(" ", "-").lower()}
    return {
        "pretty_name": text.name,
        **licence,
        "size_categories": [next((name for bound, name in _SIZES if counts.scenes < bound), "1M<n<10M")],
        "task_categories": ["image-to-image"],
        "tags": ["photometric-stereo", "surface-normals", "synthetic", "rendering", "openexr"],
    }


def _config(folder: Path) -> dict[str, Any]:
    """Return the resolved configuration; empty where there is none."""
    try:
        return read_yaml(folder / CONFIG)
    except InputError:
        return {}


def _mesh_licence(config: Mapping[str, Any]) -> str:
    """Return the terms that the configuration states for the user's own meshes; empty where it states none."""
    data = config.get("data", config)
    meshes = data.get("meshes") if isinstance(data, dict) else None
    return str(meshes.get("licence") or "") if isinstance(meshes, dict) else ""


def _provenance(folder: Path, rendered: Mapping[str, str], config: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """List versions, commit, seed and the manifest's digest."""
    data = config.get("data", config)
    seed = data.get("seed") if isinstance(data, dict) else None
    return [
        *((f"{key}, as the shards say", value) for key, value in rendered.items()),
        *((f"{key}, when this card was written", value) for key, value in provenance.versions().items()),
        ("commit of the code, when this card was written", provenance.commit() or "not in a checkout"),
        ("root seed", "not in the configuration" if seed is None else seed),
        ("SHA-256 of the manifest", f"`{file_hash(folder / MANIFEST)}`"),
    ]


def _validation(folder: Path) -> dict[str, Any]:
    """Return what the last validation found, and whether it was of another manifest; empty if there was none."""
    try:
        report = read_json(folder / "validation.json", "validate the folder again")
        found: dict[str, Any] = {key: int(report[key]) for key in ("checked", "planned", "errors", "warnings")}
        checks = [check for check in report["checks"] if check["findings"]]
        return found | {
            "sound": report["sound"],
            "time": str(report["time"])[:10],
            "stale": report["manifest_sha256"] != file_hash(folder / MANIFEST),
            "findings": [(row["name"], row["level"], row["findings"], row["about"]) for row in checks],
        }
    except (InputError, ValueError, KeyError, TypeError, OverflowError):
        return {}
