"""Which pixels belong to the object: from a mask file, or from how much each pixel changes with the light.

Under a moving lamp the object changes and a dark, distant background does not, under any steady light of the room.
"""

from pathlib import Path

import numpy as np
from scipy import ndimage
from skimage.filters import threshold_otsu

from render.shared.errors import InputError
from render.shared.imaging.reducing import reduce_mask
from sdps.photos.picture_file import Picture, decode, orient_pixels
from sdps.photos.response import full_scale

_LARGEST = 0.9
"""Share of the frame above which an automatic mask has found no background."""

_BORDER = 0.3
"""Share of the frame's border above which an automatic mask is not believed."""

_SEPARATION = 0.68
"""Otsu's criterion, the between-class share of the variance, under which there are no two classes.

0.64 for a Gaussian histogram, and 0.73 to 0.93 on the real photographs it was tried on (DiLiGenT's ball, six objects of
the University of Washington's set).
"""

_SCATTERED, _FOLLOWS = 0.25, 0.07
"""Shares above which a mask is one of many parts of a larger whole: of what changes most, outside it; and of the mask's
change with the light, the change of what lies outside.

Right masks of dark backgrounds have at most 0.20 of the second (DiLiGenT's pot, whose mask lacks its dark parts; 0.01
to 0.05 on the others), and where the first is larger (mirrors, of which highlights alone are found) 0.06. Reliefs that
fill the frame have 0.25 to 0.98 of the first, and 0.07 to 0.98 of the second.
"""

_AS_BRIGHT, _AS_MUCH = 0.6, 0.5
"""Brightness and change of what lies outside, as shares of the mask's, above which the two are of one kind.

A grey table under lights from all heights, as bright as the object, reaches both; one half as reflective as a painted
sphere has 1.2 and 0.49, and the sphere's mask is right.
"""

_SMALLEST = 1e-4

_ALIKE = 0.9
"""Share of what is opaque in some photograph that must be so in all, for it to be the object."""

_MESHROOM = 0.7
"""Share of full scale from which on a mask beside Meshroom's `ps_` folder is white, as Meshroom reads it."""

_STILL = 1e-6
"""Standard deviation of the brightness under which a pixel does not change."""


class Variation:
    """Mean and variance of every pixel's brightness (H, W), gathered image by image (Welford's recurrence)."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.mean, self.squares, self.count = np.zeros(shape, np.float32), np.zeros(shape, np.float32), 0

    def add(self, grey: np.ndarray) -> None:
        """Take in an image, (H, W) float32, finite."""
        self.count += 1
        before = grey - self.mean
        self.mean += before / np.float32(self.count)
        self.squares += before * (grey - self.mean)

    def changes(self) -> np.ndarray:
        """Return where brightness changes by more than rounding does, (H, W) bool."""
        return self.deviation() >= _STILL

    def deviation(self) -> np.ndarray:
        """Return the standard deviation over the images so far, (H, W) float32."""
        return np.sqrt(np.maximum(self.squares, 0) / max(self.count, 1))

    def without(self, covered: np.ndarray) -> "Variation":
        """Return it with pixels (H, W) bool that are dark and do not change."""
        other = Variation((covered.shape[0], covered.shape[1]))
        other.mean, other.squares = np.where(covered, 0.0, self.mean), np.where(covered, 0.0, self.squares)
        other.count = self.count
        return other


class CutOut:
    """Where photographs with transparency are opaque, gathered picture by picture."""

    def __init__(self) -> None:
        self.whole = 0
        self.inside: np.ndarray | None = None
        self.outside: np.ndarray | None = None

    def add(self, alpha: np.ndarray | None) -> None:
        """Take in a picture's opacity, (H, W) as its pixels are turned; None of a picture without."""
        if alpha is None or alpha.min() == alpha.max():
            self.whole += 1
            return
        opaque = alpha > full_scale(alpha) / 2
        self.inside = opaque if self.inside is None else self.inside & opaque
        self.outside = ~opaque if self.outside is None else self.outside & ~opaque

    def find(self, shape: tuple[int, int]) -> np.ndarray | None:
        """Return what is opaque in all pictures, reduced to a shape (h, w) bool; None where some picture has no
        transparency, or they differ in more than a tenth of the object.
        """
        if self.whole or self.inside is None or self.outside is None:
            return None
        mask = reduce_mask(self.inside, shape)
        return mask if mask.any() and self.inside.sum() >= _ALIKE * (~self.outside).sum() else None


def automatic_mask(variation: Variation) -> tuple[np.ndarray, str]:
    """Separate what the lamp changes from what it does not.

    Otsu's threshold on the square root of the standard deviation over the images, of which the largest connected part
    is kept and its holes filled.

    Returns:
        The mask (H, W) bool, the whole frame where object and background cannot be told apart, and one sentence that
        says which.
    """
    changes = np.sqrt(variation.deviation())
    if not variation.changes().any():
        return np.ones(changes.shape, bool), (
            "nothing changes between the pictures, so the whole frame is taken for the object"
        )
    threshold = threshold_otsu(changes)
    parts, count = ndimage.label(changes > threshold)  # 4-connected
    largest = 1 + int(np.argmax(np.bincount(parts.ravel())[1:])) if count else 1
    mask = ndimage.binary_fill_holes(parts == largest)
    doubt = _doubt(changes, mask, float(threshold)) or _ground_is_lit(variation, mask, changes > threshold)
    if doubt:
        return np.ones_like(mask), (
            f"the object cannot be told apart from the background ({doubt}), so the whole frame is taken for the "
            "object; draw a mask.png (white object on black), or photograph against black cloth"
        )
    return (
        mask,
        f"automatic mask, {mask.mean():.0%} of the frame: the largest part that changes with the light; look at it",
    )


def read_mask(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """Read a mask (H, W) bool: more than half bright, or more than half opaque where the picture has transparency;
    `<name>.png` beside a folder `ps_<name>`: more than 0.7.

    Raises:
        InputError: unreadable, of another size, or empty.
    """
    mask = bright_part(decode(path), _MESHROOM if (path.parent / f"ps_{path.stem}").is_dir() else 0.5)
    if mask.shape != shape:
        raise InputError(
            f"{path}: the mask is {mask.shape[1]}x{mask.shape[0]} pixels, the pictures are {shape[1]}x{shape[0]}; draw "
            "it on one of the pictures"
        )
    if not mask.any():
        raise InputError(f"{path}: the mask is empty; paint the object white (above half brightness) on black")
    return np.ascontiguousarray(mask)


def bright_part(picture: Picture, level: float = 0.5) -> np.ndarray:
    """Return what a mask marks, (H, W) bool: what is opaque, otherwise bright, otherwise the upper of two values.

    Args:
        picture: The mask.
        level: What is bright, as a share of full scale.
    """
    pixels = picture.pixels.max(-1)
    if picture.alpha is not None and picture.alpha.min() < picture.alpha.max():
        pixels = picture.alpha
    limit = full_scale(pixels) * level
    low, high = pixels.min(), pixels.max()
    if low < high <= limit and ((pixels == low) | (pixels == high)).all():
        limit = low  # such as labels 0 and 1
    return orient_pixels(pixels, picture.orientation) > limit


def border_share(mask: np.ndarray) -> float:
    """Return which share of the frame's outermost pixels belongs to the mask (H, W)."""
    return float(np.concatenate([mask[0], mask[-1], mask[1:-1, 0], mask[1:-1, -1]]).mean())


def _doubt(changes: np.ndarray, mask: np.ndarray, threshold: float) -> str:
    """Say why a mask is not to be believed; empty where it is."""
    above = changes > threshold
    share = above.mean()
    between = share * (1 - share) * (changes[above].mean() - changes[~above].mean()) ** 2
    if between < _SEPARATION * changes.var():
        return "all parts of the frame change alike"
    if mask.mean() > _LARGEST:
        return f"{mask.mean():.0%} of the frame change with the light"
    if border_share(mask) > _BORDER:
        return f"what changes with the light covers {border_share(mask):.0%} of the frame's border"
    if mask.mean() < _SMALLEST:
        return "only specks change with the light"
    return ""


def _ground_is_lit(variation: Variation, mask: np.ndarray, above: np.ndarray) -> str:
    """Say why what lies outside a mask is not a background; empty where it is.

    A dark background hardly changes with the light. A bright steady one does not change either.

    Args:
        variation: Of the images.
        mask: (H, W) bool.
        above: (H, W) bool, what changes more than the threshold.
    """
    outside = ~ndimage.binary_dilation(mask, iterations=3)
    if not outside.any():
        return ""
    deviation, mean = variation.deviation(), variation.mean
    follows, bright = (
        float(np.median(field[outside]) / max(float(np.median(field[mask])), 1e-9)) for field in (deviation, mean)
    )
    scattered = float((above & ~mask).sum() / max(float(above.sum()), 1.0))
    if scattered > _SCATTERED and follows > _FOLLOWS:
        return f"what changes most lies all over the frame, and the rest changes too, {follows:.0%} as much"
    if bright > _AS_BRIGHT and follows > _AS_MUCH:
        return "the ground is as bright as what would be the object, and changes with the light as well"
    return ""
