"""What the page "Photographs" asks, as the flags of `sdps infer`, whose functions the worker calls with them."""

import argparse
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from render.shared.errors import InputError, unknown

if TYPE_CHECKING:
    from sdps.photos import Pose

PHOTOS, PAINTED, BALL = "photos", "painted.png", "ball-{}"
"""In a set: the photographs, a mask painted on the page, and pictures of a ball alone, the first to the ninth time."""
_CHOICES = {
    "gamma": ("auto", "linear", "srgb", "2.2"),
    "scale": ("1", "0.5", "0.25", "auto"),
    "lit_by": ("auto", "lamp", "any"),
    "flat": ("auto", "yes", "turned", "no"),
    "flatten": ("0", "0.1", "0.25", "0.5"),
    "intensities": ("", "equal", "folder"),
}
_TEXTS = {"method": "auto", "frame": "y-up", "light_distance": "auto", "focal": "", "principal": "", "ambient": "",
          "dark": "", "pose": ""}  # fmt: skip
_NUMBERS = {"pixel_size": float, "every": int, "ball_alone": int, "ball_radius": float}
_TICKED = ("lights", "refine", "anyway", "discontinuities")
_LONGEST, _MOST = 80, 10**9
_MOST_BALLS, _BALL = 8, re.compile(r"(?:chrome:|white:)?(?:auto|-?[0-9.]{1,20}(?:,-?[0-9.]{1,20}){2})")
_SAID = {
    r"run `sdps infer --refine` again": 'find the surface again with "Refine"',
    r"run `sdps infer` again": "find the surface again",
    r" \(in Python load\([^)]*\)\)": "",
    r" \(--focal\)": ", as given",
    r"orthographic, looking along -z": "taken for far away: no focal length is known",
    r"; --images takes what it names": "",
    r"--images '!([^']*)'": r"load them again without \1",
    r"(name (?:one|the right one)) with --mask(?: FILE)?": "load one",
    r"--principal COLUMN,ROW": '"Principal point"',
    r"--flat turned": 'the answer "yes, but what stands out came out hollow"',
    r"--flat no\b": '"Is it flat?": no',
    r"use --flat\b": 'use "Is it flat?": yes',
    r"--lit-by lamp": '"How was it lit?": by one lamp at a time',
    r"--intensities equal": '"How strong the lamps were": all equally strong',
}  # fmt: skip
_LABELS = {
    "method": "Method", "refine": "Refine", "gamma": "Tone curve", "scale": "Size of the pictures",
    "lit-by": "How was it lit?", "flat": "Is it flat?", "flatten": "Flatten", "focal": "Focal length",
    "principal": "Principal point",
    "pixel-size": "Size of a pixel", "light-distance": "How far away the lamps stood", "lights": "Use the lights file",
    "frame": "Axes of the lights file", "intensities": "How strong the lamps were", "ball": "Balls", "mask": "Mask",
    "ball-radius": "Radius of the balls",
    "ambient": "Picture with the lamp off", "dark": "Picture with the lens covered", "every": "Every so many frames",
    "anyway": "Continue even if a check fails",
}  # fmt: skip
"""How the page calls what a flag of the command says."""
_FLAG = re.compile(rf"(?<![\w-])--({'|'.join(_LABELS)})(?![\w-])")


def read_answers(asked: dict[str, Any]) -> dict[str, Any]:
    """Return what a request answers to the page's questions, and defaults of others.

    Raises:
        InputError: an answer that there is not.
    """
    found: dict[str, Any] = {name: str(asked.get(name) or default)[:_LONGEST] for name, default in _TEXTS.items()}
    for name, known in _CHOICES.items():
        found[name] = str(asked.get(name, known[0]))
        if found[name] not in known:
            raise InputError(f"{name}: must be one of {', '.join(filter(None, known))}")
    for name, kind in _NUMBERS.items():
        given = asked.get(name)
        try:
            found[name] = None if given in (None, "") else kind(given)
        except (TypeError, ValueError, OverflowError):
            found[name] = _MOST
        if found[name] is not None and not abs(found[name]) < _MOST:
            raise InputError(f"{_LABELS.get(name.replace('_', '-'), name)}: must be a number under a thousand million")
    return found | {name: asked.get(name) is True for name in _TICKED} | {"balls": _read_balls(asked.get("balls"))}


def _read_balls(said: Any) -> list[str]:
    """Return balls in the pictures; a folder, which `sdps.load` takes as well, is none."""
    balls = [] if said is None else said
    if not isinstance(balls, list) or len(balls) > _MOST_BALLS or not all(_BALL.fullmatch(str(one)) for one in balls):
        raise InputError(f"balls: must be at most {_MOST_BALLS} circles x,y,radius, or auto")
    return [str(one) for one in balls]


def find_poses(place: Path, answers: dict[str, Any]) -> tuple["tuple[Pose, ...]", "Pose"]:
    """Return the poses of a set, and the one that is asked for, by default the first.

    Raises:
        InputError: as `sdps.photos.find_poses`; an unknown pose.
    """
    from sdps import photos

    poses = photos.find_poses(place / PHOTOS, answers["every"], inside=place)
    names, wanted = [pose.name for pose in poses], answers["pose"]
    if wanted and wanted not in names:
        raise unknown("pose", wanted, names)
    return poses, poses[names.index(wanted) if wanted in names else 0]


def make_arguments(place: Path, pose: "Pose", answers: dict[str, Any]) -> argparse.Namespace:
    """Return the arguments of `sdps infer` that say the same as the answers.

    Args:
        place: The set's folder.
        pose: Of `find_poses`.
        answers: Of `read_answers`.
    """
    from pipelines.infer import add_arguments

    parser = argparse.ArgumentParser()
    add_arguments(parser)
    args, focal, painted = parser.parse_args([]), answers["focal"], place / PAINTED
    plain = ("method", "lit_by", "gamma", "frame", "flat", "light_distance", "pixel_size", "anyway", "discontinuities")
    for name in plain:
        setattr(args, name, answers[name])
    args.mask = painted if painted.is_file() else None
    args.lights = "folder" if answers["lights"] else None
    args.intensities, args.principal = answers["intensities"] or None, answers["principal"] or None
    args.focal = (f"{focal}mm" if focal[-1:].isdigit() else focal) or None  # the page asks for millimetres
    args.scale = answers["scale"] if answers["scale"] == "auto" else float(answers["scale"])
    args.refine, args.flatten = None if answers["refine"] else False, float(answers["flatten"])
    alone = [str(place / BALL.format(answers["ball_alone"]))] if answers["ball_alone"] else []
    args.ball = [*answers["balls"], *alone] or None
    args.ball_radius = answers["ball_radius"] if args.ball else None  # the answer stays when the balls are gone
    for name in ("ambient", "dark"):
        said = answers[name]
        setattr(args, name, (said or None) if said in ("", "none") else pose.folder / Path(said).name)
    return args


@contextmanager
def speak_plainly(place: Path) -> Iterator[None]:
    """Let error messages name what the page has, not temporary folders and flags."""
    try:
        yield
    except InputError as error:
        text = str(error).replace(f"{place / PHOTOS}/", "").replace(str(place / PHOTOS), "photographs")
        raise InputError(say_plainly(text.replace(f"{place}/", "").replace(f"{place}: ", ""))) from error


def say_plainly(text: str) -> str:
    """Return a text of the command in the words of the page: flags by the names of its questions."""
    for pattern, words in _SAID.items():
        text = re.sub(pattern, words, text)
    return _FLAG.sub(lambda found: f'"{_LABELS[found[1]]}"', text)
