"""`sdps data card`: the dataset card, Croissant metadata and checksums of a data folder."""

import argparse
import sys
from datetime import UTC, datetime
from pathlib import Path

from pipelines.shared.flags import add_cache_argument
from render.checks.folder_checks import CHECKSUMS
from render.planning.plan_counts import PlanCounts, count_plan
from render.publishing import croissant, dataset_card
from render.records.manifest import MANIFEST, read_manifest
from render.records.mirror import display_name, open_folder, select_rendered
from render.shared.config import read_yaml
from render.shared.errors import InputError
from render.shared.files import write_json, write_text

_LISTED = {
    MANIFEST: "The plan: one line per scene.",
    dataset_card.CONFIG: "The resolved configuration.",
    CHECKSUMS: "SHA-256 of every shard, of the manifest and of the configuration.",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps data card`."""
    parser.add_argument("folder", type=Path, help="data folder (the one with manifest.jsonl)")
    parser.add_argument("--name", default="", help="name of the data set (default: the preset's or the folder's)")
    parser.add_argument("--license", default=dataset_card.UNKNOWN, help="licence, an identifier (cc-by-4.0) or a URL")
    parser.add_argument("--url", default="", help="page of the data set; Croissant asks for it in published data")
    parser.add_argument("--creator", default="", help="who made it; Croissant asks for it in published data")
    parser.add_argument("--cite", default="", help="citation, BibTeX by preference")
    add_cache_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Write the files, say where they are and what is missing before publishing."""
    texts = (args.name, args.license, args.url, args.creator, args.cite)
    with open_folder(args.folder, args.cache_gb) as folder:
        _, missing = write_card(folder, *(text.strip() for text in texts))
    names = (dataset_card.CARD, croissant.FILE, CHECKSUMS)
    sys.stdout.write("".join(f"{display_name(folder, written=True)}/{name}\n" for name in names))
    if missing:
        sys.stdout.write(f"before publishing, give {', '.join(missing)}\n")
    return 0


def write_card(
    folder: str | Path,
    name: str = "",
    license: str = dataset_card.UNKNOWN,
    url: str = "",
    creator: str = "",
    cite: str = "",
) -> tuple[Path, list[str]]:
    """Write `checksums.txt`, `croissant.json` and `DATASET_CARD.md` into a data folder.

    Args:
        folder: Data folder with a manifest; it may be rendered in part.
        name, license, url, creator, cite: What the maker of the data says; see
        `render.publishing.croissant.Description`.

    Returns:
        The folder, and the flags still to be given before the data are published.

    Raises:
        InputError: not a data folder, nothing rendered in it, or an empty licence.
    """
    folder = Path(folder)
    if not license:
        raise InputError("--license is empty; give an identifier such as cc-by-4.0, or a URL")
    scenes = read_manifest(folder)
    there = select_rendered(folder, scenes)
    if not there:
        raise InputError(f"{folder}: no shard is there yet; run `sdps render-data` first")
    counts = count_plan(scenes)
    text = croissant.Description(
        name=name or _name(folder),
        about=_about(counts),
        license=license,
        url=url,
        creator=creator,
        cite=cite,
        date=datetime.now(UTC).date().isoformat(),
    )
    dataset_card.write_checksums(folder, there)
    files = {file: about for file, about in _LISTED.items() if (folder / file).is_file()}
    write_json(folder / croissant.FILE, croissant.describe(folder, text, list(counts.splits), files))
    write_text(folder / dataset_card.CARD, dataset_card.render_card(folder, scenes, there, counts, text))
    given = {"--license": license != dataset_card.UNKNOWN, "--url": url, "--creator": creator}
    return folder, [flag for flag, value in given.items() if not value]


def _name(folder: Path) -> str:
    """Name a data set after its preset, or after its folder (the one above, when that is `data`)."""
    try:
        name = read_yaml(folder / dataset_card.CONFIG).get("name")
    except InputError:
        name = None
    resolved = folder.resolve()
    return f"Photometric stereo, {name or (resolved.parent if resolved.name == 'data' else resolved).name}"


def _about(counts: PlanCounts) -> str:
    """Say in two sentences what the data are."""
    sizes = ", ".join(counts.sizes)
    families = ", ".join(counts.families)
    kind, place = ("lights", "direction or position") if counts.near else ("directional lights", "direction")
    return (
        f"{counts.scenes:,} scenes for photometric stereo ({families}), each one object under {kind} "
        f"of known {place}: {counts.images:,} linear RGB images ({sizes} pixels) with normals and mask. "
        f"{len(counts.materials):,} materials; {counts.varying:,} scenes vary spatially."
    )
