"""What may be handed in where a folder of photographs is wanted, and the poses that it holds.

Meshroom keeps each pose of an object in a folder `ps_<pose>`, with the ambient picture inside and the mask beside it,
`<pose>.png`; networks of the UniPS family in a folder `<name>.data`, with pictures `L*` and `mask.png`. A ZIP holds any
of these, a film the frames of one pose.
"""

import shutil
import tempfile
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from render.shared.errors import InputError, list_names
from render.shared.tables import natural_key
from sdps.photos.light_files import SUFFIXES as LIGHT_FILES
from sdps.photos.pictures.listing import LISTS
from sdps.photos.pictures.picture_kinds import FILMS, SUFFIXES, UNREAD
from sdps.photos.pictures.picture_names import MASK, MESHROOM, UNIPS, name_layout, name_roles
from sdps.photos.pictures.sources.archive_files import unpack_folders
from sdps.photos.pictures.sources.film_frames import FLAG, check_every, is_film, take_frames

_UNIPS_PICTURES = "L*"
_FEWEST = 2  # pictures in a folder that is a pose


@dataclass(frozen=True, eq=False)
class Pose:
    """Photographs of an object in one position, of `find_poses`; `sdps.photos.load` reads it as it reads a folder.

    Attributes:
        name: Of the pose; of a plain folder its own.
        asked: What the user named.
        folder: Where the pictures lie.
        mask: The mask that lies beside it; None where there is none.
        names: Patterns of the names of its pictures; None for all.
        above: Folders whose lights are its lights as well, the nearest first.
        prefix: What may stand before the names of its pictures in a file of lights of several poses.
        notes: Plain sentences about what was done.
        room: Keeps the temporary files that an archive or a film was taken apart to; they go with it.
    """

    name: str
    asked: Path
    folder: Path
    mask: Path | None = None
    names: tuple[str, ...] | None = None
    above: tuple[Path, ...] = ()
    prefix: str = ""
    notes: tuple[str, ...] = ()
    room: "Room | None" = field(default=None, repr=False)

    @contextmanager
    def naming(self) -> Iterator[None]:
        """Let messages name what the user named, not the temporary folder that it was taken apart to."""
        try:
            yield
        except InputError as error:
            if self.room is None:
                raise
            raise InputError(str(error).replace(f"{self.room.path}", f"{self.asked.parent}")) from error


class Room:
    """A temporary folder that is removed with the last object that holds it, or when Python ends."""

    def __init__(self, inside: Path | None = None) -> None:
        """Make the folder in one that is there; None: where the system keeps such folders."""
        self.path = Path(tempfile.mkdtemp(prefix="sdps-", dir=inside))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)


def find_poses(place: str | Path, every: int | None = None, inside: Path | None = None) -> tuple[Pose, ...]:
    """Return the poses in a folder, a ZIP or a film: at least one, in natural order.

    Args:
        place: A folder of photographs; one that holds several folders `ps_<pose>` or `<name>.data`; a ZIP of any of
            these; a film, or a folder with nothing but a film.
        every: Of a film, take every n-th frame; None: so that about 60 are taken.
        inside: Where an archive or a film is taken apart; None: where the system keeps temporary folders.

    Raises:
        InputError: an archive or a film that cannot be read, another kind of file, `every` without a film.
    """
    place = Path(place)
    check_every(every)
    room: Room | None = None
    folder = place
    if place.suffix.lower() == ".zip" and place.is_file():
        room = Room(inside)
        unpack_folders(place, room.path / place.name, (*SUFFIXES, *UNREAD, *FILMS, *LIGHT_FILES, ".sfm"))
        folder = _descend(room.path / place.name)
    film = place if is_film(place) else _only_film(folder)
    if film is not None:
        room = room or Room(inside)
        frames = room.path / place.name if folder is place else film.with_name(f"{film.name}.frames")
        return (_open_film(place, film, frames, every, room),)
    if every is not None:
        raise InputError(f"{FLAG} {every}: {place} is no film; leave the flag out")
    if place.is_file() and room is None:
        raise InputError(f"{place}: is a file; give the folder that holds the photographs, a ZIP of it, or a film")
    return tuple(replace(pose, room=room) for pose in _in_folder(place, folder))


def only_pose(place: "str | Path | Pose", every: int | None = None) -> Pose:
    """Return the one pose of a place.

    Raises:
        InputError: as `find_poses`; several.
    """
    if isinstance(place, Pose):
        return place
    poses = find_poses(place, every)
    if len(poses) > 1:
        names = list_names([pose.folder.name for pose in poses])
        raise InputError(
            f"{place}: holds {len(poses)} poses ({names}); give one of these folders (`sdps infer` runs all; in Python "
            "use sdps.photos.find_poses)"
        )
    return poses[0]


def _descend(folder: Path) -> Path:
    """Return the folder that is all there is in a folder, as in a ZIP of one; itself where there is more."""
    inside = list(folder.iterdir())
    return _descend(inside[0]) if len(inside) == 1 and inside[0].is_dir() and not name_layout(folder.name) else folder


def _in_folder(asked: Path, folder: Path) -> tuple[Pose, ...]:
    """Return the poses of a folder."""
    if name_layout(folder.name):
        return (_pose(asked, folder),)
    try:
        below = sorted((path for path in folder.iterdir() if path.is_dir()), key=lambda path: natural_key(path.name))
    except OSError:  # reading it says what is wrong
        below = []
    for kind in (MESHROOM, UNIPS):
        poses = [
            _pose(asked, path) for path in below if name_layout(path.name) == kind and len(_pictures(path)) >= _FEWEST
        ]
        names = [pose.name.lower() for pose in poses]
        if poses and not _has_photographs(folder, names):
            if len(poses) == 1:
                said = f"the pictures are those of its folder {poses[0].folder.name}"
                return (replace(poses[0], notes=(said, *poses[0].notes)),)
            twice = len(set(names)) < len(names)
            return tuple(replace(pose, name=pose.folder.name) for pose in poses) if twice else tuple(poses)
    return (Pose(folder.absolute().name, asked, folder),)


def _has_photographs(folder: Path, poses: Sequence[str]) -> bool:
    """Tell whether a folder with poses holds photographs itself, beside the poses' masks."""
    pictures = _pictures(folder)
    roles = name_roles(pictures)
    rest = [name for name in pictures if name not in roles and Path(name).stem.lower() not in poses]
    return len(rest) >= _FEWEST or any((folder / name).is_file() for name in LISTS)


def _pose(asked: Path, folder: Path) -> Pose:
    """Return the pose that is a folder of Meshroom or of the UniPS family."""
    above = (folder.absolute().parent,)
    if name_layout(folder.name) == MESHROOM:
        name = folder.name[len(MESHROOM) :]
        beside = _beside(folder, name)
        notes = () if beside is None else (f"{beside.name} beside {folder.name} is its mask, as Meshroom has it",)
        return Pose(name, asked, folder, beside, None, above, f"{folder.name}/", notes)
    pictures = _pictures(folder)
    lit = [picture for picture in pictures if picture.startswith("L")]
    others = [picture for picture in pictures if picture not in lit and picture not in name_roles(pictures)]
    names = (_UNIPS_PICTURES,) if len(lit) >= _FEWEST and others else None
    return Pose(folder.name[: -len(UNIPS)], asked, folder, None, names, above, f"{folder.name}/")


def _open_film(asked: Path, film: Path, folder: Path, every: int | None, room: Room) -> Pose:
    """Write the frames of a film into a new folder; its mask may lie beside it, as `<film>.png` or `mask.png`."""
    mask = _beside(film, film.stem) or _beside(film, "mask")
    pose = Pose(film.stem, asked, folder, mask, None, (film.absolute().parent,), room=room)
    with pose.naming():
        return replace(pose, notes=take_frames(film, folder, every))


def _only_film(folder: Path) -> Path | None:
    """Return the film of a folder that holds no other pictures than its mask; None where that is not so.

    Raises:
        InputError: several.
    """
    try:
        there = [path for path in folder.iterdir() if not path.name.startswith(".")]
    except OSError:  # a file, or reading it says what is wrong
        return None
    films = sorted(path for path in there if is_film(path) and path.is_file())
    masks = {"mask", *(film.stem for film in films)}
    roles = name_roles(pictures := _pictures(folder))
    alone = all(roles.get(name) == MASK or Path(name).stem in masks for name in pictures)
    if not films or not alone or any(_pictures(path) for path in there if path.is_dir()):
        return None
    if len(films) > 1:
        raise InputError(f"{folder}: holds {len(films)} films ({list_names([film.name for film in films])}); name one")
    return films[0]


def _beside(place: Path, stem: str) -> Path | None:
    """Return the picture of this name that lies beside a folder or a file."""
    found = [place.absolute().parent / f"{stem}{suffix}" for suffix in SUFFIXES]
    return next((path for path in found if path.is_file()), None)


def _pictures(folder: Path) -> list[str]:
    """Return the names of pictures in a folder, none where it cannot be read."""
    try:
        return [path.name for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.name[0] != "."]
    except OSError:
        return []
