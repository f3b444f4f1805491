"""Which files of a folder are photographs, and what else lies there."""

from collections import Counter
from collections.abc import Sequence
from fnmatch import fnmatch
from pathlib import Path

from render.shared.errors import InputError
from render.shared.tables import natural_key, read_names
from sdps.photos.picture_file import SUFFIXES

LISTS = ("names.txt", "filenames.txt")
"""Files that name the photographs in order; the first that is there decides."""

_BENCHMARK = ("light_directions.txt", "light_intensities.txt", "filenames.txt", "lights.json")
_NO_PHOTOGRAPHS = ("mask", "normal", "depth")


def list_pictures(folder: Path, names: Sequence[str] | None = None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """List the photographs of a folder.

    Args:
        folder: The folder.
        names: File names or glob patterns in the wanted order; those that begin with `!` leave files out.

    Returns:
        Names below the folder, and notes about the choice.

    Raises:
        InputError: no such folder, a name without file, a name twice, no picture or just one.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the folder that holds the photographs")
    there = sorted((path.name for path in folder.iterdir() if _readable(path)), key=natural_key)
    usual = [name for name in there if not name.lower().startswith(_NO_PHOTOGRAPHS)]
    left_out = [name for name in there if name not in usual]
    notes = [f"left out: {', '.join(left_out)}"] if left_out else []
    listed = next((folder / name for name in LISTS if (folder / name).is_file()), None)
    if names is not None:
        files = _chosen(folder, names, usual)
        notes = [f"{len(files)} of {len(usual)} pictures were chosen by name"]
    elif listed is not None:
        files = read_names(listed)
        notes = [f"{listed.name} names the {len(files)} pictures and their order"]
        missing = next((name for name in files if not (folder / name).is_file()), None)
        if missing is not None:
            raise InputError(f"{listed}: names {missing}, which is not there; copy it there or drop the line")
    else:
        files = usual
    if not files:
        raise InputError(f"{folder}: no pictures in it{_others(folder)}; put PNG, TIFF, JPEG or EXR files there")
    if len(files) == 1:
        raise InputError(
            f"{folder}: only one picture, {files[0]}; photometric stereo compares at least 3 (better 20) of one object "
            "under different lights"
        )
    return tuple(files), tuple(notes)


def find_mask(folder: Path) -> Path | None:
    """Return the folder's `mask.*`, None where there is none.

    Raises:
        InputError: several.
    """
    found = sorted(path for path in folder.iterdir() if _readable(path) and path.stem.lower() == "mask")
    if len(found) > 1:
        raise InputError(f"{folder}: several masks ({', '.join(path.name for path in found)}); keep one or name it")
    return found[0] if found else None


def find_light_files(folder: Path) -> list[str]:
    """Return the names of files that a folder written by us or laid out as DiLiGenT has, and a camera's has not."""
    return [name for name in _BENCHMARK if (folder / name).is_file()]


def _readable(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()


def _chosen(folder: Path, names: Sequence[str], usual: Sequence[str]) -> list[str]:
    """Expand patterns, in their order, and take out what those with `!` match."""
    wanted = [name for name in names if not name.startswith("!")]
    unwanted = [name[1:] for name in names if name.startswith("!")]
    files: list[str] = []
    for name in wanted or ["*"]:
        found = [name] if (folder / name).is_file() else [file for file in usual if fnmatch(file, name)]
        if not found:
            raise InputError(f"{folder}: no picture {name!r} in it; name files or patterns like 'IMG_*.png'")
        files += [file for file in found if file not in files]
    return [file for file in files if not any(fnmatch(file, pattern) for pattern in unwanted)]


def _others(folder: Path) -> str:
    """Say which kinds of files are there instead."""
    kinds = Counter(path.suffix.lower() or "no suffix" for path in folder.iterdir() if path.is_file())
    kinds = Counter({kind: count for kind, count in kinds.items() if kind not in SUFFIXES})
    if not kinds:
        return ""
    return f" (but {', '.join(f'{count} {kind}' for kind, count in kinds.most_common(3))}, which are not read)"
