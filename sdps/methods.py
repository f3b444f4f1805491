"""Methods, learned and classical, behind one interface: images in, normals and lights out."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from render.errors import InputError
from render.shards import file_hash
from sdps import weights
from sdps.baselines import constant_estimate
from sdps.classical import registry as classical
from sdps.estimate import Estimate
from sdps.image_source import ImageSource, survey
from sdps.inference import Estimator, default_device, load_model
from sdps.inference_config import InferenceConfig
from sdps.lighting import ReadOut
from sdps.metrics import score
from sdps.models.registry import COMBINATIONS, MODELS, TRUE_LIGHTS

if TYPE_CHECKING:
    from sdps.checkpoint import TrainedModel

NONE = ""
_digest = cache(file_hash)
CONSTANT = "constant"
"""A predictor that sees nothing: what knowing nothing scores."""
CLASSICAL = (*classical.METHODS, CONSTANT)
_VIEWS = ("light_views", "normal_views")
_PLACES = ("lights", "second", "normals")


@dataclass(frozen=True, kw_only=True)
class Method:
    """A way from images to lights or normals.

    Attributes:
        name: Label of its row.
        lights: A lighting model (run or file), `true` for lights that are given, or empty for none.
        normals: A normal model, a classical method, or empty for lighting alone.
        second: A second lighting pass, or empty.
        intensities: `true` where only the intensities are given, else empty.
        read_out: How light classes become lights; None for the configuration's.
        light_views: Turned views that lights are averaged over where the configuration does not say; None for one.
        normal_views: The same for normals.
        paper: Row of the paper's table.
    """

    name: str
    lights: str = NONE
    normals: str = NONE
    second: str = NONE
    intensities: str = NONE
    read_out: ReadOut | None = None
    light_views: int | None = None
    normal_views: int | None = None
    paper: str = ""

    def models(self) -> set[str]:
        """Return the runs whose weights it needs."""
        return {self.lights, self.normals, self.second} - {NONE, TRUE_LIGHTS, *CLASSICAL}


@cache
def _loaded(path: Path) -> "TrainedModel":
    """Load a model once, however many methods use it."""
    return load_model(path, default_device())


class Runner:
    """A method with its networks loaded.

    Args:
        method: What to do.
        find: Gives the weights file of a name, or raises InputError.
        config: How networks are used; what the method itself says of its read-out and views is filled in.

    Raises:
        InputError: weights that are missing, damaged, or of another role.
    """

    def __init__(self, method: Method, find: Callable[[str], Path], config: InferenceConfig | None = None) -> None:
        self.method, self.config = method, _filled(config or InferenceConfig(), method)
        self.files = {name: find(name) for name in sorted(method.models())}

        def model(name: str) -> "TrainedModel | None":
            return _loaded(self.files[name]) if name in self.files else None

        lighting, normals, second = (model(name) for name in (method.lights, method.normals, method.second))
        self.estimator = None
        if lighting is not None or normals is not None:
            self.estimator = Estimator(
                lighting=lighting,
                normals=normals,
                second=second,
                device=default_device(),
                **self.config.options(),
            )

    def identity(self) -> str:
        """Return a digest of what results depend on besides images and code: weights, settings and arithmetic."""
        method = self.method
        names = {place: getattr(method, place) for place in _PLACES}
        parts = [method.intensities]
        parts += [(place, _digest(self.files[name]) if name in self.files else name) for place, name in names.items()]
        if self.estimator is not None:
            used = self.config.options() | {"precision": self.estimator.arithmetic.precision}
            parts += [used, str(self.estimator.device)]
        return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]

    def estimate(
        self,
        images: ImageSource,
        mask: np.ndarray,
        lights: np.ndarray | None,
        intensities: np.ndarray | None,
        found: dict[tuple, Estimate] | None = None,
    ) -> Estimate:
        """Run the method; of the lights it sees what it is to be given.

        Args:
            images: (L, H, W, 3) linear radiance, an array or what reads it a few images at a time.
            mask: (H, W) bool.
            lights: (L, 3) directions, or None where the method is given none.
            intensities: (L,) or (L, 3), or None where they are not known.
            found: Lights that methods found of these very images, by what they depend on; read, and added to.

        Raises:
            InputError: images or lights the method cannot work with, in one line.
        """
        method, given = self.method, {}
        if method.lights == TRUE_LIGHTS:
            given["lights"] = lights
        if TRUE_LIGHTS in (method.lights, method.intensities) and intensities is not None:
            given["intensities"] = intensities
        if method.normals == CONSTANT:
            return constant_estimate(len(images), mask)
        if method.normals in classical.METHODS:
            return self._classical(images, mask, given, found)
        if not method.normals:
            return self._lights(images, mask, given, found)
        if found is not None and method.lights not in (NONE, TRUE_LIGHTS):
            given["found"] = self._lights(images, mask, given, found)
        return self.estimator.estimate(images, mask, **given)

    def _lights(
        self, images: ImageSource, mask: np.ndarray, given: dict[str, Any], found: dict[tuple, Estimate] | None
    ) -> Estimate:
        """Estimate the lights, or take what another method with the same lighting networks found."""
        found = {} if found is None else found
        places = _PLACES if self.method.second else ("lights",)  # a second pass sees normals
        used = (_digest(self.files[getattr(self.method, place)]) for place in places)
        options = self.config.options() | ({} if self.method.second else {"normal_views": None, "rotations": None})
        key = (*used, *options.items(), "intensities" in given)
        if key not in found:
            found[key] = self.estimator.estimate_lights(images, mask, given.get("intensities"))
        return found[key]

    def _classical(
        self, images: ImageSource, mask: np.ndarray, given: dict[str, Any], found: dict[tuple, Estimate] | None
    ) -> Estimate:
        """Run a classical method, which holds the object's box of all images at once."""
        name, told = self.method.normals, ()
        if classical.METHODS[name].calibrated:
            if self.method.lights == TRUE_LIGHTS:
                told = given["lights"], given.get("intensities")
            else:
                lit = self._lights(images, mask, given, found)
                told = lit.light_directions, lit.intensities
        if isinstance(images, np.ndarray):
            return classical.run(name, images, mask, *told)
        scene = survey(images, mask, margin=2)
        estimate = classical.run(name, scene.read(0, len(images)), scene.mask, *told)
        normals = np.zeros((*mask.shape, 3), np.float32)
        normals[scene.rows, scene.columns] = estimate.normals
        return replace(estimate, normals=normals)

    def score(
        self,
        estimate: Estimate,
        mask: np.ndarray,
        normals: np.ndarray | None,
        lights: np.ndarray | None,
        intensities: np.ndarray | None,
    ) -> dict[str, float]:
        """Return the metrics of what the method estimated itself, and nothing it was given."""
        method, truth = self.method, {}
        if estimate.normals.size and normals is not None:
            truth["normals"] = normals
        if method.lights != TRUE_LIGHTS and len(estimate.light_directions) and lights is not None:
            truth["light_directions"] = lights
        found = len(estimate.intensities) and TRUE_LIGHTS not in (method.lights, method.intensities)
        if found and intensities is not None:
            truth["intensities"] = intensities
        return {item.name: item.value for item in score(estimate, mask, **truth)}


def _filled(config: InferenceConfig, method: Method) -> InferenceConfig:
    """Return the configuration with what the method says where it says nothing, one view where neither does."""
    views = {name: getattr(config, name) or getattr(method, name) or 1 for name in _VIEWS}
    return replace(config, read_out=method.read_out or config.read_out, **views)


def label(lights: str, normals: str, second: str = NONE, *, combination: str = NONE) -> str:
    """Name what parts make together, by the combination's name and its parts where it has one."""
    suffix = " (shipped)" if any(part.startswith(weights.SHIPPED) for part in (lights, normals, second)) else ""
    lights, normals, second = (part.removeprefix(weights.SHIPPED) for part in (lights, normals, second))
    if lights == TRUE_LIGHTS:
        text = f"{normals}, true lights"
    else:
        text = " + ".join(part for part in (lights, second, normals) if part)
    return (f"{combination} ({text})" if combination else text) + suffix


def combined(
    lights: str,
    normals: str,
    second: str = NONE,
    *,
    paper: str = "",
    intensities: str = NONE,
    combination: str = NONE,
) -> Method:
    """Return the method of parts that go together, with its label; asked for as a combination, with its views."""
    pair = COMBINATIONS[combination] if combination else None
    views = {field: getattr(pair, field, None) for field in _VIEWS}
    named = combination if any(views.values()) else NONE  # others are their parts, and called so
    name = label(*map(_stem, (lights, normals, second)), combination=named)
    return Method(
        name=name + (", true intensities" if intensities else ""),
        lights=lights,
        normals=normals,
        second=second,
        intensities=intensities,
        paper=paper,
        **views,
    )


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
    prefix = weights.SHIPPED if normals and normals.startswith(weights.SHIPPED) else ""
    name = normals.removeprefix(prefix) if normals else NONE
    combination = name if name in COMBINATIONS else NONE
    if combination:
        pair = COMBINATIONS[combination]
        if pair.second and lights != TRUE_LIGHTS:  # of lights that are given nothing is left to correct
            second = second or prefix + pair.second
        lights = lights or prefix + pair.lighting
        normals = prefix + pair.normals
    if normals is None:
        raise InputError("--lights and --second need --normals as well; see `sdps models`")
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
            `shipped:` before a name means the shipped weights.
        find: Gives the weights file of a name, or raises InputError.

    Raises:
        InputError: an unknown name, weights that are not there, or parts that do not go together.
    """
    parts = [part.strip() for part in text.split("+")]
    if not all(parts) or len(parts) > 3:
        raise InputError(f"method {text!r}: want METHOD, LIGHTS+NORMALS or LIGHTS+SECOND+NORMALS")
    if len(parts) > 1:
        return combine(parts[0], parts[-1], parts[1] if len(parts) == 3 else None, None, find)
    (name,) = parts
    if name == CONSTANT:
        return Method(name="constant predictor", normals=CONSTANT)
    if name in classical.METHODS:
        return combine(TRUE_LIGHTS if classical.METHODS[name].calibrated else None, name, None, None, find)
    if name.removeprefix(weights.SHIPPED) in COMBINATIONS:
        return combine(None, name, None, None, find)
    if name == TRUE_LIGHTS:
        raise InputError(f"method {name}: say which normals, as in true+psfcn")
    role = MODELS[model_of(name, find)].role
    if role == "second":
        raise InputError(f"method {name}: a second lighting pass needs LIGHTS+{name}+NORMALS")
    if role == "lighting":
        find(name)
        return Method(name=label(_stem(name), NONE), lights=name)
    return combine(None, name, None, None, find)


def model_of(name: str, find: Callable[[str], Path]) -> str:
    """Return the registry model of a run or weights file.

    Raises:
        InputError: no such weights.
    """
    from sdps.checkpoint import load_weights

    plain = name.removeprefix(weights.SHIPPED)
    return plain if plain in MODELS else load_weights(find(name)).name


def _stem(name: str) -> str:
    return Path(name).stem if name.endswith(".safetensors") else name


def _default_lights(normals: str, find: Callable[[str], Path]) -> str:
    """Return the lights a normal model was trained on; none for methods that are told none."""
    if normals in CLASSICAL:
        return NONE
    lights = MODELS[model_of(normals, find)].lights
    shipped = normals.startswith(weights.SHIPPED) and lights not in (NONE, TRUE_LIGHTS)
    return weights.SHIPPED + lights if shipped else lights


def _check_classical(normals: str, lights: str, second: str | None, intensities: str | None) -> None:
    """Refuse what a classical method would not look at, and a calibrated one without lights."""
    calibrated = normals in classical.METHODS and classical.METHODS[normals].calibrated
    if calibrated and not lights:
        raise InputError(f"{normals} is told the lights; give --lights, `true` or a lighting model")
    if not calibrated and (lights or second or intensities):
        raise InputError(f"{normals} finds the lights itself; leave out --lights, --second and --intensities")
