"""The rows of the paper's tables, and which of them the weights in a folder can fill."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from pipelines.presets import ALL, Preset
from sdps import recipes, weights
from sdps.inference_config import InferenceConfig
from sdps.methods import NONE, Method, combine, combined, label, parse
from sdps.models.registry import COMBINATIONS, MODELS, TRUE_LIGHTS

NORMAL_ROWS = (  # lighting, normals, second, row of the paper
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
    ("lcnet-soft", "psfcn", NONE, ""),
    ("lcnet-soft", "nenet-plus", NONE, ""),
    ("lcnet-soft", "nenet-plus", "lcnet-second", ""),
    ("lcnet", "least-squares", NONE, ""),
    (TRUE_LIGHTS, "least-squares", NONE, ""),
)


def finder(out: Path | None) -> "partial[Path]":
    """Return what gives the weights file of a name: trained in `out`, else shipped; it raises InputError."""
    return partial(weights.require, out=out)


def lighting_methods(out: Path, preset: Preset, ways: Sequence[Method]) -> list[Method]:
    """Return one method per lighting model trained in `out` or shipped, the paper's first, and LCNet's read-outs.

    Args:
        out: Folder of the runs.
        preset: Names runs of its own, and which shipped ways are wanted.
        ways: Those of `normal_methods`: where only some shipped ones are wanted, their lights are.
    """
    names = [name for name, item in MODELS.items() if item.role == "lighting"]
    starts = {settings.get("start") for settings in preset.runs.values()}  # no result of their own
    names += [name for name in preset.runs
              if name not in names and name not in starts and _role(name, preset) == "lighting"]  # fmt: skip
    names.append("lcnet-joint")
    trained = [name for name in names if weights.trained_file(out, name).is_file()]
    methods = [Method(name=name, lights=name, paper=MODELS[name].paper if name in MODELS else "") for name in trained]
    if "lcnet" in trained:
        others = (how for how in ("centre", "expectation", "peak") if how != preset.test.read_out)
        methods += [Method(name=f"lcnet, {how}", lights="lcnet", read_out=how) for how in others]
    available, told = weights.shipped(), {way.lights for way in ways}
    kept = [
        Method(name=label(weights.SHIPPED + name, NONE), lights=weights.SHIPPED + name, paper=MODELS[name].paper)
        for name in names
        if name in available and (preset.test.shipped == ALL or weights.SHIPPED + name in told)
    ]
    rows = [*methods, *kept]
    return rows if preset.test.light_views else with_views(rows, ways)


def with_views(rows: Sequence[Method], ways: Sequence[Method]) -> list[Method]:
    """Return rows of lights, and after them those that one of `ways` averages over turned views, averaged so."""
    counts = {way.lights: way.light_views for way in ways if way.light_views}
    averaged = [
        replace(row, name=f"{row.name}, {count} views", light_views=count, paper="")
        for row in rows
        if (count := counts.get(row.lights))
    ]
    return [*rows, *averaged]


def _role(name: str, preset: Preset) -> str:
    model = preset.run(name).model
    return "joint" if model == recipes.JOINT else MODELS[model].role


def normal_methods(out: Path, shipped: tuple[str, ...] = ALL, config: InferenceConfig | None = None) -> list[Method]:
    """Return the tables' rows whose models are all trained in `out`, and those that are shipped, or some of these.

    Combinations that differ from their parts by the views they average over have no row where `config` fixes these.

    Raises:
        InputError: `shipped` names what is not.
    """
    trained, kept = [], []
    available = set(weights.shipped())
    fixed = config is not None and None not in (config.light_views, config.normal_views)
    for method in _every_row():
        if fixed and (method.light_views or method.normal_views):
            continue
        if all(weights.trained_file(out, name).is_file() for name in method.models()):
            trained.append(method)
        if method.models() and method.models() <= available:
            kept.append(as_shipped(method))
    if shipped != ALL:
        kept = [_with_row(as_shipped(parse(text, finder(None)))) for text in shipped]
    return trained + kept


def _every_row() -> list[Method]:
    """Return the tables' rows, and after them the combinations that average over views."""
    rows = [combined(lights, normals, second, paper=paper) for lights, normals, second, paper in NORMAL_ROWS]
    for name, pair in COMBINATIONS.items():
        if pair.light_views or pair.normal_views:
            rows.append(combined(pair.lighting, pair.normals, pair.second, combination=name))
    return rows


def as_shipped(method: Method) -> Method:
    """Return the same way with the weights that travel with the package, where it needs any."""
    parts = {part: getattr(method, part) for part in ("lights", "normals", "second")}
    placed = {part: weights.SHIPPED + name for part, name in parts.items() if name in method.models()}
    return replace(method, name=f"{method.name} (shipped)", **placed) if placed else method


def chosen(out: Path, lights: str | None, normals: str | None, second: str | None, intensities: str | None) -> Method:
    """Return the method that flags describe, with its row in the paper's table; see `sdps.methods.combine`."""
    return _with_row(combine(lights, normals, second, intensities, finder(out)))


def _with_row(method: Method) -> Method:
    return replace(method, paper=paper_row(method))


def paper_row(method: Method) -> str:
    """Return the row of the paper's table of normals that a combination is, or an empty string."""
    parts = tuple(part.removeprefix(weights.SHIPPED) for part in (method.lights, method.normals, method.second))
    return "" if method.intensities else next((row[3] for row in NORMAL_ROWS if row[:3] == parts), "")
