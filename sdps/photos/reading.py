"""A folder of photographs as images that are read on demand, with mask and, where given, lights.

Legend: L pictures of H x W pixels.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from render.shared.errors import InputError
from render.shared.imaging.reducing import check_scale, smaller_shape
from sdps.core.geometry import ORTHOGRAPHIC, Camera, Capture
from sdps.photos.analysis.balls.ball_depths import measure_pixel
from sdps.photos.analysis.balls.ball_flags import Said, WantedBall, measure_balls, read_balls
from sdps.photos.analysis.balls.ball_known import know_lights
from sdps.photos.analysis.balls.ball_scene import FoundBall, Scene, cover_balls, match_pictures, see_balls
from sdps.photos.faults import Faults
from sdps.photos.light_files.light_choice import KnownLights, known_lights
from sdps.photos.light_files.light_distance import LightDistance, Yardstick, find_nearness, read_distance
from sdps.photos.picture_file import decode, turn_pixels
from sdps.photos.pictures.ambient import Background
from sdps.photos.pictures.lens import NOT_KNOWN, Wanted, read_wanted
from sdps.photos.pictures.listing import Listing, list_pictures
from sdps.photos.pictures.picture_kinds import Coding
from sdps.photos.pictures.sources.poses import Pose, Room, only_pose
from sdps.photos.response import to_linear
from sdps.photos.scaling import reduce_linear
from sdps.photos.survey import Survey, survey


@dataclass(frozen=True, eq=False)
class Photographs:
    """A folder of photographs; an `ImageSource` (sdps/inference/image_source.py) that holds no pixel in memory.

    `len(photos)` is L; `photos[2:5]` reads three files again and returns (3, H, W, 3) float32, linear radiance with 1
    for full scale (floating-point files: as they are), 0 for what is negative or not finite.

    Attributes:
        folder: Where the files are.
        files: (L,) names below the folder: natural order, or that of names.txt, filenames.txt or `names`.
        shape: (H, W), once turned and reduced.
        bits: Per channel: 8 or 16, 32 of floating-point files (16 of half ones).
        gamma: The curve that was taken off: linear, srgb, or an exponent.
        mask: (H, W) bool, not empty; every pixel in it is finite in all pictures, but with `anyway`.
        mask_origin: `file`, `automatic`, or `whole frame` where that was asked for.
        light_directions: (L, 3) float32, unit, x right, y up, z to the camera, from the surface to the light; or None.
        intensities: (L,) or (L, 3) float32, relative; or None.
        notes: What was decided, in plain sentences.
        coding: Kind and depth of the files.
        orientation: EXIF orientation tag that all pictures were turned by.
        overridden: Faults that would have stopped `load`, but for `anyway`.
        lights_name: Name of the file of the directions, or the ball's; empty without one.
        lights_frame: The frame flag it was read with; empty where the file states its own frame.
        scale: What the sides of the files' pictures are multiplied by as they are read.
        camera: The camera, in pixels of the pictures as read; orthographic where nothing is known.
        camera_origin: Where its focal length is from, in words.
        pixel_size: Millimetres per pixel, as read, at the object's mean depth; None where it is not known.
        light_nearness: (L,) float32, the object's radius over the distance of each lamp (`sdps.core.geometry`), 0 of
            distant ones; None where it is not known.
        background: What is subtracted of every picture: the room's light and the sensor's offset; None for nothing.
        nearness_each: Where it is not known, each lamp may have a distance of its own.
        room: Keeps the temporary files that an archive or a film was taken apart to; None of a folder.
        balls: Those that gave the lights.
    """

    folder: Path
    files: tuple[str, ...]
    shape: tuple[int, int]
    bits: int
    gamma: str | float
    mask: np.ndarray
    mask_origin: str
    light_directions: np.ndarray | None
    intensities: np.ndarray | None
    notes: tuple[str, ...]
    coding: Coding
    orientation: int
    overridden: tuple[str, ...] = ()
    lights_name: str = ""
    lights_frame: str = ""
    scale: float = 1.0
    camera: Camera = ORTHOGRAPHIC
    camera_origin: str = NOT_KNOWN
    pixel_size: float | None = None
    light_nearness: np.ndarray | None = None
    nearness_each: bool = False
    background: Background | None = None
    room: Room | None = None
    balls: tuple[FoundBall, ...] = ()

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, part: slice, /) -> np.ndarray:
        """Read the pictures of `part`, (n, H, W, 3) float32.

        Raises:
            InputError: a file that changed or was removed since the folder was loaded.
        """
        return self.window(part, slice(None), slice(None))

    def window(self, part: slice, rows: slice, columns: slice) -> np.ndarray:
        """Read rows and columns of the pictures of `part`, (n, h, w, 3) float32, in less memory than all of them take.

        Raises:
            InputError: as indexing.
        """
        numbers = range(len(self))[part]
        sides = (len(range(length)[some]) for length, some in zip(self.shape, (rows, columns), strict=True))
        images = np.empty((len(numbers), *sides, 3), np.float32)
        saturation = self.saturation
        for image, number in zip(images, numbers, strict=True):
            picture = decode(self.folder / self.files[number])
            pixels = turn_pixels(picture, self.orientation, self.shape, self.scale)
            if smaller_shape(pixels.shape[:2], self.scale) != self.shape or picture.coding != self.coding:
                raise InputError(f"{self.folder / self.files[number]}: changed while it was in use; start again")
            if self.scale == 1.0:
                to_linear(pixels[rows, columns], self.gamma, image)
            else:
                image[:] = reduce_linear(pixels, self.gamma, self.shape)[rows, columns]
            if self.background is not None:
                self.background.subtract(image, self.files[number], (rows, columns), saturation)
        return images

    @property
    def camera_summary(self) -> str:
        """Kind of camera, its focal length and where that is from, in words."""
        if not self.camera.is_perspective:
            return "orthographic, looking along -z"
        point = self.camera.principal
        middle = "" if point is None else f", principal point {point[0]:.6g}, {point[1]:.6g}"
        return f"perspective, focal length {self.camera.focal:.0f} px ({self.camera_origin}){middle}"

    @property
    def saturation(self) -> float:
        """Linear value from which on a pixel of integer files counts as saturated; infinite for floating point.

        Saturated values are those of the files, whatever is subtracted from others.
        """
        return float("inf") if self.coding.floating else float(to_linear(np.array([253], np.uint8), self.gamma)[0])


def load(
    folder: str | Path | Pose, *, mask: str | Path | None = None, lights: str | Path | None = None,
    intensities: str | Path | None = None, frame: str = "y-up", gamma: str | float = "auto",
    names: Sequence[str] | None = None, anyway: bool = False, scale: float = 1.0, focal: str | float | None = None,
    principal: str | Sequence[float] | None = None, pixel_size: float | None = None,
    light_distance: str | float | None = None, balls: Said | Iterable[Said] | None = None,
    ball_radius: str | float | Sequence[float] | None = None, every: int | None = None,
    ambient: str | Path | None = None, dark: str | Path | None = None, whole_frame: bool = False,
) -> Photographs:  # fmt: skip
    """Look through a folder of photographs of a static object under one distant light each (docs/guides/capture.md).

    Args:
        folder: Pictures of one kind and size, and what may lie with them; a ZIP of it, a film, a pose of `find_poses`.
        mask: A picture, bright where the object is; None for the folder's mask or, without one, an automatic mask.
        lights: A lights file, or `folder` for that of the folder; None for unknown lights.
        intensities: A file, `folder` for its light_intensities.txt, or `equal`; None for those of `lights`, else found.
        frame: Axes of the lights file: y-up, y-down, x-left, z-away, xy-swapped, several joined by commas.
        gamma: linear, srgb, the exponent of a power curve, or auto by kind of file and colour profile.
        names: Files or glob patterns to use, in this order; one that begins with `!` leaves files out.
        anyway: Go on where a check stops although one could; `check` then lists these as errors.
        scale: Reduces pictures and mask by area averaging of linear values as they are read; above 0, at most 1.
        focal: Focal length: `28mm` (35 mm equivalent), `3772px` or a number of pixels, `orthographic`; None or `auto`:
            as the files' EXIF data say, orthographic where they do not. Pixels here and below are the files', turned.
        principal: Column and row of the principal point, "2016,1512" or two numbers; None: the middle.
        pixel_size: Millimetres per pixel at the object's mean depth, for depth and meshes in millimetres.
        light_distance: How far all lamps stand from the object: a number of its sizes (the longer side of its outline's
            box), `400mm`, `40cm`, `0.4m` (with `pixel_size`), or `far`. None or `auto`: as the positions in the lights
            file say, else not known; `each`: not known, and not the same for all lamps.
        balls: Balls that show the lights, in place of `lights` (`sdps.photos.analysis.balls.ball_flags.read_balls`).
        ball_radius: Their real radii, mm, one for all or for each: tells `pixel_size` and, with `focal`, their depths.
        ambient: A picture without the lamp, subtracted at the photographs' exposure; None: those named so; `none`.
        dark: A picture with the lens covered, subtracted as well; None and `none` as for `ambient`.
        every: Of a film, take every n-th frame; None: so that about 60 are taken.
        whole_frame: Without a mask file, all pixels are the object's, as of flat things.

    Raises:
        InputError: a folder that cannot be used: the file, what is wrong with it, and the remedy.
    """
    wanted, distance = read_wanted(focal, principal, pixel_size), read_distance(light_distance)
    pose, scale = only_pose(folder, every), check_scale(scale)
    shown_by = measure_balls(read_balls(balls, lights), ball_radius)
    with pose.naming():
        faults = Faults(anyway)
        listing, seen = _look(pose, names, mask, gamma, faults, scale, (ambient, dark))
        seen = _choose_mask(seen, whole_frame)
        known = _find_lights(pose, listing, seen, lights, intensities, frame, faults)
        photos = _assemble(pose, listing, seen, known, wanted, faults, scale)
        again = partial(load, gamma=gamma, anyway=True, scale=scale, focal=focal, principal=principal)
        photos, known = _ask_balls(photos, seen, known, shown_by, distance, again) if shown_by else (photos, known)
        return _place_lamps(photos, seen, known, distance)


def _look(
    pose: Pose, names: Sequence[str] | None, mask: str | Path | None, gamma: str | float, faults: Faults, scale: float,
    without_lamp: tuple[str | Path | None, str | Path | None],
) -> tuple[Listing, Survey]:  # fmt: skip
    """List the pictures, and look at all of them."""
    listing = list_pictures(pose.folder, pose.names if names is None else names)
    mask_file = pose.mask if mask is None else Path(mask)
    return listing, survey(pose.folder, listing, gamma, mask_file, faults, scale, without_lamp)


def _choose_mask(seen: Survey, whole_frame: bool) -> Survey:
    """Return what was seen, with the whole frame for an automatic mask where that is asked for."""
    if not whole_frame or seen.origin != "automatic":
        return seen
    notes = (*seen.notes[:-1], "the whole frame is the object")  # the last one is about the mask
    return replace(seen, mask=np.ones_like(seen.mask), origin="whole frame", notes=notes, variation=None)


def _find_lights(
    pose: Pose, listing: Listing, seen: Survey, lights: str | Path | None, intensities: str | Path | None, frame: str,
    faults: Faults,
) -> KnownLights:  # fmt: skip
    """Read the lights; their errors say what was left out of the pictures."""
    files = tuple(f"{pose.prefix}{name}" for name in seen.files)
    try:
        return known_lights((*listing.places, *pose.above), files, lights, intensities, frame, faults)
    except InputError as error:
        raise InputError(f"{error} ({seen.left_out})" if seen.left_out else error) from error


def _assemble(
    pose: Pose, listing: Listing, seen: Survey, known: KnownLights, wanted: Wanted, faults: Faults, scale: float
) -> Photographs:
    """Put together what was found, with the camera."""
    by = wanted.find(seen.lenses, seen.full, seen.mask.shape)
    return Photographs(
        folder=pose.folder, files=seen.files, shape=seen.mask.shape, bits=seen.coding.bits, gamma=seen.gamma,
        mask=seen.mask, mask_origin=seen.origin, light_directions=known.directions, intensities=known.intensities,
        lights_name=known.name, lights_frame=known.frame,
        notes=(*pose.notes, *listing.notes, *seen.notes, *by.notes, *known.notes), coding=seen.coding,
        orientation=seen.orientation, overridden=tuple(faults.overridden), scale=scale, camera=by.camera,
        camera_origin=by.origin, pixel_size=by.pixel_size or known.image_width / seen.mask.shape[1] or None,
        background=seen.background, room=pose.room,
    )  # fmt: skip


def _ask_balls(
    photos: Photographs, seen: Survey, known: KnownLights, wanted: Sequence[WantedBall], distance: LightDistance,
    load_again: Callable[[Path], Photographs],
) -> tuple[Photographs, KnownLights]:  # fmt: skip
    """Take the lights from balls, and the balls out of the object."""
    rays, balls, spheres = [], [], []
    for place in sorted({ball.folder for ball in wanted}, key=str):
        there = photos if place is None else load_again(place)
        scene = Scene(there, there.camera, there.mask, there.saturation, there.scale)
        order = None if place is None else match_pictures(photos.files, there.files, place)
        for one, found in see_balls(scene, [ball for ball in wanted if ball.folder == place], place is not None):
            one = one if order is None else one.take(order)
            rays.append(one)
            balls.append(scene.describe(one, found, place))
            spheres += [one.view.sphere] if place is None else []
    if spheres:
        try:
            left = seen.without(cover_balls(spheres, photos.shape))
        except InputError as error:
            raise InputError(f"{photos.folder}: {error}") from error
        notes = (*left.notes, *(note for note in photos.notes if note not in seen.notes))
        photos = replace(photos, mask=left.mask, notes=notes)
    names = " and ".join(ball.text for ball in balls)
    capture = Capture.of(photos.mask, photos.camera)
    pixel_size, notes = measure_pixel(rays, capture, photos.pixel_size)
    photos = replace(photos, pixel_size=pixel_size, notes=(*photos.notes, *notes))
    lit = know_lights(rays, names, photos.files, capture, known, distance, _measure(photos, seen))
    files = tuple(np.asarray(photos.files, object)[lit.kept])
    balls = [ball.take(lit.kept) for ball in balls]
    notes = (*(note for note in photos.notes if note not in known.notes), *lit.known.notes, *lit.notes)
    known, name = lit.known, "the balls" if len(balls) > 1 else f"the {balls[0].kind} ball"
    photos = replace(
        photos, files=files, balls=tuple(balls), notes=notes, lights_name=name, lights_frame="",
        light_directions=known.directions, intensities=known.intensities,
    )  # fmt: skip
    return photos, known


def _measure(photos: Photographs, seen: Survey) -> Yardstick:
    return Yardstick(Capture.of(photos.mask).radius, photos.pixel_size, max(photos.shape) / max(seen.full))


def _place_lamps(photos: Photographs, seen: Survey, known: KnownLights, distance: LightDistance) -> Photographs:
    """Say how near the lamps stand, where that is known."""
    by = _measure(photos, seen)
    nearness = find_nearness(distance, photos.files, by, known.distances, known.unit, known.name)
    return replace(photos, light_nearness=nearness, nearness_each=distance.each)
