"""Is a folder of photographs fit for photometric stereo? Every finding in plain words, with what helps."""

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from sdps.photos.masks import border_share
from sdps.photos.measures import Measures, measure, measure_spread
from sdps.photos.reading import Photographs

LEVELS = ("error", "warning", "note")
"""How grave a finding is.

error: surely a fault of the pictures or files; `infer` stops, unless asked to go on (`anyway`).
warning: it may be a fault or the object's nature (a mirror is black in most pictures); expect a worse result.
note: worth knowing.
"""

_FEWEST, _FEW = 3, 8
_SATURATED = 0.02
_MANY_SATURATED = 0.5
_SHARED = 3  # pictures with one highest value
_BLACK, _DARK = 0.01, 0.05
_NOTHING = 1e-3  # of full scale: a quarter of a code of 8 linear bits
_SAME, _ALIKE = 0.02, 0.1
_STEADY = 0.05  # relative deviation of the pictures' brightness; 0.1 for a flat object under lights 0 to 45 degrees off
_LINE = 0.25
_CONE = np.cos(np.radians(15.0))
_FEW_CASTS = 0.05  # share of the pictures; on rendered glossy objects so many are flagged under lights all white
_SMALL_MASK, _LARGE_MASK = 1000, 4_000_000


@dataclass(frozen=True)
class Finding:
    """Something about the photographs the user should know.

    Attributes:
        level: error, warning or note.
        text: One or two plain sentences, with the remedy.
        images: Names of the photographs it is about; empty for all together.
    """

    level: str
    text: str
    images: tuple[str, ...] = ()


def check(photos: Photographs) -> list[Finding]:
    """Look for what spoils photometric stereo, the gravest first.

    The files are read once more, one at a time, and a few of them again.

    Raises:
        InputError: a file that can no longer be read.
    """
    measures = measure(photos)
    found = [Finding("error", text) for text in photos.overridden]
    found += [finding for rule in _RULES for finding in rule(photos, measures)]
    return sorted(found, key=lambda finding: LEVELS.index(finding.level))


def _list_names(photos: Photographs, chosen: np.ndarray) -> tuple[str, ...]:
    """Return the names of the images at the true places of (L,) bool."""
    return tuple(np.asarray(photos.files, object)[chosen])


def _count(photos: Photographs, _: Measures) -> Iterator[Finding]:
    count = len(photos)
    if count < _FEWEST:
        yield Finding("error", f"Only {count} pictures; {_FEWEST} are needed, {_FEW} work well. Take more.")
    elif count < _FEW:
        yield Finding("warning", f"Only {count} pictures. With fewer than {_FEW} results are poor; take 20 or more.")


def _brightness(photos: Photographs, measures: Measures) -> Iterator[Finding]:
    typical, floating = float(np.median(measures.levels)), photos.coding.floating
    if measures.peaks.max() <= (0.0 if floating else _NOTHING):
        yield Finding("error", "The object is black in every picture. Expose longer, or check the mask.")
        return
    mirror = not floating and typical < _BLACK
    if mirror:
        yield Finding(
            "warning",
            "The object is black in most pictures, but for some bright places, as mirrors and black gloss are. If it "
            "is neither, expose longer, or check the mask.",
        )
    black = measures.peaks < _BLACK if mirror else measures.levels < _BLACK * max(typical, 1e-9)
    if not floating and not mirror:
        black |= measures.levels < _BLACK / 4
        if float(measures.levels.max()) < _DARK:
            yield Finding("warning", "All pictures are very dark, so noise will show. Expose longer.")
    if black.any():
        names = _list_names(photos, black)
        yield Finding("warning", f"The object is black in {_pictures(names)}. Was the lamp off? Leave them out.", names)


def _saturation(photos: Photographs, measures: Measures) -> Iterator[Finding]:
    clipped = _check_clipped(photos, measures)
    if clipped.any():
        names = _list_names(photos, clipped)
        yield Finding(
            "warning",
            f"Clipped before it was saved: up to {measures.topped[clipped].max():.0%} of the object has one highest "
            f"value, {measures.tops.max():.4g}, in {_pictures(names)}. Expose less, or develop the pictures without "
            "cutting off the bright end.",
            names,
        )
    if photos.coding.floating:
        if not clipped.any():
            yield Finding("note", "Floating-point files have no full scale; nothing else looks overexposed.")
        return
    ruined = measures.saturated > _MANY_SATURATED
    much = (measures.saturated > _SATURATED) & ~ruined
    for level, which in (("error" if ruined.all() else "warning", ruined), ("warning", much)):
        if which.any():
            names = _list_names(photos, which)
            worst = measures.saturated[which].max()
            yield Finding(
                level,
                f"Overexposed: up to {worst:.0%} of the object is at full scale in {_pictures(names)}. Expose less; "
                "highlights of a glossy object may clip, the rest must not.",
                names,
            )


def _check_clipped(photos: Photographs, measures: Measures) -> np.ndarray:  # (L,) bool
    """Find pictures that share a highest value, on many pixels, below full scale.

    Values of 8 bits repeat by chance, and so do all pixels of a flat object that was computed.
    """
    if photos.coding.bits == 8 or measures.tops.max() >= photos.saturation:
        return np.zeros(len(photos), bool)
    much = (measures.topped > _SATURATED) & (measures.topped < _MANY_SATURATED)
    clipped = much & np.isclose(measures.tops, measures.tops.max(), rtol=1e-6)
    return clipped if clipped.sum() >= _SHARED else np.zeros_like(clipped)


def _movement(photos: Photographs, measures: Measures) -> Iterator[Finding]:
    shifts = np.array([(shift.rows, shift.columns) for shift in measures.shifts])
    lengths = np.hypot(*shifts.T)
    moved = lengths > 0
    if not moved.any():
        return
    names = _list_names(photos, moved)
    if moved.mean() > 0.5 and shifts[moved].std(0).max() > 0.25 * lengths[moved].mean():
        yield Finding(
            "warning",
            f"The edges lie in different places in most pictures, up to {lengths.max():.0f} pixels apart: the camera "
            "was held in the hand, or strong shadows move over the background. Use a tripod and a black background.",
            names,
        )
        return
    yield Finding(
        "warning",
        f"The camera or the object moved: the edges in {_pictures(names)} lie up to {lengths.max():.0f} pixels "
        "away from those of the others. Use a tripod and a remote release; leave these pictures out or retake them.",
        names,
    )


def _light_spread(photos: Photographs, measures: Measures) -> Iterator[Finding]:
    values = np.zeros(3)
    found = measure_spread(measures.observations.mean(-1))[:3]
    values[: len(found)] = found
    if values[1] < _SAME:
        brightness = measures.observations.mean((1, 2))
        steady = brightness.std() < _STEADY * brightness.mean()
        yield Finding(
            "error" if steady else "warning",
            "The shading hardly changes between the pictures"
            + (". " if steady else ", only the brightness of the whole, as on a flat object. ")
            + "Move the lamp around the object, and switch all other lights off.",
        )
    elif values[1] < _ALIKE:
        yield Finding(
            "warning",
            "The pictures differ little: the lights are too similar, too close to the camera's direction, or drowned "
            "by the room's light. Spread them over all sides, 20 to 60 degrees away from the camera's direction.",
        )
    elif values[2] < _LINE * values[1]:
        yield Finding(
            "warning",
            "The shading changes in one direction only, as if the lamp had moved along a line. Light the object from "
            "above and below as well as from left and right.",
        )


def _check_given_lights(photos: Photographs, _: Measures) -> Iterator[Finding]:
    if photos.light_directions is None:
        return
    lights = photos.light_directions.astype(np.float64)
    mean = lights.mean(0) / np.linalg.norm(lights.mean(0))
    values = np.linalg.svd(lights, compute_uv=False)
    if (lights[:, 2] > _CONE).all():
        yield Finding("warning", "All lights of the lights file are within 15 degrees of the camera. Spread them.")
    elif (lights @ mean > _CONE).all():
        yield Finding("warning", "All lights of the lights file are within 15 degrees of their mean. Spread them.")
    elif len(values) < 3 or values[2] < 0.1 * values[0]:
        yield Finding(
            "warning", "The lights of the lights file lie in one plane, which leaves normals undetermined. Spread them."
        )
    azimuth = np.sort(np.degrees(np.arctan2(lights[:, 1], lights[:, 0])))
    gap = float(np.diff(np.append(azimuth, azimuth[0] + 360)).max())
    if gap > 180:
        yield Finding("note", f"The lights come from one side only; no light comes from a sector of {gap:.0f} degrees.")


def _near_lamps(photos: Photographs, measures: Measures) -> Iterator[Finding]:
    known = photos.light_nearness is not None and photos.light_nearness.any()
    if measures.dimming.near and not known:
        yield Finding(
            "warning",
            "The whole frame is the object, and each picture dims towards the rim away from its lamp: the lamps "
            f"probably stood near, about {measures.dimming.distance:.1f} object widths away. Refinement allows for "
            "that; without it a flat object comes out as a dome. Give the lamps' distance if you know it, or move them "
            "further away, at least 5 object widths.",
        )


def _duplicates(photos: Photographs, measures: Measures) -> Iterator[Finding]:
    groups = defaultdict(list)
    for file, digest in zip(photos.files, measures.digests, strict=True):
        groups[digest].append(file)
    again = [names for names in groups.values() if len(names) > 1]
    if again:
        names = tuple(name for group in again for name in group)
        yield Finding("warning", f"The same picture appears twice: {', '.join(again[0])}. Keep one of each.", names)


def _colour(photos: Photographs, measures: Measures) -> Iterator[Finding]:
    cast = measures.casts > 0
    if not cast.any():
        return
    names = _list_names(photos, cast)
    if cast.mean() < _FEW_CASTS:
        text = f"The colour of {_pictures(names)} differs by up to {measures.casts.max():.0%}: another light, or gloss."
        yield Finding("note", text, names)
    else:
        yield Finding(
            "warning",
            f"The colour changes by up to {measures.casts.max():.0%} in {_pictures(names)}. Lock the white balance, "
            "use one lamp only, and keep daylight out.",
            names,
        )


def _camera(photos: Photographs, measures: Measures) -> Iterator[Finding]:
    for name in ("exposure time", "aperture", "ISO", "focal length"):
        values = [settings[name] for settings in measures.settings if name in settings]
        if not values or max(values) - min(values) <= 1e-3 * max(values):
            continue
        level = "warning" if name == "focal length" else "note"
        effect = (
            "so the object changes its size; take them again with one zoom"
            if name == "focal length"
            else "so found intensities include it; lock it next time"
        )
        yield Finding(
            level, f"The camera changed its {name} between the pictures ({min(values):g} to {max(values):g}), {effect}."
        )


def _gamma(photos: Photographs, _: Measures) -> Iterator[Finding]:
    coding, linear = photos.coding, photos.gamma == "linear"
    if linear and coding.curve is not None and coding.curve > 1.2:
        yield Finding(
            "warning",
            f"The files' colour profile says display values (exponent {coding.curve:.1f}), but they are taken as "
            "linear. Use gamma auto unless you know better.",
        )
    elif linear and coding.kind == "JPEG":
        yield Finding("warning", "JPEG files are taken as linear, which cameras do not write. Use gamma srgb.")
    elif not linear and coding.floating:
        yield Finding("warning", f"{coding.kind} files of floating-point numbers are mostly linear. Use gamma linear.")
    elif not linear and coding.bits == 16 and coding.curve is None:
        yield Finding("note", "16-bit files without profile are mostly linear, but a display curve was taken off.")


def _mask(photos: Photographs, measures: Measures) -> Iterator[Finding]:
    size = int(photos.mask.sum())
    if photos.mask_origin == "whole frame":
        pass  # as asked
    elif photos.mask.all():
        yield Finding(
            "warning" if photos.mask_origin == "automatic" else "note",
            "The whole frame is taken for the object. If there is a background, draw a mask.png, white on black.",
        )
    elif measures.outside > 2 and border_share(photos.mask) > 0.5:
        yield Finding("warning", "The mask is darker inside than outside; is it inverted? The object must be white.")
    elif photos.mask_origin == "automatic":
        yield Finding("note", f"The mask was found automatically ({size} pixels). Look at it; mask.png replaces it.")
    if size < _SMALL_MASK:
        yield Finding("warning", f"The object has {size} pixels only. Go closer; 100x100 is a good minimum.")
    if size > _LARGE_MASK:
        yield Finding(
            "warning",
            f"The object has {size / 1e6:.0f} million pixels, which takes long. --scale 0.5 (in Python load(..., "
            "scale=0.5)) halves the sides of pictures and mask as they are read.",
        )


def _pictures(names: tuple[str, ...]) -> str:
    """Name up to three pictures, or say how many there are."""
    return ", ".join(names) if len(names) <= 3 else f"{len(names)} pictures ({names[0]}, {names[1]}, ...)"


_RULES: tuple[Callable[[Photographs, Measures], Iterator[Finding]], ...] = (
    _count,
    _brightness,
    _saturation,
    _movement,
    _light_spread,
    _check_given_lights,
    _near_lamps,
    _duplicates,
    _colour,
    _camera,
    _gamma,
    _mask,
)
