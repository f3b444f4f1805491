"""Methods from words: expressions such as `lcnet+psfcn`, and flags."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from render.shared.errors import InputError
from sdps.classical import registry as classical
from sdps.methods import pretrained
from sdps.methods.method import CLASSICAL, CONSTANT, NONE, REFINE, Method, combined, label, stem
from sdps.models.registry import COMBINATIONS, MODELS, TRUE_LIGHTS


def combine(
    lights: str | None, normals: str | None, second: str | None, intensities: str | None, find: Callable[[str], Path]
) -> Method:
    """Return the method that a user's choice describes.

    Args:
        lights: A run or weights file, or `true`.
        normals: A run, a weights file, a combination such as `sdps`, or a classical method.
        second: A run or weights file.
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
        if pair.second and lights != TRUE_LIGHTS:  # of lights that are given nothing is left to correct
            second = second or prefix + pair.second
        lights = lights or prefix + pair.lighting
        normals = prefix + pair.normals
    if normals is None:
        raise InputError("--lights and --second need --normals as well; see `sdps list models`")
    lights = lights or _default_lights(normals, find)
    if normals in CLASSICAL:
        _check_classical(normals, lights, second, intensities)
    if second and lights in (NONE, TRUE_LIGHTS):
        raise InputError("--second corrects estimated lights; name a lighting model with --lights")
    method = combined(lights, normals, second or NONE, intensities=intensities or NONE, combination=combination)
    for needed in sorted(method.models()):
        find(needed)
    return method


def parse(text: str, find: Callable[[str], Path]) -> Method:
    """Return the method of an expression.

    Args:
        text: A combination (`sdps`), a normal model (`nenet`), a classical method (`pf14`), a lighting model alone
            (`lcnet`), lights and normals (`lcnet+psfcn`, `true+least-squares`), or these with a second lighting pass in
            the middle. Calibrated methods alone are given the true lights, networks alone what they were trained on;
            `shipped:` before a name means the pretrained weights. `+refine` at the end refines what was found.
        find: Gives the weights file of a name, or raises InputError.

    Raises:
        InputError: an unknown name, weights that are not there, or parts that do not go together.
    """
    parts = [part.strip() for part in text.split("+")]
    if parts == [REFINE]:
        raise InputError(f"method {text}: say what is refined, as in sdps-plus+{REFINE}")
    if parts[-1] == REFINE:
        return refined(parse("+".join(parts[:-1]), find))
    if not all(parts) or len(parts) > 3:
        raise InputError(f"method {text!r}: want METHOD, LIGHTS+NORMALS or LIGHTS+SECOND+NORMALS")
    if len(parts) > 1:
        return combine(parts[0], parts[-1], parts[1] if len(parts) == 3 else None, None, find)
    (name,) = parts
    if name == CONSTANT:
        return Method(name="constant predictor", normals=CONSTANT)
    if name in classical.METHODS:
        return combine(TRUE_LIGHTS if classical.METHODS[name].calibrated else None, name, None, None, find)
    if name.removeprefix(pretrained.SHIPPED) in COMBINATIONS:
        return combine(None, name, None, None, find)
    if name == TRUE_LIGHTS:
        raise InputError(f"method {name}: say which normals, as in true+psfcn")
    role = MODELS[model_of(name, find)].role
    if role == "second":
        raise InputError(f"method {name}: a second lighting pass needs LIGHTS+{name}+NORMALS")
    if role == "lighting":
        find(name)
        return Method(name=label(stem(name), NONE), lights=name)
    return combine(None, name, None, None, find)


def refined(method: Method) -> Method:
    """Return a method whose normals and lights are refined by inverse rendering (`sdps.refinement`).

    Raises:
        InputError: it gives no normals.
    """
    if method.normals in (NONE, CONSTANT):
        raise InputError(f"method {method.name}+{REFINE}: refinement needs a method that gives normals")
    return replace(method, name=f"{method.name}, refined", refined=True, paper="")


def by_networks(method: Method) -> bool:
    """Tell whether a network finds the normals, under lights that a network finds or that are given."""
    return method.lights != NONE and method.normals not in (NONE, *CLASSICAL)


def model_of(name: str, find: Callable[[str], Path]) -> str:
    """Return the registry model of a run or weights file.

    Raises:
        InputError: no such weights.
    """
    from sdps.models.checkpoint import load_weights

    plain = name.removeprefix(pretrained.SHIPPED)
    return plain if plain in MODELS else load_weights(find(name)).name


def _default_lights(normals: str, find: Callable[[str], Path]) -> str:
    """Return the lights a normal model was trained on; none for methods that are told none."""
    if normals in CLASSICAL:
        return NONE
    lights = MODELS[model_of(normals, find)].lights
    shipped = normals.startswith(pretrained.SHIPPED) and lights not in (NONE, TRUE_LIGHTS)
    return pretrained.SHIPPED + lights if shipped else lights


def _check_classical(normals: str, lights: str, second: str | None, intensities: str | None) -> None:
    """Refuse what a classical method would not look at, and a calibrated one without lights."""
    calibrated = normals in classical.METHODS and classical.METHODS[normals].calibrated
    if calibrated and not lights:
        raise InputError(f"{normals} is told the lights; give --lights, `true` or a lighting model")
    if not calibrated and (lights or second or intensities):
        raise InputError(f"{normals} finds the lights itself; leave out --lights, --second and --intensities")
