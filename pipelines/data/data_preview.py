"""`sdps data preview`: contact sheets and one self-contained page that shows what a data folder holds."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipelines.data.preview import preview_page
from pipelines.data.preview.preview_sample import Sample, caption, read_sample
from pipelines.shared import pictures
from pipelines.shared.flags import add_cache_argument
from render.planning.plan_counts import count_plan
from render.records.manifest import SceneSpec, read_manifest
from render.records.mirror import display_name, open_folder, select_rendered
from render.shared.errors import InputError
from render.shared.files import atomic_path, write_text

PER_SHEET = 24  # scenes of one contact sheet
ON_PAGE = 48  # most scenes shown on the page, so that it stays small


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps data preview`."""
    parser.add_argument("folder", type=Path, help="data folder (the one with manifest.jsonl)")
    parser.add_argument("--count", type=int, default=PER_SHEET, help=f"scenes to show (default: {PER_SHEET})")
    add_cache_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Write the sheets and the page, and say where they are."""
    with open_folder(args.folder, args.cache_gb) as folder:
        written = preview(folder, args.count)
    sys.stdout.write("".join(f"{display_name(folder, written=True)}/{path.name}\n" for path in written))
    return 0


def preview(folder: str | Path, count: int = PER_SHEET) -> list[Path]:
    """Write `preview.png` (or `preview-000.png`, ... for more than 24 scenes) and `preview.html` into the folder.

    Scenes that are not rendered yet, and shards that cannot be read, are left out and told on the page.

    Args:
        folder: Data folder with a manifest.
        count: Scenes to show, spread evenly over those that are there.

    Raises:
        InputError: not a data folder, or nothing rendered in it.
    """
    folder = Path(folder)
    if count < 1:
        raise InputError(f"--count must be at least 1, got {count}")
    scenes = read_manifest(folder)
    there = select_rendered(folder, scenes)
    if not there:
        raise InputError(f"{folder}: no shard is there yet; run `sdps render-data` first")
    sample = read_sample(folder, there, count)
    if not sample.tiles:
        raise InputError(f"{folder}: none of the {len(sample.damaged)} shards read is whole; run `sdps data validate`")
    written = write_sheets(folder, sample.tiles)
    page = preview_page.render(
        folder, scenes, there, count_plan(scenes), sample, shown=sample.tiles[:: _stride(sample)]
    )
    write_text(folder / "preview.html", page)
    return [*written, folder / "preview.html"]


def _stride(sample: Sample) -> int:
    return -(-len(sample.tiles) // ON_PAGE)


def write_sheets(folder: Path, tiles: Sequence[tuple[SceneSpec, np.ndarray]]) -> list[Path]:
    """Write the contact sheets, and remove those of an earlier preview that are not written again."""
    pages = [tiles[first : first + PER_SHEET] for first in range(0, len(tiles), PER_SHEET)]
    names = ["preview.png"] if len(pages) == 1 else [f"preview-{number:03d}.png" for number in range(len(pages))]
    for name, page in zip(names, pages, strict=True):
        labelled = [(caption(scene)[:80], picture) for scene, picture in page]
        with atomic_path(folder / name) as temporary:
            pictures.contact_sheet(labelled, columns=min(2, len(labelled))).save(temporary, optimize=True)
    for old in [folder / "preview.png", *folder.glob("preview-[0-9][0-9][0-9].png")]:
        if old.name not in names:
            old.unlink(missing_ok=True)
    return [folder / name for name in names]
