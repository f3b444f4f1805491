"""`sdps data card`: the dataset card, Croissant metadata and checksums of a data folder."""

import argparse
import sys
from pathlib import Path

from pipelines.shared.flags import add_cache_argument
from render.checks.folder_checks import CHECKSUMS
from render.publishing import croissant, dataset_card
from render.records.mirror import display_name, open_folder


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
        _, missing = dataset_card.write_card(folder, *(text.strip() for text in texts))
    names = (dataset_card.CARD, croissant.FILE, CHECKSUMS)
    sys.stdout.write("".join(f"{display_name(folder, written=True)}/{name}\n" for name in names))
    if missing:
        sys.stdout.write(f"before publishing, give {', '.join(missing)}\n")
    return 0
