"""`sdps data import`: PS-FCN trees and DiLiGenT folders as a data folder."""

import argparse
import sys

from render.exchange.ingest import READERS, ImportOptions, ingest

DEFAULT_MARGIN = 15  # pixels; the margin SDPS-Net crops DiLiGenT with


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps data import`."""
    parser.add_argument("tree", help="root of the tree to import")
    parser.add_argument("--layout", required=True, help=f"{' or '.join(READERS)}")
    parser.add_argument("--out", required=True, help="data folder to write; an interrupted import goes on there")
    parser.add_argument("--split", default=None, choices=("train", "val", "test"),
                        help="split of all scenes (default: psfcn by its lists, diligent 'test')")  # fmt: skip
    parser.add_argument("--crop", type=int, nargs="?", const=DEFAULT_MARGIN, default=None, metavar="MARGIN",
                        help="crop to the mask's bounding box and a margin in pixels (15 if none is given), sides "
                        "rounded up to multiples of 4")  # fmt: skip
    parser.add_argument("--y-down", action="store_true", help="normals and lights of the source have y pointing down")
    parser.add_argument("--limit", type=int, default=None, help="only the first so many samples")


def main(args: argparse.Namespace) -> int:
    """Import, and tell what looks flipped."""
    options = ImportOptions(layout=args.layout, split=args.split, crop=args.crop, y_down=args.y_down, limit=args.limit)
    report = ingest(args.tree, args.out, options)
    sys.stdout.write(
        f"{args.out}: {len(report.scenes)} scenes from {args.layout}, {report.written} written now, {report.kept} "
        "kept; depth is unknown (zeros)\n"
    )
    for name, found in report.suspicions.items():
        sys.stdout.write(f"{name}: {'; '.join(found)}; if y points down in the source, import it with --y-down\n")
    return 0
