"""`sdps export`: a result of `sdps infer` in the forms, frames and units that other programs want."""

import argparse
import sys
from pathlib import Path

from render.shared.errors import InputError, unknown

FOLDER = "exports"
"""In a result: where its exports lie by default."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps export`."""
    parser.add_argument("folder", type=Path, nargs="?", metavar="RESULT",
                        help="folder that `sdps infer` has written")  # fmt: skip
    parser.add_argument("--as", dest="names", default=None, metavar="NAME[,NAME]",
                        help="what to write, each into a folder of its name (default: show what there is)")  # fmt: skip
    add_normals(parser)
    parser.add_argument("--out", type=Path, default=None, help=f"output folder (default: {FOLDER} in the result)")


def add_normals(parser: argparse.ArgumentParser) -> None:
    """Declare the flag of normal maps."""
    parser.add_argument("--normals", default=None, metavar="NAME[,NAME]",
                        help="write normal maps for opengl (Blender, glTF), directx (Unreal), camera (our frame) or "
                        "alicevision; as the export normals-NAME")  # fmt: skip


def main(args: argparse.Namespace) -> int:
    """Write the exports, or show what there is."""
    from sdps.surface.exports.registry import EXPORTS, write_exports
    from sdps.surface.exports.saved_result import read_result

    names, width = choose_exports(args.names, args.normals), max(map(len, EXPORTS))
    lines = [f"{name:{width}}  {export.about}" for name, export in EXPORTS.items()]
    if names and args.folder is None:
        raise InputError("name the folder that `sdps infer` has written")
    if args.folder is not None:
        result = read_result(args.folder)
        if names:
            lines = [str(path) for path in write_exports(result, names, args.out or args.folder / FOLDER)]
    sys.stdout.write("\n".join(lines) + "\n")
    return 0


def choose_exports(names: str | None, normals: str | None) -> tuple[str, ...]:
    """Return the exports that two flags name.

    Raises:
        InputError: an unknown one, with the nearest.
    """
    if names is None and normals is None:  # most runs of `infer`: nothing is loaded for them
        return ()
    from sdps.surface.exports.normal_maps import CONVENTIONS
    from sdps.surface.exports.registry import split_names

    chosen = [] if names is None else list(split_names(names))
    for name in () if normals is None else (part.strip().lower() for part in normals.split(",")):
        if name not in CONVENTIONS:
            raise unknown("normal map", name, CONVENTIONS)
        chosen.append(f"normals-{name}")
    return tuple(dict.fromkeys(chosen))
