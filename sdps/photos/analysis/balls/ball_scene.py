"""Balls in pictures: those that were named and those that are found, and the lights they give."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from render.shared.errors import InputError
from sdps.core.geometry import Camera
from sdps.photos.analysis.balls.ball_finding import find_balls
from sdps.photos.analysis.balls.ball_flags import AUTO, FLAG, WantedBall
from sdps.photos.analysis.balls.ball_lights import BallRays, trace_rays
from sdps.photos.analysis.balls.ball_outlines import settle
from sdps.photos.analysis.balls.ball_spheres import Circle, Sphere
from sdps.photos.analysis.balls.ball_views import Pictures, view_balls
from sdps.photos.light_files.light_names import numbers_of

_ENOUGH = 2 / 3  # share of the pictures in which a ball must show a light
_OBJECT = 0.8  # share of the mask from which on a ball that is found is the object itself, where there are others
_ROUND = 0.02  # radii by which a mask's outline may leave a circle, RMS
_REACH, _ROOM = 1.02, 2.0  # of what is taken out of the object's mask: radii, and pixels more


@dataclass(frozen=True, eq=False)
class FoundBall:
    """A ball that gave lights.

    Attributes:
        kind: `chrome` or `white`.
        circle: Its outline, in pixels of the files.
        found: It was found, not named.
        folder: Where it is photographed alone; None: in the pictures of the object.
        highlights: (L, 2) column and row of the highlight on a chrome ball, in pixels of the files, else NaN.
        seen: (h, w, 3) float32, linear radiance of its window, the highest of all pictures.
        window: Column and row of the middle of the window's first pixel, and its pixels' side, in pixels of the files.
        millimetres: Its real radius, where the user says it.
    """

    kind: str
    circle: Circle
    found: bool
    folder: Path | None
    highlights: np.ndarray
    seen: np.ndarray
    window: tuple[float, float, float]
    millimetres: float | None = None

    def take(self, kept: np.ndarray) -> "FoundBall":
        """Return it for the pictures of (L,) bool."""
        return replace(self, highlights=self.highlights[kept])

    def tell(self, files: Sequence[str]) -> dict[str, Any]:
        """Return it JSON ready; `files` are the names of the pictures, (L,)."""
        lit = [(name, place) for name, place in zip(files, self.highlights, strict=True) if np.isfinite(place).all()]
        return {
            "kind": self.kind,
            "circle": [round(value, 2) for value in self.circle],
            "circle_by": "found" if self.found else "given",
            "lights_by": "highlight" if lit else "shading",
            **({} if self.millimetres is None else {"radius_mm": self.millimetres}),
            **({} if self.folder is None else {"folder": str(self.folder)}),
            **({"highlights": {name: np.round(place, 2).tolist() for name, place in lit}} if lit else {}),
        }

    @property
    def text(self) -> str:
        """It in words."""
        where = "" if self.folder is None else f" in {self.folder}"
        x, y, radius = self.circle
        return f"the {self.kind} ball{where} at {x:.1f}, {y:.1f} with radius {radius:.1f}"


@dataclass(frozen=True, eq=False)
class Scene:
    """Pictures in which balls may be.

    Attributes:
        pictures: (L, H, W, 3) linear radiance that is read on demand.
        camera: What they were taken with, in their pixels.
        mask: (H, W) bool, of the object.
        saturation: Radiance from which on a channel is clipped.
        scale: Their pixels per pixel of the files.
    """

    pictures: Pictures
    camera: Camera
    mask: np.ndarray
    saturation: float
    scale: float = 1.0

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return self.mask.shape[0], self.mask.shape[1]

    def place(self, circle: Circle) -> Sphere:
        """Return the ball of a circle in pixels of the files."""
        x, y = ((side + 0.5) * self.scale - 0.5 for side in circle[:2])
        return Sphere.of(Circle(x, y, circle.radius * self.scale), self.camera, self.shape)

    def describe(self, rays: BallRays, found: bool, folder: Path | None = None) -> FoundBall:
        """Return a ball in pixels of the files."""
        view, scale = rays.view, self.scale
        first = view.columns[0, 0], view.rows[0, 0]
        x, y, left, top = ((float(side) + 0.5) / scale - 0.5 for side in (*view.sphere.circle[:2], *first))
        circle, step = Circle(x, y, view.sphere.circle.radius / scale), float(view.rows[1, 0] - view.rows[0, 0]) / scale
        highlights = (rays.highlights + 0.5) / scale - 0.5
        window = left, top, step
        return FoundBall(
            rays.kind, circle, found, folder, highlights, view.colours.max(0), window, rays.millimetres
        )  # fmt: skip


def see_balls(scene: Scene, wanted: Sequence[WantedBall], alone: bool = False) -> list[tuple[BallRays, bool]]:
    """Return what balls in pictures say of the lights, and which of them were found.

    Args:
        scene: The pictures.
        wanted: The balls.
        alone: Nothing but balls is in the pictures, and a mask is of one.

    Raises:
        InputError: a circle outside the pictures, or one that is not a ball; no ball where one was to be found.
    """
    named, found = [ball for ball in wanted if ball.circle is not None], []
    given = [(_place(scene, ball), ball) for ball in named]
    for ball in [ball for ball in wanted if ball.circle is None]:
        outlined = _fit_mask(scene.mask, scene.camera) if alone else None
        if outlined is not None:
            given.append((outlined, ball))
            continue
        seen = find_balls(scene.pictures, scene.camera, scene.shape, scene.saturation, ball.kind)
        seen = seen if alone else _leave_object(seen, scene.mask)
        if not seen:
            raise InputError(
                f"{FLAG} {AUTO}: no ball is found in the pictures; give its circle with {FLAG} x,y,radius (pixels of "
                "the files), or photograph it alone under the same lights"
            )
        found += [(replace(one, millimetres=ball.millimetres), True) for one in seen]
    views = view_balls(scene.pictures, [sphere for sphere, _ in given], scene.saturation) if given else []
    traced = [(trace_rays(settle(view), ball.kind), ball) for view, (_, ball) in zip(views, given, strict=True)]
    for rays, ball in traced:
        _check_share(scene, rays, ball)
    every = [(replace(rays, millimetres=ball.millimetres), ball.circle is None) for rays, ball in traced]
    return every + found


def cover_balls(spheres: Sequence[Sphere], shape: tuple[int, int]) -> np.ndarray:  # (H, W) bool
    """Return the pixels that show balls, and their blurred rims."""
    covered = np.zeros(shape, bool)
    for sphere in spheres:
        covered |= sphere.covers(_REACH + _ROOM / sphere.radius)
    return covered


def match_pictures(files: Sequence[str], of_ball: Sequence[str], folder: Path) -> list[int]:
    """Return which picture of a ball was taken under the light of each picture: by number, or in order.

    Raises:
        InputError: another number of pictures, whose names have no numbers that fit.
    """
    numbers, others = numbers_of(files), numbers_of(of_ball)
    if numbers is not None and others is not None and set(numbers) <= set(others):
        return [others.index(number) for number in numbers]
    if len(files) != len(of_ball):
        raise InputError(
            f"{folder}: {len(of_ball)} pictures of the ball for {len(files)} of the object; there must be one for "
            "each light, in the same order or with the same numbers in their names"
        )
    return list(range(len(files)))


def _place(scene: Scene, ball: WantedBall) -> Sphere:
    assert ball.circle is not None
    sphere, (height, width) = scene.place(ball.circle), scene.shape
    rows, columns = sphere.outline()
    outside = (rows < -1) | (rows > height) | (columns < -1) | (columns > width)
    if outside.any():
        x, y, radius = ball.circle
        size = f"{width / scene.scale:.0f}x{height / scene.scale:.0f}"
        raise InputError(
            f"{FLAG} {x:g},{y:g},{radius:g}: the circle leaves the picture, which is {size} pixels; give the ball's "
            "column, row and radius in pixels of the files"
        )
    return sphere


def _fit_mask(mask: np.ndarray, camera: Camera) -> Sphere | None:
    """Return the ball that a mask (H, W) marks; None if it is not round or the whole frame."""
    if mask.all() or not mask.any():
        return None
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    points = max(outlines, key=len)[:, 0].astype(np.float64)
    if len(points) < 20:
        return None
    shape = (mask.shape[0], mask.shape[1])
    sphere = Sphere.through(camera, shape, points[:, 1], points[:, 0])
    off = sphere.offsets(points[:, 1], points[:, 0]) - 1.0
    if float(np.sqrt(np.mean(off**2))) > max(_ROUND, 1.0 / sphere.radius):
        return None
    return Sphere(camera, shape, sphere.x, sphere.y, sphere.radius + 0.5)  # the points are middles of pixels inside


def _leave_object(rays: list[BallRays], mask: np.ndarray) -> list[BallRays]:
    """Leave out a ball that is the object, where there are others."""
    shares = [float(one.view.sphere.covers()[mask].mean()) for one in rays]
    others = [one for one, share in zip(rays, shares, strict=True) if share < _OBJECT]
    return others or rays


def _check_share(scene: Scene, rays: BallRays, ball: WantedBall) -> None:
    """Refuse a ball that shows no light in many pictures."""
    if rays.share >= _ENOUGH:
        return
    faults = [fault for fault in rays.faults if fault]
    usual = Counter(faults).most_common(1)[0][0]
    where = scene.describe(rays, ball.circle is None, ball.folder).text
    raise InputError(
        f"{FLAG}: {where} shows no light in {len(faults)} of {len(rays.faults)} pictures ({usual}); correct its "
        "circle, or say its kind with chrome:x,y,radius or white:x,y,radius"
    )
