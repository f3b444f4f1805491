"""One look at every picture of a folder: which are photographs, that they fit together, and where the object is."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from render.shared.errors import InputError
from render.shared.imaging.reducing import reduce_image, smaller_shape
from render.shared.progress import progress_bar, stage
from sdps.photos.faults import Faults
from sdps.photos.masks import CutOut, Variation, automatic_mask, bright_part
from sdps.photos.picture_file import Picture, decode, is_misnamed, orient_pixels, turn_pixels
from sdps.photos.pictures.ambient import Background, Frame, find_frames, read_background
from sdps.photos.pictures.contents import judge_content, like_mask
from sdps.photos.pictures.gamma import resolve_gamma
from sdps.photos.pictures.lens import Lens
from sdps.photos.pictures.listing import Listing
from sdps.photos.pictures.picture_kinds import LOSSY, Coding
from sdps.photos.pictures.picture_names import MASK, is_bare
from sdps.photos.response import full_scale
from sdps.photos.scaling import read_reduced_mask, reduce_grey, reduce_linear, refuse_huge, scale_note

_DARK = 0.5
"""A picture named as a dark frame is one if its mean is under this share of the others' median."""
_BRIGHT = 0.9
"""A picture is not without the lamp if its mean, at the same exposure, is above this share of the others' median."""
_MANY = 8
"""Pictures of one size and kind for each of another that is left out for it, and does not stop."""

_ALL = 0.8
"""Share of an automatic mask that is the ball from which on nothing else is there, if nothing else is found."""


@dataclass(frozen=True, eq=False)
class Survey:
    """What one look at all files tells.

    Attributes:
        files: (L,) names of the photographs below the folder.
        coding, gamma, orientation: As of `Photographs`.
        mask: (H, W) bool.
        origin: `file` or `automatic`.
        notes: What was decided, in plain sentences.
        left_out: Which pictures were left out for what they look like, empty for none.
        full: (H, W) of the files' pictures, once turned.
        lenses: What the EXIF data of the photographs say.
        background: What is subtracted of every picture.
        variation: How much each pixel changes; None where the mask is a file.
    """

    files: tuple[str, ...]
    coding: Coding
    gamma: str | float
    orientation: int
    mask: np.ndarray
    origin: str
    notes: tuple[str, ...]
    left_out: str = ""
    full: tuple[int, int] = (0, 0)
    lenses: frozenset[Lens] = frozenset()
    background: Background | None = None
    variation: Variation | None = None

    def without(self, covered: np.ndarray) -> "Survey":
        """Return it with pixels (H, W) bool that are not the object's; an automatic mask is found again.

        Raises:
            InputError: nothing is left.
        """
        if self.variation is None:
            mask, notes = self.mask & ~covered, self.notes
        else:
            found, said = automatic_mask(self.variation.without(covered))
            lost = found.all() and covered[self.mask].mean() > _ALL
            mask, notes = found & ~covered & (not lost), (*self.notes[:-1], said)
        if not mask.any():
            raise InputError(
                "nothing but the ball is in the mask; draw a mask of the object, or name the folder of the ball's own "
                "pictures with --ball FOLDER"
            )
        return replace(self, mask=mask, notes=notes)


def survey(
    folder: Path,
    listing: Listing,
    gamma: str | float,
    mask_file: Path | None,
    faults: Faults,
    scale: float = 1.0,
    without_lamp: tuple[str | Path | None, str | Path | None] = (None, None),
) -> Survey:
    """Decode every file once: photographs of one kind and size, finite in the mask, and the mask if there is none.

    Args:
        folder: The folder.
        listing: Its pictures.
        gamma: As of `load`.
        mask_file: The mask, None for the listing's or, without one, an automatic mask.
        faults: What becomes of faults that leave something to compute.
        scale: What the pictures' sides are multiplied by.
        without_lamp: `ambient` and `dark` of `load`.

    Raises:
        InputError: pictures that cannot be used together.
    """
    masks = _read_masks(folder, listing) if mask_file is None else _Masks(mask_file, ())
    ambient = find_frames(folder, without_lamp[0], "--ambient", "an ambient picture", listing.ambient)
    dark = find_frames(folder, without_lamp[1], "--dark", "a dark frame", ())
    listing = _leave_out(folder, listing, {*ambient.paths, *dark.paths})
    look, odd = _look_through(_Look(folder, listing, gamma, faults, scale, masked=masks.file is not None))
    left = [f"{name} ({why})" for name, why in look.dropped.items()]
    left_out = f"left out: {', '.join(left)}; --images takes what it names" if left else ""
    left_out = "; ".join(text for text in (left_out, odd) if text)
    _check_fit(folder, look, left_out)
    assert look.first is not None  # two pictures fit
    notes = [note for note in (left_out, *masks.notes, *look.suspicious, *look.kinds(), look.why) if note]
    notes += [*_orientation_note(look), *scale_note(look.full, look.shape)]
    mask, origin, said = _find_mask(look, masks)
    _refuse_broken(folder, look.kept, look.broken, mask, faults)
    if (look.broken >= 0).any():
        notes.append("values that are not finite were set to 0")
    if dark.asked is None:
        dark = replace(dark, paths=tuple(folder / name for name in look.dark))
    background, subtracted = read_background(ambient, dark, lambda path: _read_frame(look, path), look.exposures)
    notes += subtracted
    return Survey(
        files=tuple(name for name in listing.files if name in look.kept), coding=look.first.coding, gamma=look.gamma,
        orientation=look.first.orientation, mask=mask, origin=origin,
        notes=(*notes, said), left_out=left_out, full=look.full, lenses=frozenset(look.lenses),
        background=background, variation=look.variation if origin == "automatic" else None,
    )  # fmt: skip


def _find_mask(look: "_Look", masks: "_Masks") -> tuple[np.ndarray, str, str]:
    """Return the mask (H, W) bool, whether it is from a `file` or `automatic`, and a sentence about it."""
    assert look.variation is not None
    if masks.file is not None:
        return read_reduced_mask(masks.file, look.full, look.shape), "file", f"the mask is {masks.file.name}"
    cut = look.cut.find(look.shape)
    if cut is not None:
        return cut, "file", "the mask is what is opaque in the pictures; a mask.png replaces it"
    if not look.variation.changes().any():
        look.faults.stop(
            f"{look.folder}: nothing changes between the pictures; is the lamp on and moved? otherwise give a mask"
        )
    found, said = automatic_mask(look.variation)
    return found, "automatic", said


@dataclass(eq=False)
class _Look:
    """Goes through the pictures one by one and holds none."""

    folder: Path
    listing: Listing
    asked: str | float
    faults: Faults
    scale: float
    masked: bool
    kept: list[str] = field(default_factory=list)
    dropped: dict[str, str] = field(default_factory=dict)
    suspicious: list[str] = field(default_factory=list)
    groups: dict[tuple[tuple[int, ...], Coding], list[str]] = field(default_factory=dict)
    layers: dict[str, list[str]] = field(default_factory=dict)
    turns: dict[int, list[str]] = field(default_factory=dict)
    turned: list[str] = field(default_factory=list)  # by their own tag
    dark: list[str] = field(default_factory=list)
    exposures: dict[str, float] = field(default_factory=dict)
    lenses: set[Lens] = field(default_factory=set)
    first: Picture | None = None
    gamma: str | float = "linear"
    why: str = ""
    full: tuple[int, int] = (0, 0)  # sides of the pictures, once turned
    shape: tuple[int, int] = (0, 0)  # and reduced
    variation: Variation | None = None
    cut: CutOut = field(default_factory=CutOut)
    broken: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))  # first picture with a value not finite
    levels: list[float] = field(default_factory=list)

    def through(self, judging: bool) -> None:
        """Decode all files; `judging` leaves out those that look like no photograph."""
        listing = self.listing
        order = [name for name in listing.files if name not in listing.dark] + list(listing.dark)
        for number, name in enumerate(progress_bar(order, desc="photographs", unit="picture", delay=5), start=1):
            picture = decode(self.folder / name)
            if name in listing.dark and _level(picture) < _DARK * np.median(self.levels or [0]):
                self.dark.append(name)
                continue
            if name not in listing.files:
                continue
            why = self._no_photograph(name, picture) if judging else ""
            if why:
                self.dropped[name] = why
            else:
                self._keep(name, picture)
            stage("reading", number, len(order))

    def anew(self, listing: Listing) -> "_Look":
        """Return a look at a listing that has seen nothing yet."""
        return _Look(self.folder, listing, self.asked, self.faults, self.scale, self.masked)

    def kinds(self) -> list[str]:
        """Say which files are of another kind than their names tell, and which layers of EXR files were read."""
        notes = []
        kind = self.first.coding.kind if self.first else ""
        wrong = [name for name in self.kept if is_misnamed(name, kind)]
        if wrong:
            verb = f"is a {kind} file" if len(wrong) == 1 else f"are {kind} files"
            notes.append(f"{_span(wrong)} {verb} in spite of the name, and read as such")
        if any(self.layers):
            parts = [f"{layer or 'the one without a name'}{'' if len(self.layers) == 1 else f' ({_span(names)})'}"
                     for layer, names in self.layers.items()]  # fmt: skip
            notes.append(f"layers read from the EXR files: {', '.join(parts)}")
        return notes

    def _no_photograph(self, name: str, picture: Picture) -> str:
        """Return why a picture is not a photograph, empty where it may be one."""
        role = judge_content(picture.pixels, lossy=picture.coding.kind in LOSSY)
        if role is None:
            return ""
        means = "has two values only, as a mask" if role == MASK else "has the colours of normals"
        if name in self.listing.certain:
            self.suspicious.append(f"{name} {means}; it is used as a photograph because it was named")
            return ""
        return f"{means}; --mask takes it as the mask" if role == MASK else means

    def _keep(self, name: str, picture: Picture) -> None:
        """Take a picture for a photograph."""
        self.kept.append(name)
        if self.first is None:
            self._begin(name, picture)
        assert self.first is not None and self.variation is not None
        pixels, usual = turn_pixels(picture, self.first.orientation, self.full), self.first.pixels.shape[:2]
        fits = pixels.shape[:2] == self.full
        self.groups.setdefault((usual if fits else picture.pixels.shape[:2], picture.coding), []).append(name)
        self.levels.append(_level(picture))
        self.exposures[name] = picture.exposure
        if picture.coding.kind == "EXR":
            self.layers.setdefault(picture.layer, []).append(name)
        if not fits or picture.coding != self.first.coding:
            return  # left out or refused when all are known
        self.turns.setdefault(picture.orientation, []).append(name)
        if picture.pixels.shape[:2] != usual:
            self.turned.append(name)
        self.lenses.add(picture.lens)
        if picture.coding.floating:
            touched = reduce_image((~np.isfinite(pixels).all(-1)).astype(np.float32), self.shape) > 0
            self.broken[(self.broken < 0) & touched] = len(self.kept) - 1
        if not self.masked:
            alpha = picture.alpha
            if alpha is not None:
                alpha = turn_pixels(replace(picture, pixels=alpha), self.first.orientation, self.full)
            self.cut.add(alpha)
            self.variation.add(reduce_grey(pixels, self.gamma, self.shape))

    def _begin(self, name: str, picture: Picture) -> None:
        """Settle what the first photograph decides."""
        self.full = orient_pixels(picture.pixels, picture.orientation).shape[:2]
        self.shape = smaller_shape(self.full, self.scale)
        refuse_huge(self.folder / name, self.full, self.shape, self.faults)
        self.first = picture
        self.gamma, self.why = resolve_gamma(self.asked, picture.coding, self.listing.places)
        self.variation = Variation(self.shape)
        self.broken = np.full(self.shape, -1, np.int32)


def _look_through(look: _Look) -> tuple[_Look, str]:
    """Look at all pictures, again without a few of another size or kind; also return what is said of these."""
    look.through(judging=True)
    judging = len(look.kept) >= len(look.dropped)
    if not judging:  # what most pictures look like is their nature
        look = look.anew(look.listing)
        look.through(judging=False)
    usual = max(look.groups, key=lambda group: len(look.groups[group]), default=None)
    odd = {name: group for group, names in look.groups.items() if group != usual for name in names}
    if usual is None or not odd or _MANY * len(odd) > len(look.groups[usual]) or look.listing.certain & odd.keys():
        return look, ""
    (height, width), coding = usual
    texts = [f"{name} ({other[0][1]}x{other[0][0]} pixels)" if other[0] != usual[0] else f"{name} ({other[1]})"
             for name, other in odd.items()]  # fmt: skip
    said = f"left out: {', '.join(texts)}; the others are {width}x{height} pixels, {coding}"
    rest = tuple(name for name in look.listing.files if name not in odd)
    look = look.anew(replace(look.listing, files=rest))
    look.through(judging)
    return look, said


def _leave_out(folder: Path, listing: Listing, taken: set[Path]) -> Listing:
    """Return the listing without files that are something else."""
    places = {path.resolve() for path in taken}
    files, dark = (tuple(name for name in names if (folder / name).resolve() not in places)
                   for names in (listing.files, listing.dark))  # fmt: skip
    return listing if not places else replace(listing, files=files, dark=dark)


def _read_frame(look: _Look, path: Path) -> Frame:
    """Read a picture without the lamp as the photographs are read."""
    assert look.first is not None
    picture = decode(path)
    pixels = turn_pixels(picture, look.first.orientation, look.full)
    why = _unfit(look, picture, pixels)
    linear = None if why else reduce_linear(pixels, look.gamma, look.shape)
    return Frame(linear, picture.exposure, why)


def _unfit(look: _Look, picture: Picture, pixels: np.ndarray) -> str:
    """Say why a picture cannot be subtracted from the photographs; empty if it can."""
    assert look.first is not None
    if pixels.shape[:2] != look.full:
        (height, width), (high, wide) = pixels.shape[:2], look.full
        return f"is {width}x{height} pixels, the photographs are {wide}x{high}"
    if picture.coding != look.first.coding:
        return f"is {picture.coding}, the photographs are {look.first.coding}"
    exposure = float(np.median(list(look.exposures.values())))
    alike = not exposure or not picture.exposure or abs(exposure / picture.exposure - 1) < 0.1
    bright = alike and _level(picture) > _BRIGHT * float(np.median(look.levels))
    return "is as bright as the photographs" if bright else ""


@dataclass(frozen=True)
class _Masks:
    file: Path | None
    notes: tuple[str, ...]


def _read_masks(folder: Path, listing: Listing) -> _Masks:
    """Choose the folder's mask.

    `mask.*` is always one; others, such as `cat_mask.png`, must have about two values, and several must
    hold the same.

    Raises:
        InputError: several that differ.
    """
    bare = [name for name in listing.masks if is_bare(name, MASK)]
    if len(bare) > 1:
        raise InputError(f"{folder}: several masks ({', '.join(bare)}); keep one, or name one with --mask")
    if bare:
        others = [name for name in listing.masks if name not in bare]
        why = f"left out: {_span(others)} (another mask than {bare[0]})"
        return _Masks(folder / bare[0], (why,) if others else ())
    found: list[tuple[str, np.ndarray]] = []
    odd: list[tuple[str, np.ndarray]] = []
    notes: list[str] = []
    for name in listing.masks:
        picture = decode(folder / name)
        cut_out = picture.alpha is not None and np.ptp(picture.alpha) > 0
        (found if cut_out or like_mask(picture.pixels) else odd).append((name, bright_part(picture)))
    if odd:
        names = _span([name for name, _ in odd])
        notes.append(f"left out: {names} (a mask by name, but of many grey values); --mask or --images takes it")
    if not found:
        return _Masks(None, tuple(notes))
    (first, one), *rest = found
    if not all(np.array_equal(other, one) for _, other in rest):
        names = _span([name for name, _ in found])
        raise InputError(f"{folder}: several masks that differ ({names}); name the right one with --mask FILE")
    if rest:
        notes.append(f"left out: {_span([name for name, _ in rest])} (the same mask as {first})")
    return _Masks(folder / first, tuple(notes))


def _level(picture: Picture) -> float:
    """Return the mean of some pixels, full scale = 1."""
    some = picture.pixels[::8, ::8]
    return float(np.nan_to_num(some.astype(np.float64), posinf=0, neginf=0).mean() / full_scale(some))


def _span(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 6 else f"{names[0]} to {names[-1]} ({len(names)} files)"


def _check_fit(folder: Path, look: _Look, left_out: str) -> None:
    """Refuse pictures of another size or coding than most, and a single one."""
    groups = look.groups
    if len(look.kept) < 2:
        raise InputError(
            f"{folder}: only one picture, {look.kept[0]}; photometric stereo compares at least 3; {left_out}"
        )
    if len(groups) < 2:
        return
    usual = max(groups, key=lambda group: len(groups[group]))
    shape, coding = usual
    odd = [name for group, names in groups.items() if group != usual for name in names]
    (other_shape, other), names = next((group, names) for group, names in groups.items() if group != usual)
    count, which = len(groups[usual]), f"{groups[usual][0]}"
    rest = f"the other {count} (as {which})" if len(odd) == 1 and count > 1 else f"{count} others (as {which})"
    rest, verb = (which, "is") if count == 1 else (rest, "are")
    more = f"; {len(odd)} differ: {_span(odd)}" if len(odd) > 1 and count > 1 else ""
    drop = f"--images '!{Path(names[0]).name}'" if len(odd) == 1 else "--images PATTERN"
    if other_shape != shape:
        sizes = [f"{width}x{height}" for height, width in (other_shape, shape)]
        hint = "it is turned by 90 degrees, turn it back" if other_shape == shape[::-1] else "the camera must not move"
        raise InputError(
            f"{folder / names[0]}: is {sizes[0]} pixels, {rest} {verb} {sizes[1]}{more}; all pictures must have one "
            f"size ({hint}); leave out what is not a photograph with {drop}"
        )
    raise InputError(
        f"{folder / names[0]}: is {other}, {rest} {verb} {coding}{more}; keep one kind in the folder, or choose with "
        f"{drop}"
    )


def _refuse_broken(folder: Path, files: Sequence[str], broken: np.ndarray, mask: np.ndarray, faults: Faults) -> None:
    """Refuse values that are not finite inside the mask."""
    inside = broken[mask]
    bad = inside[inside >= 0]
    if len(bad):
        name = files[int(bad.min())]
        faults.stop(
            f"{folder / name}: NaN or infinite values inside the mask ({len(bad)} pixels over all pictures); write it "
            "again or cut them out of the mask"
        )


def _orientation_note(look: _Look) -> list[str]:
    assert look.first is not None
    first, notes = look.first.orientation, []
    if look.turned:
        verb = "was" if len(look.turned) == 1 else "were"
        notes.append(f"{_span(look.turned)} {verb} saved turned and {verb} turned to agree by the own orientation tag")
    odd = [name for tag, names in look.turns.items() if tag != first for name in names if name not in look.turned]
    if odd:
        return [*notes, f"the orientation tags of {_span(odd)} differ from the first picture's, as happens when the "
                        "camera looks down; all were turned as the first"]  # fmt: skip
    return [*notes, "all pictures were turned upright as their orientation tag says"] if first != 1 else notes
