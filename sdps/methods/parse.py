"""Methods from words: expressions such as `lcnet+psfcn`, and flags."""

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from render.shared.errors import InputError
from sdps.classical import registry as classical
from sdps.methods import pretrained
from sdps.methods.method import AFTER, CLASSICAL, CONSTANT, FUSE, NONE, REFINE, Method, join, label, stem
from sdps.models.registry import COMBINATIONS, MODELS, TRUE_LIGHTS

_LEARNED = ("sdps-frames", "sdps-plus", "sdps", "lcnet-soft+psfcn", "lcnet+psfcn")
_CALIBRATED = ("frames", "psfcn", "robust-least-squares")
"""Tried in this order; the parts may be trained or shipped one by one."""
_FALLBACK = "pf14"

_log = logging.getLogger(__name__)


def combine(lighting: str | None, normals: str | None, intensities: str | None, find: Callable[[str], Path]) -> Method:
    """Return the method that a user's choice describes.

    Args:
        lighting: A run or weights file, or `true`.
        normals: A run, a weights file, a combination such as `sdps`, or a classical method.
        intensities: `true` where only these are given.
        find: Gives the weights file of a name, or raises InputError.

    Raises:
        InputError: a name without weights, or choices that do not go together.
    """
    prefix = pretrained.SHIPPED if normals and normals.startswith(pretrained.SHIPPED) else ""
    name = normals.removeprefix(prefix) if normals else NONE
    combination = name if name in COMBINATIONS else NONE
    if combination:
        pair = COMBINATIONS[combination]
        lighting = lighting or prefix + pair.lighting
        normals = prefix + pair.normals
    if normals is None:
        raise InputError("--lighting and --intensities need --normals as well; see `sdps list models`")
    lighting = lighting or _default_lighting(normals, find)
    if normals in CLASSICAL:
        _check_classical(normals, lighting, intensities)
    method = join(lighting, normals, intensities=intensities or NONE, combination=combination)
    for needed in sorted(method.models()):
        find(needed)
    return method


def parse(text: str, find: Callable[[str], Path]) -> Method:
    """Return the method of an expression.

    Args:
        text: A combination (`sdps`), a normal model (`nenet`), a classical method (`pf14`), a lighting model alone
            (`lcnet`), or lights and normals (`lcnet+psfcn`, `true+least-squares`). Calibrated methods alone are given
            the true lights, networks alone what they were trained on; `shipped:` before a name means the pretrained
            weights. `+refine` at the end refines what was found, with lamps, or, where a method finds no lights, under
            light from all around; `+fuse` joins that with the network's own answer.
        find: Gives the weights file of a name, or raises InputError.

    Raises:
        InputError: an unknown name, weights that are not there, or parts that do not go together.
    """
    parts = [part.strip() for part in text.split("+")]
    last = parts[-1]
    if last in AFTER:
        if len(parts) == 1:
            raise InputError(f"method {text}: say what is refined, as in sdps-frames+{last}")
        return finish(parse("+".join(parts[:-1]), find), last, find)
    if not all(parts) or len(parts) > 2:
        raise InputError(f"method {text!r}: want METHOD or LIGHTS+NORMALS, either with +{REFINE} or +{FUSE}")
    if len(parts) == 2:
        return combine(parts[0], parts[1], None, find)
    (name,) = parts
    if name == CONSTANT:
        return Method(name="constant predictor", normals=CONSTANT)
    if name in classical.METHODS:
        return combine(TRUE_LIGHTS if classical.METHODS[name].calibrated else None, name, None, find)
    if name.removeprefix(pretrained.SHIPPED) in COMBINATIONS:
        return combine(None, name, None, find)
    if name == TRUE_LIGHTS:
        raise InputError(f"method {name}: say which normals, as in true+psfcn")
    if MODELS[model_of(name, find)].role == "lighting":
        find(name)
        return Method(name=label(stem(name), NONE), lighting=name)
    return combine(None, name, None, find)


def finish(method: Method, last: str, find: Callable[[str], Path]) -> Method:
    """Return a method that goes on with what the last part of an expression says, one of `AFTER`.

    Raises:
        InputError: it gives no normals to refine, or, to be joined, not those of a network that tells its errors.
    """
    if method.normals in (NONE, CONSTANT):
        raise InputError(f"method {method.name}+{last}: refinement needs a method that gives normals")
    if last == REFINE:
        return replace(method, name=f"{method.name}, refined", refined=True, paper="")
    if not can_fuse(method, find):
        raise InputError(
            f"method {method.name}+{last}: want a network that is given lamps and tells its errors, as "
            f"sdps-frames+{last}"
        )
    return replace(method, name=f"{method.name}, fused", refined=True, fused=True, paper="")


def adapt(text: str, known: tuple[bool, bool], find: Callable[[str], Path]) -> Method:
    """Return the method of an expression that uses what is known of the lights.

    Args:
        text, find: As of `parse`.
        known: Light directions are given; intensities are.

    Raises:
        InputError: as `parse`, or the method needs lights that are not given.
    """
    directions, intensities = known
    if not directions:
        method = parse(text, find)
        if TRUE_LIGHTS in (method.lighting, method.intensities):
            raise InputError(
                f"--method {text} needs the lights; give them with --lights, or put a lighting model before it, "
                f"as in lcnet+{text}"
            )
        if intensities and not uses_networks(method):
            _log.warning("%s finds the intensities itself; those given are not used", text)
        return replace(method, intensities=TRUE_LIGHTS) if intensities and uses_networks(method) else method
    if "+" not in text and text in classical.METHODS and not classical.METHODS[text].calibrated:
        _log.warning("%s finds the lights itself; those given are not used", text)
        return parse(text, find)
    method = parse(text if "+" in text else f"{TRUE_LIGHTS}+{text}", find)
    if method.lighting != TRUE_LIGHTS:
        _log.warning("%s finds the lights itself; those given are not used", text)
    return replace(method, name=method.name.replace("true lights", "given lights"))


def find_best(lit: bool, find: Callable[[str], Path]) -> str:
    """Return the best method whose weights are there; `lit`: light directions are given."""
    for name in _CALIBRATED if lit else _LEARNED:
        try:
            adapt(name, (lit, False), find)
        except InputError:
            continue
        return name
    _log.warning("no trained network is there; using %s, which wants a diffuse object", _FALLBACK)
    return _FALLBACK


def can_fuse(method: Method, find: Callable[[str], Path]) -> bool:
    """Return whether a network that is given lamps finds the normals, and tells the errors to expect of them."""
    if method.normals in (NONE, *CLASSICAL):
        return False
    model = MODELS[model_of(method.normals, find)]
    told = getattr(model.build, "tells_errors", False) and getattr(model.build, "needs_lights", True)
    return told and not model.any_light


def uses_networks(method: Method) -> bool:
    """Return whether a network finds the normals, under lights that a network finds or that are given."""
    return method.lighting != NONE and method.normals not in (NONE, *CLASSICAL)


def model_of(name: str, find: Callable[[str], Path]) -> str:
    """Return the registry model of a run or weights file.

    Raises:
        InputError: no such weights.
    """
    from sdps.models.checkpoint import load_weights

    plain = name.removeprefix(pretrained.SHIPPED)
    return plain if plain in MODELS else load_weights(find(name)).name


def _default_lighting(normals: str, find: Callable[[str], Path]) -> str:
    """Return the lights a normal model was trained on; none for methods that are not given any."""
    if normals in CLASSICAL:
        return NONE
    lighting = MODELS[model_of(normals, find)].lights
    shipped = normals.startswith(pretrained.SHIPPED) and lighting not in (NONE, TRUE_LIGHTS)
    return pretrained.SHIPPED + lighting if shipped else lighting


def _check_classical(normals: str, lighting: str, intensities: str | None) -> None:
    """Refuse what a classical method would not look at, and a calibrated one without lights."""
    calibrated = normals in classical.METHODS and classical.METHODS[normals].calibrated
    if calibrated and not lighting:
        raise InputError(f"{normals} needs lights: `true` or a lighting model, as in true+{normals}")
    if not calibrated and (lighting or intensities):
        raise InputError(f"{normals} finds the lights itself; leave out the lighting model and the intensities")
