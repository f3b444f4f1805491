"""The rows of the paper's tables, and which of them the weights in a folder can fill."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from sdps.core.lighting import ReadOut
from sdps.inference.inference_config import InferenceConfig
from sdps.methods import pretrained
from sdps.methods.method import NONE, Method, join, label
from sdps.methods.parse import combine, parse
from sdps.methods.pretrained import ALL, finder
from sdps.models.registry import COMBINATIONS, MODELS, TRUE_LIGHTS

NORMAL_ROWS = (  # lighting, normals, row of the paper
    (TRUE_LIGHTS, "psfcn", "B0"),
    ("lcnet", "nenet", "B1"),
    ("lcnet", "psfcn", "B2"),
    ("lcnet-reg", "nenet-reg", "B3"),
    ("lcnet-reg", "psfcn", "B4"),
    (NONE, "upsfcn-deep-mask", "B5"),
    (NONE, "upsfcn-deep", "B6"),
    (NONE, "upsfcn-wide", "B7"),
    (NONE, "upsfcn-light", "B8"),
    (NONE, "upsfcn", "B9"),
    (TRUE_LIGHTS, "nenet", ""),
    ("lcnet", "nenet-norm", ""),
    (TRUE_LIGHTS, "psfcn-norm", ""),
    ("lcnet", "psfcn-norm", ""),
    (TRUE_LIGHTS, "cnnps", ""),
    ("lcnet", "cnnps", ""),
    ("lcnet-soft", "psfcn", ""),
    ("lcnet-soft", "nenet-plus", ""),
    ("lightset", "frames", ""),
    (TRUE_LIGHTS, "frames", ""),
    ("lcnet", "least-squares", ""),
    (TRUE_LIGHTS, "least-squares", ""),
)


def lighting_methods(
    out: Path, own: Sequence[str], config: InferenceConfig, ways: Sequence[Method], shipped: tuple[str, ...] = ALL
) -> list[Method]:
    """Return one method per lighting model trained in `out` or shipped, the paper's first, and LCNet's read-outs.

    Args:
        out: Folder of the runs.
        own: Runs that give lights and are not called as their model.
        config: How networks are used.
        ways: Those of `normal_methods`: where only some shipped ones are wanted, their lights are.
        shipped: Shipped ways that are wanted.
    """
    names = [name for name, item in MODELS.items() if item.role == "lighting" and not item.any_light]
    names += [name for name in own if name not in names]
    trained = [name for name in names if pretrained.trained_file(out, name).is_file()]
    methods = [Method(name=name, lighting=name, paper=MODELS[name].paper if name in MODELS else "") for name in trained]
    if "lcnet" in trained:
        read_outs: tuple[ReadOut, ...] = ("centre", "expectation", "peak")
        others = (how for how in read_outs if how != config.read_out)
        methods += [Method(name=f"lcnet, {how}", lighting="lcnet", read_out=how) for how in others]
    available, wanted = pretrained.list_shipped(), {way.lighting for way in ways}
    kept = [
        Method(
            name=label(pretrained.SHIPPED + name, NONE), lighting=pretrained.SHIPPED + name, paper=MODELS[name].paper
        )
        for name in names
        if name in available and (shipped == ALL or pretrained.SHIPPED + name in wanted)
    ]
    rows = [*methods, *kept]
    return rows if config.light_views else with_views(rows, ways)


def with_views(rows: Sequence[Method], ways: Sequence[Method]) -> list[Method]:
    """Return rows of lights, and after them those that one of `ways` averages over turned views, averaged so."""
    counts = {way.lighting: way.light_views for way in ways if way.light_views}
    averaged = [
        replace(row, name=f"{row.name}, {count} views", light_views=count, paper="")
        for row in rows
        if (count := counts.get(row.lighting))
    ]
    return [*rows, *averaged]


def normal_methods(out: Path, shipped: tuple[str, ...] = ALL, config: InferenceConfig | None = None) -> list[Method]:
    """Return the tables' rows whose models are all trained in `out`, and those that are shipped, or some of these.

    Combinations that differ from their parts by the views they average over have no row where `config` fixes these.

    Raises:
        InputError: `shipped` names what is not.
    """
    trained, kept = [], []
    available = set(pretrained.list_shipped())
    fixed = config is not None and None not in (config.light_views, config.normal_views)
    for method in _every_row():
        if fixed and (method.light_views or method.normal_views):
            continue
        if all(pretrained.trained_file(out, name).is_file() for name in method.models()):
            trained.append(method)
        if method.models() and method.models() <= available:
            kept.append(as_shipped(method))
    if shipped != ALL:
        kept = [_with_row(as_shipped(parse(text, finder(None)))) for text in shipped]
    return trained + kept


def _every_row() -> list[Method]:
    """Return the tables' rows, and after them the combinations that average over views."""
    rows = [join(lighting, normals, paper=paper) for lighting, normals, paper in NORMAL_ROWS]
    for name, pair in COMBINATIONS.items():
        if (pair.light_views or pair.normal_views) and not MODELS[pair.normals].any_light:
            rows.append(join(pair.lighting, pair.normals, combination=name))
    return rows


def as_shipped(method: Method) -> Method:
    """Return the same way with the weights that travel with the package, where it needs any."""
    parts = {part: getattr(method, part) for part in ("lighting", "normals")}
    placed = {part: pretrained.SHIPPED + name for part, name in parts.items() if name in method.models()}
    return replace(method, name=f"{method.name} (shipped)", **placed) if placed else method


def from_flags(out: Path, lighting: str | None, normals: str | None, intensities: str | None) -> Method:
    """Return the method that flags describe, with its row in the paper's table; see `sdps.methods.parse.combine`."""
    return _with_row(combine(lighting, normals, intensities, finder(out)))


def _with_row(method: Method) -> Method:
    return replace(method, paper=paper_row(method))


def paper_row(method: Method) -> str:
    """Return the row of the paper's table of normals that a combination is, or an empty string."""
    if method.intensities or method.refined:
        return ""
    parts = tuple(part.removeprefix(pretrained.SHIPPED) for part in (method.lighting, method.normals))
    return next((row[2] for row in NORMAL_ROWS if row[:2] == parts), "")
