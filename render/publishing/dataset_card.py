"""The dataset card: one Markdown page, from what a data folder holds, with front matter as Hugging Face reads it."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from render.checks.folder_checks import CHECKSUMS
from render.planning import provenance
from render.planning.composition import Composition
from render.publishing.croissant import Description
from render.records.manifest import MANIFEST, SceneSpec
from render.records.shards import file_hash
from render.shared.config import read_yaml, to_yaml
from render.shared.errors import InputError
from render.shared.files import atomic_path, markdown_table, read_text
from render.shared.progress import progress_bar

CARD, CONFIG = "DATASET_CARD.md", "config.yaml"
UNKNOWN = "unknown"
_SIZES = ((1e3, "n<1K"), (1e4, "1K<n<10K"), (1e5, "10K<n<100K"), (1e6, "100K<n<1M"))
_LISTED = 12  # materials named per group of terms
_LIMITS = """\
- Rendered, not photographed: no sensor noise, no lens, no inexact light directions. Trainers add noise themselves.
- One camera, orthographic; every light is directional and of irradiance pi. Near lights and perspective are missing.
- Materials are opaque reflectances: no transmission, subsurface scattering or fluorescence. The built-in materials are
  analytic fits to measured ones, with the errors their files name.
- Noise is correlated between the lights and materials of one view, which share their paths.
- Radiance is stored in half precision (11 bits); above 65,504 it saturates.
- Interreflections stop after the number of bounces named above.
- At the silhouette a pixel's radiance is mixed with the black background; `coverage` tells how much.
"""
_IMPORTED_LIMITS = """\
- Imported from another data set, whose own limits hold. What it does not tell (see the headers above) was not made up.
- Radiance is stored in half precision (11 bits); above 65,504 it saturates.
"""


def write_checksums(folder: Path, there: Sequence[SceneSpec]) -> dict[str, str]:
    """Write `checksums.txt` in the form of `sha256sum` (check it with `sha256sum -c checksums.txt`).

    Args:
        folder: Data folder.
        there: Scenes that have a shard.

    Returns:
        {path relative to the folder: SHA-256} of the shards, the manifest and the configuration.
    """
    names = [name for name in (MANIFEST, CONFIG) if (folder / name).is_file()] + [scene.file for scene in there]
    sums = {name: file_hash(folder / name) for name in progress_bar(names, unit="file", desc="checksums")}
    with atomic_path(folder / CHECKSUMS) as temporary, open(temporary, "w", encoding="utf-8") as handle:
        handle.writelines(f"{digest}  {name}\n" for name, digest in sums.items())
    return sums


def render_card(
    folder: Path, scenes: Sequence[SceneSpec], there: Sequence[SceneSpec], counts: Composition, text: Description
) -> str:
    """Compose the card.

    Args:
        folder: Data folder.
        scenes: The manifest.
        there: Its scenes that have a shard.
        counts: Composition of the manifest.
        text: What the maker of the data says.
    """
    rendered = provenance.headers(folder, there)
    sections = [
        f"# {text.name}\n\n{text.about}\n",
        _composition(scenes, there, counts),
        _making(rendered, counts),
        _conventions(rendered),
        _files(folder),
        _splits(scenes, counts),
        _provenance(folder, rendered),
        _licences(text, counts),
        f"## Known limits\n\n{_LIMITS if 'mitsuba' in rendered else _IMPORTED_LIMITS}",
        _validation(folder),
        f"## Citation\n\n{text.cite}\n" if text.cite else "",
    ]
    return "\n".join([_front_matter(text, counts), *(section for section in sections if section)])


def _front_matter(text: Description, counts: Composition) -> str:
    """Render the YAML block that Hugging Face reads; a licence that is no short identifier is given by name or link."""
    values: dict[str, Any] = {"pretty_name": text.name}
    if text.license.startswith(("http://", "https://")):
        values |= {"license": "other", "license_name": "see-link", "license_link": text.license}
    elif " " in text.license:
        values |= {"license": "other", "license_name": text.license.replace(" ", "-").lower()}
    else:
        values["license"] = text.license.lower()
    values |= {
        "size_categories": [next((name for bound, name in _SIZES if counts.scenes < bound), "1M<n<10M")],
        "task_categories": ["image-to-image"],
        "tags": ["photometric-stereo", "surface-normals", "synthetic", "rendering", "openexr"],
    }
    return f"---\n{yaml.safe_dump(values, sort_keys=False)}---\n"


def _spelled(values: Mapping[Any, int]) -> str:
    """Spell counts: the value alone when there is one, else each with its number of scenes."""
    if len(values) == 1:
        return str(next(iter(values)))
    return ", ".join(f"{value} ({count:,} scenes)" for value, count in values.items())


def _composition(scenes: Sequence[SceneSpec], there: Sequence[SceneSpec], counts: Composition) -> str:
    rows = [(name, f"{n:,}", f"{s:,}", f"{v:,}") for name, (n, s, v) in counts.per_family.items()]
    state = "all rendered" if len(there) == len(scenes) else f"{len(there):,} of them rendered so far"
    facts = [
        ("scenes", f"{counts.scenes:,}, {state}"),
        ("images", f"{counts.images:,}"),
        ("lights per scene", _spelled(counts.light_counts)),
        ("image side, pixels", _spelled(counts.sizes)),
        ("materials", f"{len(counts.materials):,} in {len(counts.categories)} categories"),
        ("spatially-varying scenes", f"{counts.varying:,} ({counts.varying / counts.scenes:.0%})"),
    ]
    categories = ", ".join(f"{name} {count:,}" for name, count in counts.categories.items())
    return (
        "## Composition\n\n" + markdown_table(("what", "number"), facts) + "\n"
        + markdown_table(("shape family", "scenes", "shapes", "views"), rows)
        + f"\nScenes per material category: {categories}.\n"
    )  # fmt: skip


def _making(rendered: Mapping[str, str], counts: Composition) -> str:
    """Say how the scenes came about; `rendered` is what the shards' headers say."""
    if "mitsuba" not in rendered:
        return (
            "## How it was made\n\nThe shards' headers name no renderer: the scenes were imported from another data "
            "set, whose description holds for how they were made.\n"
        )
    return f"""## How it was made

Each scene is one object in one pose, rendered under every light with Mitsuba 3 by the `render` package of SDPS, from
one set of paths for all lights and materials of a view: next-event estimation at every vertex, cast and attached
shadows, box filter; interreflection bounces: {_spelled(counts.bounces)}; samples per pixel: {_spelled(counts.spp)}. The
manifest was written first and determines every scene; with the configuration below it can be made again.
"""


def _conventions(rendered: Mapping[str, str]) -> str:
    """State the frame and the units; the irradiance is what the shards' headers say."""
    irradiance = rendered.get("irradiance", "unknown")
    white = ", so a white Lambertian surface facing a light has radiance 1" if irradiance == "pi" else ""
    return f"""## Conventions

- Frame: x right, y up, z to the camera, for normals, lights and depth. Image row 0 is the top.
- Orthographic camera; the frame spans [-1, 1] in x. Lengths and depth are in half image widths.
- A light direction is a unit vector from the surface to the light, z > 0.
- Radiance is linear RGB without gamma. Irradiance of every light: {irradiance}{white}.
- Normals are unit vectors in the mask and zero outside; rendered, the mask is where at least half the samples hit.
"""


def _files(folder: Path) -> str:
    files = [
        ("`manifest.jsonl`", "one line per scene: id, seed, split, shape, material, view, lights, size, samples"),
        ("`config.yaml`", "the resolved configuration"),
        ("`shards/<id>.exr`", "one scene: part `gt` (float32: `normal.X/Y/Z`, depth `Z`, `mask`, `coverage`; weights "
         "of spatially-varying scenes), parts `L000`, `L001`, ... (half RGB, light direction in `ps:light_dir`)"),
        ("`checksums.txt`", "SHA-256 of each file, as `sha256sum -c` reads it"),
        ("`croissant.json`", "Croissant metadata"),
        ("`validation.json`", "result of `sdps data validate`"),
        ("`preview.html`", "plots and sample scenes"),
    ]  # fmt: skip
    always = ("`shards/<id>.exr`", "`croissant.json`")
    present = [row for row in files if row[0] in always or (folder / row[0].strip("`")).is_file()]
    return (
        "## Files\n\n"
        + markdown_table(("file", "content"), present)
        + "\nShards are ordinary multi-part OpenEXR (ZIP).\n"
    )


def _splits(scenes: Sequence[SceneSpec], counts: Composition) -> str:
    owners: dict[str, set[str]] = {}
    for scene in scenes:
        owners.setdefault(scene.shape, set()).add(scene.split)
    shared = sum(len(splits) > 1 for splits in owners.values())
    apart = "No shape is in two splits." if not shared else f"{shared:,} shapes are in more than one split."
    rows = [(name, f"{count:,}") for name, count in counts.splits.items()]
    return "## Splits\n\n" + markdown_table(("split", "scenes"), rows) + f"\n{apart}\n"


def _provenance(folder: Path, rendered: Mapping[str, str]) -> str:
    """Tell versions, commit, seed and configuration; of a preset only the part that determines the data."""
    rows = [(f"{key}, as the shards say", value) for key, value in rendered.items()]
    rows += [(f"{key}, when this card was written", value) for key, value in provenance.versions().items()]
    rows.append(("commit of the code, when this card was written", provenance.commit() or "not in a checkout"))
    try:
        config = read_yaml(folder / CONFIG)
    except InputError:
        config = {}
    data = config.get("data", config)
    seed = data.get("seed") if isinstance(data, dict) else None
    rows.append(("root seed", "not in the configuration" if seed is None else seed))
    rows.append(("SHA-256 of the manifest", f"`{file_hash(folder / MANIFEST)}`"))
    block = "\nNo configuration in this folder.\n"
    if config:
        shown = {key: config[key] for key in ("name", "description", "data") if key in config} or config
        block = f"\nConfiguration (the part of `{CONFIG}` the data follow from):\n\n```yaml\n{to_yaml(shown)}```\n"
    return "## Provenance\n\n" + markdown_table(("what", "value"), rows) + block


def _licences(text: Description, counts: Composition) -> str:
    stated = (
        "The licence of this data set is not stated; give it with `sdps data card --license` before sharing it."
        if text.license == UNKNOWN
        else f"This data set: {text.license}."
    )
    materials = [
        (_named(group.materials), group.source, group.terms)
        for group in provenance.material_terms(list(counts.materials))
    ]
    meshes = provenance.mesh_terms(counts).items()
    return (
        f"## Licences\n\n{stated} What it was made from has terms of its own:\n\n"
        + markdown_table(("materials", "source", "terms"), materials) + "\n"
        + markdown_table(("shapes", "terms"), list(meshes))
    )  # fmt: skip


def _named(names: Sequence[str]) -> str:
    """Name a group of materials, the first few of them."""
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(names[:_LISTED]) + more


def _validation(folder: Path) -> str:
    """Tell what the last validation found, and whether it was of this manifest."""
    try:
        report = json.loads(read_text(folder / "validation.json"))
        state = "sound" if report["sound"] else "not sound"
        line = (
            f"`sdps data validate` on {str(report['time'])[:10]}: {state}; {report['checked']:,} of "
            f"{report['planned']:,} shards checked, {report['errors']:,} errors, {report['warnings']:,} warnings."
        )
        if report["manifest_sha256"] != file_hash(folder / MANIFEST):
            line += " The manifest has changed since; validate again."
        found = [check for check in report["checks"] if check["findings"]]
        rows = [(check["name"], check["level"], check["findings"], check["about"]) for check in found]
    except (InputError, ValueError, KeyError, TypeError):
        return "## Validation\n\nNot validated: run `sdps data validate`, then write the card again.\n"
    table = "\n" + markdown_table(("check", "level", "findings", "what should hold"), rows) if rows else ""
    return f"## Validation\n\n{line}\n{table}"
