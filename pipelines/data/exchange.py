"""`sdps data export` and `sdps data import`: trees that other photometric-stereo code reads."""

import argparse
import sys
from collections.abc import Sequence
from typing import Literal

from pipelines.shared.flags import add_cache_argument
from render.exchange.ingest import READERS, ImportOptions, ingest
from render.exchange.layouts import LAYOUTS
from render.exchange.samples import ExportOptions
from render.records.manifest import SceneSpec, read_manifest
from render.records.mirror import open_folder, select_rendered
from render.shared.errors import InputError

UNCHECKED = "--check is gone: what other loaders read is held by tests of the export; leave it out"
_MARGIN = 15  # pixels; the margin SDPS-Net crops DiLiGenT with


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps data export`."""
    layouts = "; ".join(f"{name}: {layout.about}" for name, layout in LAYOUTS.items())
    parser.add_argument("folder", help="data folder (the one with manifest.jsonl)")
    parser.add_argument("--layout", required=True, help=layouts)
    parser.add_argument("--out", required=True, help="root of the tree; an interrupted export goes on there")
    parser.add_argument("--bits", type=int, default=None, help=f"8 or 16 per channel (default: {_defaults('bits')})")
    parser.add_argument("--exposure", default=None, help="factor on radiance (1: white facing its light is full scale) "
                        f"or 'auto', per scene (default: {_defaults('exposure')})")  # fmt: skip
    parser.add_argument("--intensities", default="unit", help="'unit', or 'seed': one per image in [0.2, 2), seeded")
    parser.add_argument("--ids", nargs="+", default=[], metavar="ID", help="only these scenes")
    parser.add_argument("--split", default=None, choices=("train", "val", "test"), help="only this split")
    parser.add_argument("--limit", type=int, default=None, help="only the first so many")
    parser.add_argument("--skip-missing", action="store_true", help="leave out planned scenes that have no shard yet")
    add_check_argument(parser)
    add_cache_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Export the scenes, and say what was rounded away and what has no place in the layout."""
    from render.exchange.export import export, select

    options = ExportOptions(
        layout=args.layout, bits=args.bits, exposure=exposure_flag(args.exposure), intensities=args.intensities
    )
    with open_folder(args.folder, args.cache_gb) as folder:
        scenes = planned(str(folder), skip_missing=args.skip_missing)
        chosen = select(scenes, ids=args.ids, split=args.split, limit=args.limit)
        done = export(folder, args.out, options, chosen)
    sys.stdout.write(
        f"{args.out}: {len(done.scenes)} scenes as {args.layout}, {done.written} written now, {done.kept} kept\n"
    )
    sys.stdout.write(_lost(chosen, args.layout))
    for field, words in (("clipped", "clipped"), ("black", "lit but rounded to black")):
        mean, most, worst = done.worst(field)
        sys.stdout.write(f"{words}: {mean:.2%} of the object's values on average, at most {most:.2%} ({worst})\n")
    sys.stdout.write(LAYOUTS[args.layout].advise(args.out, {scene["split"] for scene in done.scenes.values()}))
    return 0


def _defaults(field: str) -> str:
    """Say what each layout takes where a flag is not given."""
    values = {name: getattr(layout, field) for name, layout in LAYOUTS.items()}
    return ", ".join(f"{name} {value[0] if isinstance(value, tuple) else value}" for name, value in values.items())


def add_check_argument(parser: argparse.ArgumentParser) -> None:
    """Accept `--check`: it checked the tree until the loaders' rules became tests of the export."""
    parser.add_argument("--check", action="store_true", help=argparse.SUPPRESS)


def _lost(scenes: Sequence[SceneSpec], layout: str) -> str:
    """Say what of near lights and perspective has no place in a layout; nothing where there are none."""
    near = sum(bool(scene.light_distances) for scene in scenes)
    perspective = sum(scene.view.camera_distance is not None for scene in scenes)
    lines = []
    if near:
        lines.append(
            f"{near} scenes have near lights, which {layout} has no place for: directions are those from the object's "
            "centre; positions are in scene.json\n"
        )
    if perspective:
        lines.append(
            f"{perspective} scenes have a perspective camera, which {layout} has no place for; its distance is in "
            "scene.json\n"
        )
    return "".join(lines)


def planned(folder: str, *, skip_missing: bool) -> list[SceneSpec]:
    """Return the scenes of a data folder, with `skip_missing` only those that have a shard.

    Raises:
        InputError: no manifest, or none left.
    """
    scenes = read_manifest(folder)
    if skip_missing:
        scenes = select_rendered(folder, scenes)
        if not scenes:
            raise InputError(f"{folder}: no shard yet; render some with `sdps render-data`")
    return scenes


def exposure_flag(text: str | None) -> float | Literal["auto"] | None:
    """Read the flag: a number, `auto`, or nothing."""
    try:
        return "auto" if text == "auto" else None if text is None else float(text)
    except ValueError as error:
        raise InputError(f"--exposure {text}: expected a positive number or 'auto'") from error


def add_import_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps data import`."""
    parser.add_argument("tree", help="root of the tree to import")
    parser.add_argument("--layout", required=True, help=f"{' or '.join(READERS)}")
    parser.add_argument("--out", required=True, help="data folder to write; an interrupted import goes on there")
    parser.add_argument("--split", default=None, choices=("train", "val", "test"),
                        help="split of all scenes (default: that of the tree's lists, else test)")  # fmt: skip
    parser.add_argument("--crop", type=int, nargs="?", const=_MARGIN, default=None, metavar="MARGIN",
                        help="crop to the mask's bounding box and a margin in pixels (15 if none is given), sides "
                        "rounded up to multiples of 4")  # fmt: skip
    parser.add_argument("--y-down", action="store_true", help="normals and lights of the source have y pointing down")
    parser.add_argument("--limit", type=int, default=None, help="only the first so many samples")


def import_main(args: argparse.Namespace) -> int:
    """Import, and say what looks flipped."""
    options = ImportOptions(layout=args.layout, split=args.split, crop=args.crop, y_down=args.y_down, limit=args.limit)
    found = ingest(args.tree, args.out, options)
    sys.stdout.write(
        f"{args.out}: {len(found.scenes)} scenes from {args.layout}, {found.written} written now, {found.kept} "
        "kept; depth is unknown (zeros)\n"
    )
    for name, faults in found.suspicions.items():
        sys.stdout.write(f"{name}: {'; '.join(faults)}; if y points down in the source, import it with --y-down\n")
    return 0
