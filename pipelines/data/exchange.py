"""`sdps data export` and `sdps data import`: trees that other photometric-stereo code reads, and their checks."""

import argparse
import sys
from collections.abc import Sequence
from typing import Literal

from pipelines.shared.flags import add_cache_argument
from render.exchange.export import ExportOptions, export
from render.exchange.ingest import IMPORTABLE, ImportOptions, ingest
from render.exchange.layouts import LAYOUTS
from render.exchange.tree_check import TreeReport, check_tree
from render.records.manifest import SceneSpec, read_manifest
from render.records.mirror import open_folder, select_rendered
from render.shared.errors import InputError, unknown

_SHOWN = 20
_MARGIN = 15  # pixels; the margin SDPS-Net crops DiLiGenT with


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps data export`."""
    layouts = "; ".join(f"{name}: {layout.about}" for name, layout in LAYOUTS.items())
    parser.add_argument("folder", help="data folder; with --check and no --out, the tree to check")
    parser.add_argument("--layout", required=True, help=layouts)
    parser.add_argument("--out", default=None, help="root of the tree; an interrupted export goes on there")
    parser.add_argument(
        "--bits", type=int, default=None, help=f"8 or 16 per channel (default: {_list_defaults('bits')})"
    )
    parser.add_argument("--exposure", default=None, help="factor on radiance (1: white facing its light is full scale) "
                        f"or 'auto', per scene (default: {_list_defaults('exposure')})")  # fmt: skip
    parser.add_argument("--intensities", default="unit", help="'unit', or 'seed': one per image in [0.2, 2), seeded")
    parser.add_argument("--limit", type=int, default=None, help="only the first so many (of a check: spread evenly)")
    add_scene_arguments(parser)
    add_cache_argument(parser)


def add_scene_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare which scenes to write, and whether to check the tree they are written to."""
    parser.add_argument("--ids", nargs="+", default=[], metavar="ID", help="only these scenes")
    parser.add_argument("--split", default=None, choices=("train", "val", "test"), help="only this split")
    parser.add_argument("--skip-missing", action="store_true", help="leave out planned scenes that have no shard yet")
    parser.add_argument("--check", action="store_true", help="check the tree against the rules of its loaders; "
                        "exit code 1 if it breaks one")  # fmt: skip


def main(args: argparse.Namespace) -> int:
    """Export, check, or both; say what was rounded away and what has no place in the layout."""
    options = ExportOptions(
        layout=args.layout, bits=args.bits, exposure=parse_exposure(args.exposure), intensities=args.intensities
    )
    if args.out is None:
        if not args.check:
            raise InputError("--out is missing; give the folder to export to, or --check to check FOLDER itself")
        return report_check(check_tree(args.folder, args.layout, limit=args.limit), args.folder)
    with open_folder(args.folder, args.cache_gb) as folder:
        return _export(args, str(folder), options)


def _export(args: argparse.Namespace, folder: str, options: ExportOptions) -> int:
    """Export scenes of a folder, say how it went, and check the tree if asked to."""
    chosen = select_scenes(folder, args)
    done = export(folder, args.out, options, chosen)
    sys.stdout.write(
        f"{args.out}: {len(done.scenes)} scenes as {args.layout}, {done.written} written now, {done.kept} kept\n"
    )
    sys.stdout.write(_describe_losses(chosen, args.layout))
    for field, words in (("clipped", "clipped"), ("black", "lit but rounded to black")):
        mean, most, worst = done.worst(field)
        sys.stdout.write(f"{words}: {mean:.2%} of the object's values on average, at most {most:.2%} ({worst})\n")
    gaps = LAYOUTS[args.layout].describe_gaps({scene["split"] for scene in done.scenes.values()})
    sys.stdout.write(f"{args.out}: {gaps}\n" if gaps else "")
    return report_check(check_tree(args.out, args.layout, shards=folder), args.out) if args.check else 0


def _list_defaults(field: str) -> str:
    """Say what each layout takes where a flag is not given."""
    values = {name: getattr(layout, field) for name, layout in LAYOUTS.items()}
    return ", ".join(f"{name} {value[0] if isinstance(value, tuple) else value}" for name, value in values.items())


def _describe_losses(scenes: Sequence[SceneSpec], layout: str) -> str:
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


def select_scenes(folder: str, args: argparse.Namespace) -> list[SceneSpec]:
    """Choose scenes of a data folder by the flags of `add_scene_arguments`.

    Raises:
        InputError: no manifest, an id that is not planned, or no scene left.
    """
    scenes = read_manifest(folder)
    if args.skip_missing:
        scenes = select_rendered(folder, scenes)
        if not scenes:
            raise InputError(f"{folder}: no shard yet; render some with `sdps render-data`")
    known = {scene.id for scene in scenes}
    for name in args.ids:
        if name not in known:
            raise unknown("scene", name, known)
    if args.limit is not None and args.limit < 1:
        raise InputError(f"--limit must be at least 1, got {args.limit}")
    wanted = set(args.ids) or known
    chosen = [scene for scene in scenes if scene.id in wanted and args.split in (None, scene.split)]
    if not chosen:
        raise InputError(f"no scene of {len(scenes)} is left by --ids and --split; choose others")
    return chosen[: args.limit]


def parse_exposure(text: str | None) -> float | Literal["auto"] | None:
    """Read the flag: a number, `auto`, or nothing."""
    try:
        return "auto" if text == "auto" else None if text is None else float(text)
    except ValueError as error:
        raise InputError(f"--exposure {text}: expected a positive number or 'auto'") from error


def report_check(found: TreeReport, tree: str) -> int:
    """Print what a check found; return 0 when nothing."""
    for line in found.violations[:_SHOWN]:
        sys.stdout.write(f"{line}\n")
    if len(found.violations) > _SHOWN:
        sys.stdout.write(f"... and {len(found.violations) - _SHOWN} more\n")
    sys.stdout.write("".join(f"warning: {line}\n" for line in found.warnings))
    low, high = found.lights
    lights = f"{low}" if low == high else f"{low} to {high}"
    verdict = f"{len(found.violations)} violations" if found.violations else "every rule of its loaders holds"
    sys.stdout.write(f"{tree}: {found.samples} samples of {lights} lights; {verdict}\n")
    return 1 if found.violations else 0


def add_import_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps data import`."""
    parser.add_argument("tree", help="root of the tree to import")
    parser.add_argument("--layout", required=True, help=f"{' or '.join(IMPORTABLE)}")
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
