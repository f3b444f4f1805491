"""From a preset's sections to the configuration of one run."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from render.shared.config import build
from render.shared.errors import InputError, unknown
from sdps.models.registry import COMBINATIONS, MODELS, TRUE_LIGHTS, entry
from sdps.training.training_config import JointTraining, LightingTraining, NormalTraining, PixelTraining, TrainingConfig

JOINT = "sdps-joint"
"""The run that fine-tunes two trained models together; it makes `lcnet-joint` and `nenet-joint`."""

_CLASSES = {
    "lighting": LightingTraining, "second": LightingTraining, "normals": NormalTraining, "pixels": PixelTraining,
    "joint": JointTraining,
}  # fmt: skip
# Which sections of a preset a role reads, the later over the earlier.
_SECTIONS = {
    "lighting": ("lighting",), "second": ("lighting",), "normals": ("normals",), "pixels": ("pixels",),
    "joint": ("normals", "joint"),
}  # fmt: skip
SECTIONS = ("lighting", "normals", "pixels", "joint")


class Run(NamedTuple):
    """A training run.

    Attributes:
        name: Names the folder and the weights.
        model: Name in the registry, or `sdps-joint`.
        config: Resolved configuration.
        requires: Runs whose weights it needs, or weights themselves (`shipped:<name>`, a `.safetensors` file), by what
            they are for (`lighting`, `normals`, `start`).
    """

    name: str
    model: str
    config: TrainingConfig
    requires: dict[str, str]


def run(name: str, sections: Mapping[str, Mapping[str, Any]], runs: Mapping[str, Mapping[str, Any]]) -> Run:
    """Resolve a run: the role's defaults, the model's recipe, the role's section, and the run's own settings.

    Args:
        name: A model's name, `sdps-joint`, or a name in `runs`.
        sections: Settings per section of `SECTIONS`.
        runs: Settings per run; `base` names the model of a run that is not called as its model.

    Raises:
        InputError: an unknown name, key or value.
    """
    own = dict(runs.get(name, {}))
    model = own.pop("base", name)
    if model != JOINT and model not in MODELS:
        raise unknown("model", str(model), [*MODELS, JOINT, *(other for other in runs if other != name)])
    role, recipe = ("joint", {}) if model == JOINT else (entry(model).role, entry(model).recipe)
    values: dict[str, Any] = {}
    where = f"runs.{name}"
    for layer, settings in [("", recipe), *((part, sections.get(part, {})) for part in _SECTIONS[role]), (where, own)]:
        build(_CLASSES[role], {**values, **settings}, layer)  # names the section a mistake is in
        values |= {key: _joined(values.get(key), value) for key, value in settings.items()}
    config: TrainingConfig = build(_CLASSES[role], values, where)
    requires = _requires(name, model, config)
    return Run(name, model, config, requires | ({"start": config.start} if config.start else {}))


def _joined(before: Any, value: Any) -> Any:
    """Lay one section's value over another's; of nested sections, only the fields named."""
    return {**before, **value} if isinstance(before, Mapping) and isinstance(value, Mapping) else value


def _requires(name: str, model: str, config: TrainingConfig) -> dict[str, str]:
    """Return the runs whose weights a run needs."""
    lights = getattr(config, "lights", "")
    needed = {"lighting": lights, "normals": getattr(config, "normals", "")}
    if model != JOINT:
        if entry(model).role == "lighting":
            return {}
        if entry(model).role in ("normals", "pixels") and not entry(model).lights:
            if lights:
                raise InputError(f"runs.{name}.lights: model {model!r} is told no lights; leave it out")
            return {}
        needed = {
            "lighting": lights or entry(model).lights,
            "normals": getattr(config, "normals", "") or entry(model).normals,
        }
    return {use: run for use, run in needed.items() if run and run != TRUE_LIGHTS}


def expand(names: list[str], known: Mapping[str, Any]) -> list[str]:
    """Replace combinations by their members and `all` by every model and run; keep order, drop repetitions."""
    result: list[str] = []
    for name in names:
        if name == "all":
            result += [*MODELS, JOINT, *known]
        elif name in COMBINATIONS:
            result += COMBINATIONS[name].members()
        elif name in MODELS or name in known or name == JOINT:
            result.append(name)
        else:
            raise unknown("model", name, [*MODELS, JOINT, *COMBINATIONS, *known, "all"])
    return list(dict.fromkeys(result))
