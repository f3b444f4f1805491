"""`sdps data relight`: images under environments, areas and mixtures, mixed from scenes of a dense light stage."""

import argparse
import sys
from pathlib import Path

from pipelines.data.exchange import add_scene_arguments, parse_exposure, report_check, select_scenes
from pipelines.shared.flags import add_fields, from_flags
from render.exchange.export import ExportOptions, export
from render.exchange.tree_check import check_tree
from render.shared.errors import InputError
from render.shared.imaging import environments, mixing


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps data relight`."""
    parser.add_argument("folder", help=f"data folder whose scenes have {mixing.FEWEST} lights or more all around "
                        "(data.lights=stage data.light_count=256)")  # fmt: skip
    parser.add_argument("--out", required=True, help="root of the tree; an interrupted run goes on there")
    parser.add_argument("--layout", default="unips", help="layout of the tree; unips is the one without lights' files")
    parser.add_argument("--images", type=int, default=10, help="images of each scene")
    parser.add_argument("--seed", type=int, default=0, help="seed of the mixtures")
    add_fields(parser, mixing.LightMix)
    parser.add_argument("--bits", type=int, default=None, help="8 or 16 per channel (default: 16)")
    parser.add_argument("--exposure", default=None, help="factor on radiance or 'auto', per scene (default: auto)")
    parser.add_argument("--limit", type=int, default=None, help="only the first so many scenes")
    add_scene_arguments(parser)


def main(args: argparse.Namespace) -> int:
    """Mix, write, and say what of each map is lost."""
    mixed = from_flags(mixing.LightMix, args)
    options = ExportOptions(
        layout=args.layout, bits=args.bits, exposure=parse_exposure(args.exposure), mixed=mixed, images=args.images,
        seed=args.seed,
    )  # fmt: skip
    chosen = select_scenes(args.folder, args)
    if Path(args.out).resolve() == Path(args.folder).resolve():
        raise InputError(f"--out {args.out}: is the data folder itself; choose another")
    done = export(args.folder, args.out, options, chosen)
    sys.stdout.write(
        f"{args.out}: {len(done.scenes)} scenes of {args.images} images as {args.layout}, {done.written} written now, "
        f"{done.kept} kept; scene.json says each image's light\n"
    )
    for name in mixed.environments if mixed.environment else ():
        if not environments.is_file(name) and ":" not in name:
            name = f"{name}:0"  # others of the kind lose about as much
        lost = mixing.share_behind(environments.load(name))
        sys.stdout.write(f"{name}: {lost:.0%} of its light comes from behind the object and is left out\n")
    return report_check(check_tree(args.out, args.layout, shards=args.folder), args.out) if args.check else 0
