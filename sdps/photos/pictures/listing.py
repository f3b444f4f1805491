"""Which files of a folder are photographs, and what else lies there."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path, PurePosixPath

from render.shared.errors import InputError
from render.shared.tables import natural_key, read_names
from sdps.photos.pictures.picture_kinds import NAMED, ORIGINALS, SUFFIXES, UNREAD
from sdps.photos.pictures.picture_names import AMBIENT, DARK, MASK, is_bare, name_roles

LISTS = ("names.txt", "filenames.txt")
"""Files that name the photographs in order; the first that is there decides."""

_BENCHMARK = ("light_directions.txt", "light_intensities.txt", "filenames.txt", "lights.json")
_MOST = 8
"""Names of one kind that a note lists one by one."""
_FEWEST = 3
"""Pictures from which on they are read, and not the RAW or HEIC files beside them, of which they may be copies."""


@dataclass(frozen=True)
class Listing:
    """The pictures of a folder.

    Attributes:
        files: Names of the photographs below the folder, `/` between folders, in order.
        certain: Those of them that the user or a list of names named one by one; what they look like does not matter.
        dark: Dark frames by their names, if they are dark; of those in `files`, the others are photographs.
        ambient: Pictures without the lamp by their names; not in `files`.
        masks: Names of masks below the folder, one named `mask` first.
        places: The folder and, where the photographs lie in one of its folders, that one; other files may be in either.
        notes: What was decided, in plain sentences.
    """

    files: tuple[str, ...]
    certain: frozenset[str]
    dark: tuple[str, ...]
    masks: tuple[str, ...]
    places: tuple[Path, ...]
    notes: tuple[str, ...]
    ambient: tuple[str, ...] = ()


def list_pictures(folder: Path, names: Sequence[str] | None = None) -> Listing:
    """List the photographs of a folder, or of the only one of its folders that holds any.

    Args:
        folder: The folder.
        names: File names or glob patterns in the wanted order; those that begin with `!` leave files out.

    Raises:
        InputError: no such folder, a name without file, a name twice, no picture or just one.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the folder that holds the photographs")
    listed = None if names is not None else _list_of(folder)
    if listed is None:
        choice = _by_name(folder, names)
        listed = _list_of(folder / choice.place) if names is None and choice.place else None
    if listed is not None:
        choice = _by_list(folder, listed)
    files, there, place = choice.files, choice.there, choice.place
    roles = name_roles(there)
    notes = [f"the pictures are those of its folder {place}"] if place else []
    notes += choice.notes
    notes += [
        f"{name} is {roles[name]} by its name; it is used as a photograph because it was named"
        for name in files
        if name in choice.certain and name in roles
    ]
    notes += _unread(folder / place)
    _check_count(folder, files, notes)
    masks = [name for name in there if roles.get(name) == MASK and name not in files]
    masks.sort(key=lambda name: not is_bare(name, MASK))
    unwanted = [name[1:] for name in names or () if name.startswith("!")]
    dark, ambient = (
        tuple(name for name in there if roles.get(name) == role and name not in choice.certain
              and not any(_matches(name, pattern) for pattern in unwanted))
        for role in (DARK, AMBIENT)
    )  # fmt: skip
    places = (folder, folder / place) if place else (folder,)
    return Listing(tuple(files), frozenset(choice.certain), dark, tuple(masks), places, tuple(notes), ambient)


@dataclass(frozen=True)
class _Choice:
    """Which of the pictures that are there are photographs, and those of them that were named one by one."""

    files: list[str]
    certain: set[str]
    there: list[str]
    place: str
    notes: list[str]


def _by_list(folder: Path, listed: Path) -> _Choice:
    files, place = _read_list(listed)
    if listed.parent != folder:
        base = listed.parent.relative_to(folder).as_posix()
        files, place = [f"{base}/{name}" for name in files], f"{base}/{place}".rstrip("/")
    there = _pictures(folder) + _below(folder, place)
    roles = name_roles(there)
    others = [name for name in there if name not in files and roles.get(name) not in (MASK, AMBIENT, DARK)]
    left = f"; not in it: {_join(others)}" if others else ""
    return _Choice(
        files, set(files), there, place, [f"{listed.name} names the {len(files)} pictures and their order{left}"]
    )


def _by_name(folder: Path, names: Sequence[str] | None) -> _Choice:
    there, place = _pictures(folder), ""
    roles = name_roles(there)
    if all(name in roles or _is_original(name) for name in there):
        place = _only_folder(folder, there)
        there += _below(folder, place)
        roles = name_roles(there)
    usual = [name for name in there if roles.get(name) in (None, DARK)]
    usual, aside = _set_aside(usual)
    files, certain = (usual, set()) if names is None else _choose(folder, names, usual, there, aside)
    notes = [] if names is None else [f"{len(files)} of {len(usual)} pictures were chosen by name"]
    left = {name: role for name, role in roles.items() if name not in files and role not in (MASK, AMBIENT)}
    notes += _name_left_out(left if names is None else {})
    return _Choice(files, certain, there, place, notes + _name_aside([name for name in aside if name not in files]))


def _is_original(name: str) -> bool:
    return SUFFIXES.get(Path(name).suffix.lower()) in ORIGINALS


def _set_aside(usual: list[str]) -> tuple[list[str], list[str]]:
    """Split photographs into those that are read, and copies or originals of them, so that two kinds do not meet."""
    plain, originals = ([name for name in usual if _is_original(name) == is_one] for is_one in (False, True))
    return (plain, originals) if len(plain) >= _FEWEST or not originals else (originals, plain)


def _name_aside(aside: Sequence[str]) -> list[str]:
    """Say which pictures are set aside, by suffix."""
    kinds = Counter(Path(name).suffix.lower() for name in aside)
    counts = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
    hint = " and ".join(f"'*{suffix}'" for suffix in dict.fromkeys(Path(name).suffix for name in aside))
    return [f"left out: {counts} (the other pictures are read; --images {hint} takes these)"] if aside else []


def find_light_files(folder: Path) -> list[str]:
    """Return the names of files that a folder written by us or laid out as DiLiGenT has, and a camera's has not."""
    return [name for name in _BENCHMARK if (folder / name).is_file()]


def _readable(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()


def _pictures(folder: Path) -> list[str]:
    return sorted((path.name for path in folder.iterdir() if _readable(path)), key=natural_key)


def _below(folder: Path, place: str) -> list[str]:
    """Return the pictures of a folder's folder, named from the former."""
    return [f"{place}/{name}" for name in _pictures(folder / place)] if place else []


def _folders(folder: Path, originals: bool = True) -> list[str]:
    """Return the folders in a folder with two photographs and more; those of `originals` if there are no others."""
    found: dict[bool, list[str]] = {False: [], True: []}
    for path in sorted(folder.iterdir(), key=lambda path: natural_key(path.name)):
        if path.is_dir() and not path.name.startswith("."):
            try:
                pictures = _pictures(path)
            except OSError:  # not ours to read
                continue
            photographs = set(pictures) - name_roles(pictures).keys()
            if len(photographs) >= 2:
                found[sum(map(_is_original, photographs)) > len(photographs) - 2].append(path.name)
    return found[False] or (found[True] if originals else [])


def _list_of(folder: Path) -> Path | None:
    return next((folder / name for name in LISTS if (folder / name).is_file()), None)


def _only_folder(folder: Path, there: Sequence[str]) -> str:
    """Return the one folder in a folder that holds photographs, empty where there is none."""
    if any(map(_is_original, there)):  # read where there are no copies
        folders = _folders(folder, originals=False)
        return folders[0] if len(folders) == 1 else ""
    folders = _folders(folder)
    if len(folders) > 1:
        what = "no photographs in it" if there else "no pictures in it"
        raise InputError(f"{folder}: {what}, but in its folders {', '.join(folders[:_MOST])}; give one of these")
    return folders[0] if folders else ""


def _read_list(path: Path) -> tuple[list[str], str]:
    """Return the files that a list names, and the folder in the list's folder that they lie in, empty for itself."""
    folder, names = path.parent, read_names(path)
    best: list[str | None] = []
    for place in ("", *_folders(folder)):
        pictures = {name.lower(): name for name in reversed(_pictures(folder / place))}
        copies = {Path(name).stem for name in pictures if not _is_original(name)}
        stems = Counter(Path(name).stem for name in pictures if not (_is_original(name) and Path(name).stem in copies))
        whole = sorted(pictures.items(), key=lambda item: not _is_original(item[0]))  # copies overwrite originals
        bare = {Path(name).stem: as_is for name, as_is in whole if stems[Path(name).stem] == 1}
        found = [_find(folder, place, name, pictures, bare) for name in names]
        if None not in found:
            files = [name for name in found if name is not None]
            twice = next((name for name, count in Counter(files).items() if count > 1), None)
            if twice is not None:
                raise InputError(f"{path}: names {twice} twice; remove one of the lines")
            parents = {str(PurePosixPath(name).parent) for name in files}
            return files, parents.pop() if len(parents) == 1 and parents != {"."} else ""
        if not best or found.count(None) < best.count(None):
            best = found
    missing = names[best.index(None)]
    raise InputError(f"{path}: names {missing}, which is not there; copy it there or drop the line")


def _find(folder: Path, place: str, name: str, pictures: dict[str, str], bare: dict[str, str]) -> str | None:
    """Find what a list names: as it stands, or the last part of a path from elsewhere, with or without suffix."""
    parts = PurePosixPath(name.replace("\\", "/"))
    inside = not parts.is_absolute() and ".." not in parts.parts and not re.match(r"[A-Za-z]:", name)
    if inside and not place and (folder / parts).is_file():
        return str(parts)
    found = parts.name if parts.name in pictures.values() else pictures.get(parts.name.lower())
    found = found or bare.get(parts.name.lower())
    return None if found is None else f"{place}/{found}" if place else found


def _choose(
    folder: Path, names: Sequence[str], usual: Sequence[str], there: Sequence[str], aside: Sequence[str] = ()
) -> tuple[list[str], set[str]]:
    """Expand patterns, in their order, and take out what those with `!` match; return those named in full as well."""
    wanted = [name for name in names if not name.startswith("!")]
    unwanted = [name[1:] for name in names if name.startswith("!")]
    files: list[str] = []
    certain = set()
    for name in wanted or ["*"]:
        exact = name if (folder / name).is_file() else next((file for file in there if Path(file).name == name), None)
        found = [exact] if exact is not None else [file for file in usual if _matches(file, name)]
        found = found or [file for file in aside if _matches(file, name)]
        if not found:  # what a name says is left out, unless it is asked for
            found = [file for file in there if _matches(file, name)]
            certain.update(found)
        if exact is not None:
            certain.add(exact)
        if not found:
            raise InputError(f"{folder}: no picture {name!r} in it; name files or patterns like 'IMG_*.png'")
        files += [file for file in found if file not in files]
    return [file for file in files if not any(_matches(file, pattern) for pattern in unwanted)], certain


def _matches(file: str, pattern: str) -> bool:
    return fnmatch(file, pattern) or fnmatch(Path(file).name, pattern)


def _name_left_out(roles: dict[str, str]) -> list[str]:
    """Say which pictures are left out, and why."""
    kinds: dict[str, list[str]] = {}
    for name, role in roles.items():
        kinds.setdefault(role, []).append(name)
    texts = [f"{_join(names)} ({role} by name)" for role, names in kinds.items()]
    return [f"left out: {', '.join(texts)}; --images takes what it names"] if texts else []


def _join(names: Sequence[str]) -> str:
    """Name files, of very many the first and the last."""
    if len(names) <= _MOST:
        return ", ".join(names)
    return f"{', '.join(names[:2])} to {names[-1]}, {len(names)} files"


def _unread(folder: Path) -> list[str]:
    """Say which pictures of other kinds are there as well."""
    kinds = Counter(path.suffix.lower() for path in folder.iterdir() if path.suffix.lower() in UNREAD)
    counts = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
    return [f"left out: {counts} ({NAMED} are read)"] if counts else []


def _check_count(folder: Path, files: Sequence[str], notes: Sequence[str]) -> None:
    left = "".join(f"; {note}" for note in notes if note.startswith("left out"))
    if not files:
        raise InputError(f"{folder}: no pictures in it{_others(folder)}; put PNG, TIFF, JPEG or EXR files there{left}")
    if len(files) == 1:
        raise InputError(
            f"{folder}: only one picture, {files[0]}; photometric stereo compares at least 3 (better 20) of one object "
            f"under different lights{left}"
        )


def _others(folder: Path) -> str:
    """Say which kinds of files are there instead."""
    kinds = Counter(path.suffix.lower() or "no suffix" for path in folder.iterdir() if path.is_file())
    kinds = Counter({kind: count for kind, count in kinds.items() if kind not in SUFFIXES})
    if not kinds:
        return ""
    return f" (but {', '.join(f'{count} {kind}' for kind, count in kinds.most_common(3))}, which are not read)"
