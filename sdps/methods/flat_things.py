"""Flat things that fill the frame: coins, reliefs, textiles, paint, rock art, photographed from straight ahead.

Photographs under unknown lights show a surface up to z' = lambda z + mu x + nu y, with lights to match (Belhumeur,
Kriegman and Yuille, The Bas-Relief Ambiguity, IJCV 1999). An outline resolves it; flat things have none, but their mean
plane is known to face the camera, which gives mu and nu: the slopes' mean is taken off, and the lights follow, so that
every picture looks as before. This is not a rotation: a turned surface under turned lights is seen from elsewhere.
Known intensities give lambda.

What is left is whether the relief stands out or is hollow: turned inside out under lights from the opposite side it
looks the same, but for cast shadows and near lamps (`relief_sides`), which decide where they can.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar, get_args

import cv2
import numpy as np

from render.shared.errors import InputError, unknown
from render.shared.imaging.vectors import unit
from sdps.core.estimate import Estimate
from sdps.core.integration import integrate
from sdps.core.intensities import grey
from sdps.inference.image_source import ImageSource
from sdps.inference.tiles import split_rows
from sdps.methods.relief_sides import TURN, tell_side

Wish = Literal["auto", "yes", "no", "turned"]
SHARE = 0.25
"""Share of the width that the mean slope is taken over, where slopes are flattened."""
_COVERS = 0.97
"""Share of the frame from which on a mask covers it."""
_THICKEST = 0.2
"""Height, over the longer side, above which what covers the frame is not flat."""
_LIKE, _LIKELY = 0.03, 0.4
"""How exactly intensities are known and found, and how far depth is expected to be off; natural logarithms."""
_STEEPEST, _LEAST_Z = 0.1, 0.05
_SMALL = 96  # pixels of the longer side where a few tell enough
_Found = TypeVar("_Found", bound=Estimate)


@dataclass(frozen=True)
class Flatness:
    """What is wished of flat things.

    Attributes:
        wish: `yes`; `turned`: yes, and what stood out came out hollow; `no`; `auto`: look whether it is one.
        share: Share of the width whose mean slope is taken off around every pixel; 0 for none.

    Raises:
        InputError: another wish, or a share that is none.
    """

    wish: Wish = "auto"
    share: float = 0.0

    def __post_init__(self) -> None:
        if self.wish not in get_args(Wish):
            raise unknown("--flat", self.wish, get_args(Wish))
        if not 0.0 <= self.share <= 1.0:
            raise InputError(f"--flatten {self.share:g}: a share of the width, above 0 and at most 1; {SHARE} is usual")
        if self.share and self.wish == "no":
            raise InputError("--flatten is for flat things; leave out --flat no")

    @property
    def asked(self) -> bool:
        """Whether the thing is said to be flat."""
        return self.wish in ("yes", "turned") or self.share > 0.0

    def may_apply(self, mask: np.ndarray, *, lit: bool) -> bool:
        """Return whether `applies` may say yes, before normals (H, W, 3) of the mask (H, W) are found."""
        return self.asked or (self.wish == "auto" and not lit and covers_frame(mask))

    def applies(self, mask: np.ndarray, normals: np.ndarray, *, lit: bool) -> bool:
        """Return whether the mean plane of what was found is to face the camera.

        Args:
            mask: (H, W) bool.
            normals: (H, W, 3) as first found.
            lit: Light directions were given: they tell the plane, which then is left unless it is asked for.
        """
        return self.asked or (self.wish == "auto" and not lit and is_flat(mask, normals))

    def begin(self, found: _Found, mask: np.ndarray, *, lit: bool, images: ImageSource | None = None) -> _Found:
        """Let the mean plane of what was first found face the camera, the right side out where pictures tell it.

        Args:
            found: What was found.
            mask: (H, W) bool.
            lit: Light directions were given.
            images: (L, H, W, 3); None: they are not asked for the side.

        Raises:
            InputError: it shall be turned inside out although lights were given.
        """
        if lit and self.wish == "turned":
            raise InputError("--flat turned: lights that are given tell what stands out; leave it out, or use --frame")
        level = face_camera(found, mask, lit=lit)
        if images is not None and not lit and len(level.light_directions):
            told = tell_side(images, mask, level)
            turned, by = told.side < 0, told.by if told.side else ""
            level = replace(turn_inside_out(level) if turned else level, side_by=by, turned=turned)
        return turn_inside_out(level) if self.wish == "turned" else level

    def finish(self, found: _Found, mask: np.ndarray, known: np.ndarray | None, *, lit: bool) -> _Found:
        """Let the mean plane of the answer face the camera, scale its depth, and flatten it where that is wished.

        Args:
            found: What was found, from `begin` on.
            mask: (H, W) bool.
            known: (L,) or (L, 3) intensities that were given, where those found moved freely; None where not.
            lit: Light directions were given.
        """
        level = replace(face_camera(found, mask, lit=lit), tilt=found.tilt)
        if known is not None and not lit:
            level = deepen(level, mask, find_depth(level, known))
        return replace(level, normals=flatten(level.normals, mask, self.share)) if self.share else level


NOT_FLAT = Flatness("no")


def covers_frame(mask: np.ndarray) -> bool:
    """Return whether a mask (H, W) covers the frame."""
    return float(mask.mean()) >= _COVERS


def is_flat(mask: np.ndarray, normals: np.ndarray) -> bool:
    """Return whether a mask (H, W) covers the frame, and normals (H, W, 3) are those of something thin."""
    if not covers_frame(mask):
        return False
    small, inside = _reduce(normals, mask)
    small = small - small[inside].mean(axis=0)
    heights = integrate(_to_normals(small), inside).z[inside]
    return float(np.ptp(np.percentile(heights, (1, 99)))) < _THICKEST * max(small.shape)


def face_camera(found: _Found, mask: np.ndarray, *, lit: bool) -> _Found:
    """Let the mean plane face the camera.

    Args:
        found: Normals, and lights that follow unless they were given.
        mask: (H, W) bool.
        lit: Light directions were given.

    Returns:
        The same with other normals and lights, and the tilt that was taken off.
    """
    total, count = np.zeros(2), int(mask.sum())
    for rows in split_rows(mask.shape):
        total += _slopes(found.normals[rows][mask[rows]]).sum(axis=0)
    mean = total / count
    normals = np.zeros_like(found.normals)
    for rows in split_rows(mask.shape):
        inside = mask[rows]
        normals[rows][inside] = _to_normals(_slopes(found.normals[rows][inside]) - mean)
    degrees = float(np.degrees(np.arctan(np.hypot(*mean))))
    if lit or not len(found.light_directions):
        return replace(found, normals=normals, tilt=degrees)
    lights = found.light_directions.astype(np.float64)
    lights[:, 2] = np.maximum(lights[:, 2] + lights[:, :2] @ mean, _LEAST_Z)
    return replace(found, normals=normals, tilt=degrees, **_split(lights, found.intensities))


def find_depth(found: Estimate, known: np.ndarray) -> float:
    """Return lambda: by how much deeper the surface is if the lights are as strong as is known.

    Under it lights (l_x, l_y, l_z) are (l_x / lambda, l_y / lambda, l_z), whose lengths are their intensities. Lights
    of one height tell nothing, and leave it at 1.

    Args:
        found: Lights whose intensities were free to explain the images.
        known: (L,) or (L, 3) intensities, of any scale.
    """
    lights = found.light_directions.astype(np.float64) * grey(found.intensities.astype(np.float64))[:, None]
    logs = np.linspace(-1.5, 1.5, 301)
    across, along = np.hypot(lights[:, 0], lights[:, 1]), lights[:, 2]
    lengths = np.hypot(across * np.exp(-logs)[:, None], along)  # (301, L)
    off = np.log(lengths / grey(known.astype(np.float64)))
    misfit = np.square((off - off.mean(axis=1, keepdims=True)) / _LIKE).sum(axis=1)
    return float(np.exp(logs[np.argmin(misfit + np.square(logs / _LIKELY))]))


def deepen(found: _Found, mask: np.ndarray, factor: float) -> _Found:
    """Return the surface made deeper by a factor, under the lights that leave every picture as it was."""
    normals = np.zeros_like(found.normals)
    for rows in split_rows(mask.shape):
        inside = mask[rows]
        normals[rows][inside] = _to_normals(factor * _slopes(found.normals[rows][inside]))
    lights = found.light_directions / np.array([factor, factor, 1.0])
    return replace(found, normals=normals, **_split(lights, found.intensities))


def turn_inside_out(found: _Found) -> _Found:
    """Return what stood out as hollow, under lights from the opposite side."""
    turn = TURN.astype(np.float32)
    return replace(found, normals=found.normals * turn, light_directions=found.light_directions * turn)


def flatten(normals: np.ndarray, mask: np.ndarray, share: float = SHARE) -> np.ndarray:
    """Take slow changes off the slopes, such as the bowl that uneven lamps make of a plane.

    First the slopes of the nearest quadric go, then their mean around every pixel: a Gaussian whose width (two standard
    deviations) is a share of the picture's.

    Args:
        normals: (H, W, 3) unit.
        mask: (H, W) bool.
        share: Of the width.

    Returns:
        (H, W, 3) float32, unit, zero outside the mask.
    """
    small, inside = _reduce(normals, mask)
    rows, columns = (axis / max(inside.shape) - 0.5 for axis in np.mgrid[: inside.shape[0], : inside.shape[1]])
    terms = np.stack([np.ones_like(rows), rows, columns], axis=-1)
    plane = terms @ np.linalg.lstsq(terms[inside], small[inside], rcond=None)[0]
    rest, sigma = np.where(inside[..., None], small - plane, 0.0), share * inside.shape[1] / 2
    weight = cv2.GaussianBlur(inside.astype(np.float64), (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    blurred = cv2.GaussianBlur(rest, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    slow = (plane + blurred / np.maximum(weight, 1e-6)[..., None]).astype(np.float32)
    slow = cv2.resize(slow, mask.shape[::-1], interpolation=cv2.INTER_CUBIC)
    found = np.zeros((*mask.shape, 3), np.float32)
    for part in split_rows(mask.shape):
        some = mask[part]
        found[part][some] = _to_normals(_slopes(normals[part][some]) - slow[part][some])
    return found


def _split(lights: np.ndarray, intensities: np.ndarray) -> dict[str, Any]:
    """Return directions, and intensities times the lengths, of lights (L, 3) that bent; none where there are none."""
    if len(intensities):
        longer = np.linalg.norm(lights, axis=1)
        intensities = (intensities * (longer[:, None] if intensities.ndim > 1 else longer)).astype(np.float32)
    return {"light_directions": unit(lights).astype(np.float32), "intensities": intensities}


def _slopes(normals: np.ndarray) -> np.ndarray:  # (..., 2)
    """Return n_x / n_z and n_y / n_z, which are -dz/dx and -dz/dy."""
    return normals[..., :2] / np.maximum(normals[..., 2:], _STEEPEST)


def _to_normals(slopes: np.ndarray) -> np.ndarray:  # (..., 3) float32
    return unit(np.concatenate([slopes, np.ones_like(slopes[..., :1])], axis=-1)).astype(np.float32)


def _reduce(normals: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return slopes (h, w, 2) float64 on a few pixels, means over the mask's, and which of them have any, (h, w)."""
    longest = max(mask.shape)
    size = tuple(max(1, round(side * min(1.0, _SMALL / longest))) for side in mask.shape[::-1])
    slopes = np.concatenate(
        [_slopes(normals[rows] * mask[rows][..., None]).astype(np.float32) for rows in split_rows(mask.shape)]
    )
    small = cv2.resize(slopes, size, interpolation=cv2.INTER_AREA).astype(np.float64)
    share = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return small / np.maximum(share, 1e-6)[..., None], share > 0.0
