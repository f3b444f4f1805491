"""Which trained models are evaluated, alone and in combination: the rows of the tables."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.train import MODELS_FOLDER, weights_file
from render.errors import InputError, unknown
from sdps import recipes
from sdps.classical import registry as classical
from sdps.lighting import ReadOut
from sdps.models.registry import COMBINATIONS, MODELS, TRUE_LIGHTS

if TYPE_CHECKING:
    from pipelines.presets import Preset

NONE = ""
CLASSICAL = (*classical.METHODS, "constant")


@dataclass(frozen=True, kw_only=True)
class Method:
    """A way from images to lights or normals.

    Attributes:
        name: Label of its row.
        lights: A lighting model (run or file), `true`, or empty for none.
        normals: A normal model, a classical method, or empty for lighting alone.
        second: A second lighting pass, or empty.
        intensities: `true` where only the intensities are given, else empty.
        read_out: How light classes become lights; None for the preset's.
        paper: Row of the paper's table.
    """

    name: str
    lights: str = NONE
    normals: str = NONE
    second: str = NONE
    intensities: str = NONE
    read_out: ReadOut | None = None
    paper: str = ""

    def models(self) -> set[str]:
        """Return the runs whose weights it needs."""
        return {self.lights, self.normals, self.second} - {NONE, TRUE_LIGHTS, *CLASSICAL}


_NORMAL_ROWS = (  # lighting, normals, second, row of the paper
    (TRUE_LIGHTS, "psfcn", NONE, "B0"),
    ("lcnet", "nenet", NONE, "B1"),
    ("lcnet", "psfcn", NONE, "B2"),
    ("lcnet-reg", "nenet-reg", NONE, "B3"),
    ("lcnet-reg", "psfcn", NONE, "B4"),
    (NONE, "upsfcn-deep-mask", NONE, "B5"),
    (NONE, "upsfcn-deep", NONE, "B6"),
    (NONE, "upsfcn-wide", NONE, "B7"),
    (NONE, "upsfcn-light", NONE, "B8"),
    (NONE, "upsfcn", NONE, "B9"),
    (TRUE_LIGHTS, "nenet", NONE, ""),
    ("lcnet", "nenet-norm", NONE, ""),
    (TRUE_LIGHTS, "psfcn-norm", NONE, ""),
    ("lcnet", "psfcn-norm", NONE, ""),
    (TRUE_LIGHTS, "cnnps", NONE, ""),
    ("lcnet", "cnnps", NONE, ""),
    ("lcnet-joint", "nenet-joint", NONE, ""),
    ("lcnet-soft", "nenet-plus", NONE, ""),
    ("lcnet-soft", "nenet-plus", "lcnet-second", ""),
    ("lcnet", "least-squares", NONE, ""),
    (TRUE_LIGHTS, "least-squares", NONE, ""),
)


def lighting_methods(out: Path, preset: "Preset") -> list[Method]:
    """Return one method per trained lighting model, the paper's first, and LCNet's other read-outs."""
    trained = [name for name in _lighting_runs(preset) if weights_file(out, name).is_file()]
    methods = [Method(name=name, lights=name, paper=_paper(name, preset)) for name in trained]
    if "lcnet" in trained:
        others = (how for how in ("centre", "expectation", "peak") if how != preset.test.read_out)
        methods += [Method(name=f"lcnet, {how}", lights="lcnet", read_out=how) for how in others]
    return methods


def _lighting_runs(preset: "Preset") -> list[str]:
    names = [name for name, item in MODELS.items() if item.role == "lighting"]
    return [*names, *(name for name in preset.runs if _role(name, preset) == "lighting"), "lcnet-joint"]


def _role(name: str, preset: "Preset") -> str:
    model = preset.run(name).model
    return "joint" if model == recipes.JOINT else MODELS[model].role


def _paper(name: str, preset: "Preset") -> str:
    """Return the paper's row of a lighting model as published, not of runs with other settings."""
    return MODELS[name].paper if name in MODELS else ""


def normal_methods(out: Path) -> list[Method]:
    """Return the tables' rows whose models are all trained."""
    methods = []
    for lights, normals, second, paper in _NORMAL_ROWS:
        method = Method(name=label(lights, normals, second), lights=lights, normals=normals, second=second, paper=paper)
        if all(weights_file(out, name).is_file() for name in method.models()):
            methods.append(method)
    return methods


def label(lights: str, normals: str, second: str = NONE) -> str:
    """Name a combination."""
    for name, pair in COMBINATIONS.items():
        if second and pair.members() == (lights, normals, second):
            return f"{name} ({' + '.join(pair.members())})"
    if lights == TRUE_LIGHTS:
        return f"{normals}, true lights"
    return " + ".join(part for part in (lights, second, normals) if part)


def chosen(out: Path, lights: str | None, normals: str | None, second: str | None, intensities: str | None) -> Method:
    """Return the method that flags describe.

    Args:
        out: Folder of the runs.
        lights: `--lights`: a run or weights file, or `true`.
        normals: `--normals`: a run, a weights file, or a combination.
        second: `--second`: a run or weights file.
        intensities: `--intensities`: `true` where only these are given.

    Raises:
        InputError: a name without weights, or flags that do not go together.
    """
    if normals in COMBINATIONS:
        pair = COMBINATIONS[normals]
        lights, normals, second = lights or pair.lighting, pair.normals, second or pair.second
    if normals is None:
        raise InputError("--lights and --second need --normals as well; see `sdps models`")
    require(out, [Method(name="", normals=normals, lights=lights or NONE, second=second or NONE)])
    needs = model_of(out, normals)
    if lights is None and needs is not None and MODELS[needs].lights:
        lights = MODELS[needs].lights
    if second and lights in (None, TRUE_LIGHTS):
        raise InputError("--second corrects estimated lights; name a lighting model with --lights")
    name = label(Path(lights).stem if lights else NONE, Path(normals).stem, Path(second).stem if second else NONE)
    if intensities:
        name += ", true intensities"
    method = Method(
        name=name, lights=lights or NONE, normals=normals, second=second or NONE, intensities=intensities or NONE
    )
    require(out, [method])
    return method


def model_of(out: Path, name: str) -> str | None:
    """Return the registry model of a run or weights file, None for classical methods."""
    from sdps.checkpoint import load_weights

    if name in CLASSICAL:
        return None
    return name if name in MODELS else load_weights(file_of(out, name)).name


def file_of(out: Path, name: str) -> Path:
    """Return the weights file a run's name, or a path, stands for."""
    return Path(name) if name.endswith(".safetensors") else weights_file(out, name)


def require(out: Path, methods: Iterable[Method]) -> None:
    """Refuse methods whose weights are not there."""
    for name in {name for method in methods for name in method.models()}:
        if not file_of(out, name).is_file():
            known = sorted(path.parent.name for path in (out / MODELS_FOLDER).glob("*/*.safetensors"))
            if name not in MODELS and not name.endswith(".safetensors"):
                raise unknown("trained model", name, {*known, *MODELS})
            raise InputError(f"{file_of(out, name)}: no such weights; train them with `sdps train --models {name}`")
