"""Photometric stereo from Python: photographs or arrays in, normals and lights out; and training.

```python
import sdps

photos = sdps.load("photographs")  # linear images on demand, mask, lights if they are known
result = sdps.infer(photos)  # or infer(photos, method="pf14"), method="lcnet+psfcn", ...
result.normals  # (H, W, 3) float32: x right, y up, z to the camera; zero outside the mask
result.light_directions, result.intensities
result.depth.z  # (H, W) float32, pixels towards the camera
result.save("out")  # the files of `sdps infer`, but for its report
```
"""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, get_args
from weakref import WeakKeyDictionary

import numpy as np
from tqdm import tqdm

from render.shared.errors import InputError, unknown
from sdps.classical import registry as classical
from sdps.core.estimate import Estimate
from sdps.core.geometry import ORTHOGRAPHIC, Camera, Rig
from sdps.inference.estimator import check_lights
from sdps.inference.image_source import ImageSource
from sdps.inference.inference_config import InferenceConfig
from sdps.methods import pretrained
from sdps.methods.flat_things import NOT_FLAT, Flatness, Wish
from sdps.methods.light_witness import ANY_LIGHT, is_lit_by_lamps, question_lights, see_lights
from sdps.methods.method import AFTER, FUSE, REFINE
from sdps.methods.parse import adapt, can_fuse, find_best, finish, parse, uses_networks
from sdps.methods.runner import Runner
from sdps.models.registry import COMBINATIONS, MODELS
from sdps.photos import Finding, Photographs, check, load
from sdps.photos.faults import ANYWAY
from sdps.photos.light_files.light_advice import advise
from sdps.refinement.problems import FEWEST
from sdps.refinement.trust import FEWEST_IMAGES
from sdps.surface.inferred import Inference, check_out
from sdps.surface.workload import Workload, workload
from sdps.training.trainer import TrainingResult

__all__ = ["Inference", "available_methods", "check_out", "estimate", "infer", "load", "plan", "train"]

AUTO = "auto"
LitBy = Literal["auto", "lamp", "any"]
"""What lit the photographs: found out from them, one lamp at a time in the dark, or any light."""
_LAMPS_SEEN: WeakKeyDictionary[Photographs, dict[tuple[str, InferenceConfig | None], bool]] = WeakKeyDictionary()
"""Of photographs that were looked at, by models and configuration, whether lamps lit them."""


def infer(
    photos: Photographs,
    method: str = AUTO,
    *,
    models: str | Path | None = None,
    config: InferenceConfig | None = None,
    refine: bool | None = None,
    discontinuities: bool = False,
    findings: tuple[Finding, ...] | None = None,
    anyway: bool = False,
    flat: Wish = "auto",
    flatten: float = 0.0,
    lit_by: LitBy = "auto",
) -> Inference:
    """Estimate normals and lights of photographs.

    Args:
        photos: Of `load`. Lights they carry are used, once a network has compared them; it finds missing intensities.
        method: A combination (`sdps`), lights and normals (`lcnet+psfcn`), a normal model or a classical method;
            `auto` for the best there is: a pretrained network, or a classical method where there is none.
        models: Folder of trained runs (`out` of `train`) to take weights from before the pretrained ones.
        config: How networks are used; the defaults are those of every command.
        refine: Refine (`sdps.refinement`), and join that with what the network says where it tells its errors
            (`sdps.methods.fusion`). None: where a network finds the normals and the images are enough.
        discontinuities: Let the depth jump where neighbouring slopes disagree.
        findings: Of `check`, if it ran before.
        anyway: Go on where the checks found an error. The method may still find that it cannot.
        flat, flatten: What is done with flat things: wish and share of `sdps.methods.flat_things.Flatness`.
        lit_by: What method `auto` is to assume where no lights are given.

    Returns:
        Normals, lights, and what follows: depth, albedo, relit pictures. Frame: x right, y up, z to the camera.

    Raises:
        InputError: photographs that cannot be used, or a method that is not there or cannot use them, in one line.
    """
    findings = tuple(check(photos)) if findings is None else findings
    stop(photos, findings, anyway)
    known, wished = (photos.light_directions is not None, photos.intensities is not None), Flatness(flat, flatten)
    method, seen = choose_method(method, photos, photos.mask, lit_by, known[0], models, config, wished)
    runner = make_runner(method, known, models, config, refine, len(photos), wished)
    forecast = workload(photos, runner, discontinuities=discontinuities)
    if not anyway:
        forecast.check()
    began = time.perf_counter()  # questioning comes after what costs nothing: it reads every photograph twice
    intensities, more = (photos.intensities, ()) if not known[0] else ask_about_lights(photos, models, config)
    stop(photos, findings := (*findings, *more), anyway)
    found, name = _estimate(runner, photos, intensities), runner.method.name
    took, findings = time.perf_counter() - began, (*findings, *seen, *_tell_flat(found, runner.flat, lit=known[0]))
    return Inference(photos, name, found, findings, runner.files, discontinuities, took, forecast)


def plan(
    photos: Photographs, method: str = AUTO, *, models: str | Path | None = None,
    config: InferenceConfig | None = None, refine: bool | None = None, discontinuities: bool = False,
    flat: Wish = "auto", flatten: float = 0.0, lit_by: LitBy = "auto",
) -> Workload:  # fmt: skip
    """Return about what `infer` will take, in seconds and memory; arguments as of `infer`."""
    known, wished = (photos.light_directions is not None, photos.intensities is not None), Flatness(flat, flatten)
    method, _ = choose_method(method, photos, photos.mask, lit_by, known[0], models, config, wished)
    runner = make_runner(method, known, models, config, refine, len(photos), wished)
    return workload(photos, runner, discontinuities=discontinuities)


def estimate(
    images: ImageSource,
    mask: np.ndarray,
    method: str = AUTO,
    *,
    light_directions: np.ndarray | None = None,
    intensities: np.ndarray | None = None,
    light_nearness: np.ndarray | None = None,
    camera: Camera = ORTHOGRAPHIC,
    models: str | Path | None = None,
    config: InferenceConfig | None = None,
    saturation: float = float("inf"),
) -> Estimate:
    """Estimate normals and lights of images in memory, by any method.

    Args:
        images: (L, H, W, 3), linear radiance of any overall scale, of a static object under one distant light each; an
            array, or anything that gives the images of a slice.
        mask: (H, W) bool, the object's pixels.
        method: As for `infer`.
        light_directions: (L, 3) known directions from the surface to the light (x right, y up, z to the camera).
        intensities: (L,) or (L, 3) known intensities, of any overall scale. Where only directions are known, a network
            finds them.
        light_nearness: (L,) the object's radius over the distance of each lamp (`sdps.core.geometry`), 0 of distant
            ones; None where it is not known.
        camera: What the images were taken with.
        models: As for `infer`.
        config: As for `infer`.
        saturation: Radiance from which on a channel is clipped; refinement leaves such observations out.

    Returns:
        Normals (H, W, 3) float32, unit, zero outside the mask; directions (L, 3) and intensities (L,), those given or
        those found, empty where there are none.

    Raises:
        InputError: sizes that do not fit, values that are not finite, an empty mask, or a method that is not there or
            wants lights that are not given.
    """
    method, _ = choose_method(method, images, mask, "auto", light_directions is not None, models, config)
    runner = make_runner(method, (light_directions is not None, intensities is not None), models, config)
    if light_directions is not None and intensities is None:
        check_lights(len(images), light_directions)
        seen = see_lights(images, mask, pretrained.finder(models), config)
        intensities, _ = question_lights(images, mask, light_directions, None, seen)
    return runner.estimate(
        images, mask, light_directions, intensities, saturation=saturation, rig=Rig(camera, light_nearness)
    )


def available_methods(models: str | Path | None = None) -> dict[str, str]:
    """Return the methods that can be used now, with a line about each: combinations, networks, classical methods.

    Two of them may be joined, lights before normals, as in `lcnet+psfcn`.

    Args:
        models: Folder of trained runs (`out` of `train`) whose weights count as well as the pretrained ones.
    """
    about = {name: item.summary for items in (COMBINATIONS, MODELS) for name, item in items.items()}
    about |= {name: f"{entry.summary} ({entry.paper})" for name, entry in classical.METHODS.items()}
    find = pretrained.finder(models)

    def usable(name: str) -> bool:
        try:
            parse(name, find)
        except InputError:
            return False
        return True

    return {name: text for name, text in about.items() if usable(name)}


def train(
    model: str,
    data: str | Path,
    out: str | Path,
    *,
    on_log: Callable[[int, dict[str, float]], None] | None = None,
    device: str | None = None,
    **settings: Any,
) -> TrainingResult:
    """Train a model on a rendered data folder, resuming what is there.

    Args:
        model: A name such as `lcnet` (lights) or `nenet` (normals), as `sdps list models` lists them.
        data: Data folder (`render.render_plan`), with scenes of the split `train` and, for validation, `val`.
        out: Folder of the runs; this one is `models/<model>` in it. What a model is trained on (NENet on LCNet's
            lights) is taken from there if it was trained there, else the pretrained weights are.
        on_log: Called with the step and its numbers (`loss`, `learning_rate`, ..., `val_...`) as they are logged.
        device: Torch device; CUDA when there is one, else CPU.
        settings: Fields of the model's configuration (`sdps.training.training_config`): `steps`, `batch_scenes`,
            `images`, `learning_rate`, `log_every`, ...; the others are the paper's.

    Returns:
        Weights by name (safetensors files; None if it was stopped by a signal), steps, seconds, validation metrics.

    Raises:
        InputError: an unknown model or setting, unusable data, a folder that holds another run, or a loss that is no
            longer finite.
    """
    from sdps.models.checkpoint import load_weights
    from sdps.training import recipes, trainer
    from sdps.training.stage_factory import create_stage

    out = Path(out)
    run = recipes.run(model, {}, {model: settings})
    needed = {use: load_weights(pretrained.require(name, out)) for use, name in run.requires.items()}
    stage = create_stage(run.name, run.model, run.config, needed)
    loggers = [] if on_log is None else [_ProgressLogger(on_log)]
    return trainer.train(stage, data, out / pretrained.MODELS_FOLDER / model, device=device, loggers=loggers)


class _ProgressLogger:
    """A logger that calls a function."""

    def __init__(self, tell: Callable[[int, dict[str, float]], None]) -> None:
        self.tell = tell

    def log(self, step: int, values: dict[str, float]) -> None:
        """Pass the values on, out of the way of the progress bar."""
        with tqdm.external_write_mode():
            self.tell(step, values)

    def close(self) -> None:
        """Nothing is open."""


def stop(photos: Photographs, findings: tuple[Finding, ...], anyway: bool) -> None:
    """Stop at the first grave finding, unless asked to go on.

    Raises:
        InputError: that finding.
    """
    grave = next((finding for finding in findings if finding.level == "error"), None)
    if grave is not None and not anyway:
        raise InputError(f"{photos.folder}: {grave.text} ({ANYWAY})")


def ask_about_lights(
    photos: Photographs, models: str | Path | None = None, config: InferenceConfig | None = None
) -> tuple[np.ndarray, tuple[Finding, ...]]:
    """Ask a network about lights that are given: return intensities, found where none are given, and what it says."""
    assert photos.light_directions is not None
    seen = see_lights(photos, photos.mask, pretrained.finder(models), config)
    intensities, fit = question_lights(
        photos, photos.mask, photos.light_directions, photos.intensities, seen, photos.files
    )
    if fit is None:
        return intensities, ()
    remedy = "look whether the circle is right, and whether the same lamps lit both" if photos.balls else ""
    level, text = advise(fit, photos.files, photos.lights_name, photos.lights_frame, remedy)
    return intensities, (Finding(level, text),)


def choose_method(
    method: str,
    images: ImageSource,
    mask: np.ndarray,
    lit_by: LitBy,
    lit: bool,
    models: str | Path | None = None,
    config: InferenceConfig | None = None,
    flat: Flatness = NOT_FLAT,
) -> tuple[str, tuple[Finding, ...]]:
    """Return the method that `auto` stands for where no lamp lights the images alone, else what was asked for.

    Args:
        method: As of `infer`.
        images, mask: As of `estimate`.
        lit_by: As of `infer`.
        lit: Light directions are given.
        models, config: As of `infer`.
        flat: What is wished of flat things, which show no shadows under a lamp: one that is said to be flat counts as
            lit by lamps.

    Returns:
        The method, and what is to be said of it.

    Raises:
        InputError: an unknown `lit_by`, or no weights for any light where that was asked for.
    """
    if lit_by not in get_args(LitBy):
        raise unknown("lit_by", lit_by, get_args(LitBy))
    if method.partition("+")[0] != AUTO or lit or lit_by == "lamp":
        return method, ()
    find, chosen = pretrained.finder(models), method.replace(AUTO, ANY_LIGHT, 1)
    if lit_by == "any":
        parse(ANY_LIGHT, find)
        return chosen, ()
    try:
        parse(ANY_LIGHT, find)
    except InputError:  # no weights
        return method, ()
    if flat.asked or _see_lamps(images, mask, models, config):
        return method, ()
    text = (
        "The light of each picture seems to come from many sides: not one lamp lit it, but a room or several lamps. So "
        "the normals are found by a network for any light, which finds no lights. For better ones darken the room and "
        "use one lamp; if you did, say so with --lit-by lamp, and if the object is flat, use --flat."
    )
    return chosen, (Finding("note", text),)


def _see_lamps(
    images: ImageSource, mask: np.ndarray, models: str | Path | None, config: InferenceConfig | None
) -> bool:
    """Return `is_lit_by_lamps`, of photographs once: `plan` asks, and so does `infer` after it."""
    told = _LAMPS_SEEN.setdefault(images, {}) if isinstance(images, Photographs) else {}
    key = str(models), config
    if key not in told:
        told[key] = is_lit_by_lamps(images, mask, pretrained.finder(models), config)
    return told[key]


def _estimate(runner: Runner, photos: Photographs, intensities: np.ndarray | None) -> Estimate:
    """Run a method on photographs."""
    rig = Rig(photos.camera, photos.light_nearness, photos.nearness_each)
    given = photos.light_directions, intensities
    return runner.estimate(photos, photos.mask, *given, saturation=photos.saturation, rig=rig)


def _tell_flat(found: Estimate, flat: Flatness, *, lit: bool) -> Iterator[Finding]:
    """Say what was done with a flat thing, where something was, and what tells its hollows; `lit`: by given lights."""
    if found.tilt is None:
        return
    why = "Said to be flat" if flat.asked else "This looks like a flat thing"
    slow = f" Slopes were flattened over {flat.share:.0%} of the width." if flat.share else ""
    if lit:
        side = ""
    elif flat.wish == "turned":
        side = (
            " What stood out was turned to be hollow, as asked. If what should stand out is hollow, use --flat; "
            "if it is not flat, --flat no."
        )
    elif found.side_by:
        side = f" Which parts stand out and which are hollow is told by {found.side_by}."
    else:
        side = (
            " Nothing tells which parts stand out and which are hollow (cast shadows or near lamps would): look at "
            "a place that you know, and use --flat turned if it is inside out."
        )
    level = f"{why}: its mean plane, {found.tilt:.0f} degrees off, was made to face the camera."
    last = "" if flat.wish == "turned" else " If it is not flat, use --flat no."
    yield Finding("note", f"{level}{slow}{side}{last}")


def make_runner(
    method: str, known: tuple[bool, bool], models: str | Path | None, config: InferenceConfig | None,
    refine: bool | None = False, images: int = 0, flat: Flatness = NOT_FLAT,
) -> Runner:  # fmt: skip
    """Return the method of an expression with its networks; `known`: light directions, intensities."""
    find = pretrained.finder(models)
    plain, _, after = method.rpartition("+")
    plain = plain if after in AFTER else method
    chosen = adapt(find_best(known[0], find) if plain == AUTO else plain, known, find)
    if plain != method:
        return Runner(finish(chosen, after, find), find, config, flat=flat)
    fuses = can_fuse(chosen, find)
    if refine is None:
        refine = uses_networks(chosen) and images >= (FEWEST if fuses else FEWEST_IMAGES)
    chosen = finish(chosen, FUSE if fuses else REFINE, find) if refine else chosen
    return Runner(chosen, find, config, flat=flat)
