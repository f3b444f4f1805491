"""From a preset's sections to the configuration of one run."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from render.shared.config import build
from render.shared.errors import InputError, unknown
from sdps.models.registry import COMBINATIONS, MODELS, TRUE_LIGHTS, Role, entry
from sdps.training.training_config import LightingTraining, NormalTraining, PixelTraining, TrainingConfig

CONFIGS: dict[Role, type[TrainingConfig]] = {
    "lighting": LightingTraining, "normals": NormalTraining, "pixels": PixelTraining,
}  # fmt: skip
"""The configuration of each role; a preset has a section for each."""
_LISTED = "`sdps models` lists what there is"


class Run(NamedTuple):
    """A training run.

    Attributes:
        name: Names the folder and the weights.
        model: Name in the registry.
        config: Resolved configuration.
        requires: Runs whose weights it needs, or weights themselves (`shipped:<name>`, a `.safetensors` file), by what
            they are for (`lighting`, `start`).
    """

    name: str
    model: str
    config: TrainingConfig
    requires: dict[str, str]


def run(name: str, sections: Mapping[str, Mapping[str, Any]], runs: Mapping[str, Mapping[str, Any]]) -> Run:
    """Resolve a run: the role's defaults, the model's recipe, the role's section, and the run's own settings.

    Args:
        name: A model's name, or a name in `runs`.
        sections: Settings per role.
        runs: Settings per run; `base` names the model of a run that is not called as its model.

    Raises:
        InputError: an unknown name, key or value.
    """
    own = dict(runs.get(name, {}))
    model = own.pop("base", name)
    if model not in MODELS:
        field = f"correct runs.{name}.base; " if name in runs else ""
        raise unknown("model", str(model), [*MODELS, *(other for other in runs if other != name)], field + _LISTED)
    role, recipe, where = entry(model).role, entry(model).recipe, f"runs.{name}"
    values: dict[str, Any] = {}
    for layer, settings in (("", recipe), (role, sections.get(role, {})), (where, own)):
        build(CONFIGS[role], {**values, **settings}, layer)  # names the section a mistake is in
        values |= {key: _merge(values.get(key), value) for key, value in settings.items()}
    config: TrainingConfig = build(CONFIGS[role], values, where)
    requires = _requires(name, model, config)
    return Run(name, model, config, requires | ({"start": config.start} if config.start else {}))


def _merge(before: Any, value: Any) -> Any:
    """Lay one section's value over another's; of nested sections, only the fields named."""
    return {**before, **value} if isinstance(before, Mapping) and isinstance(value, Mapping) else value


def _requires(name: str, model: str, config: TrainingConfig) -> dict[str, str]:
    """Return the lighting model whose weights a run needs, if any."""
    if not isinstance(config, NormalTraining):
        return {}
    if config.lights and not entry(model).lights:
        raise InputError(f"runs.{name}.lights: model {model!r} is not given lights; leave it out")
    lights = config.lights or entry(model).lights
    return {"lighting": lights} if lights and lights != TRUE_LIGHTS else {}


def expand(names: list[str], known: Mapping[str, Any]) -> list[str]:
    """Replace combinations by their members and `all` by every model and run; keep order, drop repetitions."""
    result: list[str] = []
    for name in names:
        if name == "all":
            result += [*MODELS, *known]
        elif name in COMBINATIONS:
            result += COMBINATIONS[name].members()
        elif name in MODELS or name in known:
            result.append(name)
        else:
            raise unknown("model", name, [*MODELS, *COMBINATIONS, *known, "all"], _LISTED)
    return list(dict.fromkeys(result))
