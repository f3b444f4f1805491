"""Which methods a benchmark runs: expressions such as `lcnet+psfcn`, or everything there is."""

from pathlib import Path

from render.shared.errors import InputError
from sdps.classical import registry as classical
from sdps.inference.inference_config import InferenceConfig
from sdps.methods import pretrained
from sdps.methods.method import CONSTANT, Method
from sdps.methods.parse import model_of, parse
from sdps.methods.pretrained import finder
from sdps.methods.rows import normal_methods, with_views
from sdps.models.registry import COMBINATIONS, MODELS

SHOWN = ("least-squares, true lights", "pf14")
"""Classical methods whose pictures are shown, if they are run."""

LEARNED, CLASSICAL = "learned", "classical"
_MOST_SHOWN = 4


def lighting_rows(out: Path | None) -> list[Method]:
    """Return a method per lighting model, trained and shipped, that tells lights alone."""
    find = finder(out)

    def tells_lights(name: str) -> bool:
        model = MODELS[model_of(name, find)]
        return model.role == "lighting" and not model.any_light

    names = [name for name in pretrained.list_trained(out) if tells_lights(name)]
    names = sorted(names, key=lambda name: (list(MODELS).index(name) if name in MODELS else len(MODELS), name))
    kept = [name for name in (pretrained.SHIPPED + name for name in pretrained.list_shipped()) if tells_lights(name)]
    return [parse(name, find) for name in [*names, *kept]]


def classical_rows(*, calibrated: bool) -> list[Method]:
    """Return the methods without learning, and the constant predictor."""
    names = [name for name, entry in classical.METHODS.items() if calibrated or not entry.calibrated]
    return [parse(name, finder(None)) for name in [*names, CONSTANT]]


def every_method(out: Path | None, config: InferenceConfig | None = None) -> list[Method]:
    """Return every method there is: lighting models, all rows of normals, all classical methods."""
    return select_methods([LEARNED, CLASSICAL], out, config)


def select_methods(expressions: list[str], out: Path | None, config: InferenceConfig | None = None) -> list[Method]:
    """Return the methods of `--methods`, each once; `learned` and `classical` stand for all of a kind."""
    found: list[Method] = []
    fixed = config is not None and config.light_views is not None  # then no row has views of its own
    for text in expressions:
        if text == LEARNED:
            normals = normal_methods(pretrained.shipped_folder() if out is None else out)  # nothing trained there
            lights = lighting_rows(out)
            found += [*(lights if fixed else with_views(lights, normals)), *normals]
        elif text == CLASSICAL:
            found += classical_rows(calibrated=True)
        else:
            found.append(parse(text, finder(out)))
    return list({method.name: method for method in found}.values())


def list_shown(chosen: list[Method]) -> list[str]:
    """Return the names of the methods whose normals are worth a picture, the main one first."""
    giving = [method for method in chosen if method.normals and method.normals != CONSTANT]
    if len(giving) <= _MOST_SHOWN:
        return [method.name for method in giving]
    pair = COMBINATIONS["sdps"].members()
    main = [
        m.name for m in giving if tuple(n.removeprefix(pretrained.SHIPPED) for n in (m.lighting, m.normals)) == pair
    ]
    plus = [method.name for method in giving if method.normal_views]
    classic = [method.name for method in giving if method.name in SHOWN]
    return [*main[-1:], *plus[-1:], *classic] or [giving[0].name]


def runs_folder(folder: Path | None) -> Path | None:
    """Return the folder of the runs for what a user may name: it, or the `models` folder in it.

    Raises:
        InputError: no such folder, or no weights in it.
    """
    if folder is None:
        return None
    base = folder.resolve().parent if folder.resolve().name == pretrained.MODELS_FOLDER else folder
    if not pretrained.list_trained(base):
        raise InputError(
            f"{folder}: no trained weights under {pretrained.MODELS_FOLDER}/; give the --out of `sdps train`"
        )
    return base
