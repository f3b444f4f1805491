"""Running methods on a benchmark's objects, and what is written about it: results.json and the report's section."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from pipelines.evaluate.evaluation import Evaluation, TestObject
from pipelines.evaluate.object_pictures import Found, tiles
from pipelines.report.sections import Section, SectionWriter, Table
from pipelines.shared import using
from pipelines.shared.text_tables import render_text
from render.shared.errors import unknown
from render.shared.files import write_json
from render.shared.progress import progress_bar
from sdps.inference.inference_config import InferenceConfig
from sdps.methods import select
from sdps.methods.method import Method
from sdps.methods.pretrained import finder
from sdps.methods.runner import Runner


def run(
    items: Sequence[TestObject],
    chosen: Sequence[Method],
    models: Path | None,
    folder: Path,
    config: InferenceConfig,
    shown: Sequence[str],
) -> tuple[Found, list[Runner]]:
    """Run methods on objects, or take their results from the cache in `folder`.

    Args:
        items: The objects, whose `load` gives a `Stack`; images are read only if a method needs them.
        chosen: The methods.
        models: Folder of the runs, None for shipped weights only.
        folder: Where results are kept.
        config: How networks are used.
        shown: Methods whose normal maps are kept for pictures.
    """
    runners = [Runner(method, finder(models), config) for method in chosen]
    evaluation = Evaluation(folder)
    found: Found = {runner.method.name: {} for runner in runners}
    with progress_bar(None, desc="evaluate", unit="result", total=len(items) * len(runners)) as bar:
        for item in items:
            once = replace(item, load=cache(lambda item=item: item.load().opened()))
            for runner in runners:
                name = runner.method.name
                found[name][item.name] = evaluation.result(once, runner, keep_normals=name in shown)
                bar.update(1)
    return found, runners


def write(
    out: Path,
    section: Section,
    items: Sequence[TestObject],
    found: Found,
    runners: Sequence[Runner],
    shown: Sequence[str],
    protocol: dict[str, Any],
) -> None:
    """Write `<out>/<section>/results.json` and the report's section."""
    write_json(out / section.name / "results.json", {
        "definition": section.text,
        "protocol": protocol,
        "weights": {name: str(file) for runner in runners for name, file in runner.files.items()},
        "objects": {item.name: _about(item) for item in items},
        "methods": {
            name: {
                key: {"scores": one.scores, "seconds": one.seconds, "refused": one.reason} for key, one in row.items()
            }
            for name, row in found.items()
        },
        "tables": {table.title: {"header": table.header, "rows": table.rows, "published": table.published}
                   for table in section.tables},
    })  # fmt: skip
    writer = SectionWriter(section)
    for item in items:
        writer.strip(f"{item.name}, {len(item.true_directions)} images", tiles(item, found, shown))
    writer.write(out)


def _about(item: TestObject) -> dict[str, Any]:
    height, width = item.mask.shape
    return {
        "images": len(item.true_directions), "pixels": int(item.mask.sum()), "height": height, "width": width,
        "digest": item.digest,
    }  # fmt: skip


def text_of(tables: Sequence[Table], found: Found) -> str:
    """Lay out tables and refusals for the terminal."""
    parts = [
        render_text(f"\n{table.title}", list(table.header), [list(row) for row in table.rows], left=(0, 1))
        for table in tables
    ]
    refused = [
        f"{name} refused {key}: {one.reason}" for name, row in found.items() for key, one in row.items() if one.reason
    ]
    return "".join(parts) + ("\n" + "\n".join(refused) + "\n" if refused else "")


def lighting_only(found: Found, chosen: Sequence[Method]) -> Found:
    """Leave out methods whose lights are those of another that tells lights alone."""
    alone = {_lights_of(method) for method in chosen if method.lights and not method.normals}
    kept = [
        method.name for method in chosen if not (method.normals and not method.second and _lights_of(method) in alone)
    ]
    return {name: found[name] for name in kept}


def _lights_of(method: Method) -> tuple[str, str | None, int | None]:
    return method.lights, method.read_out, method.light_views


def add_arguments(parser: Any, out: str) -> None:
    """Declare the flags every benchmark has."""
    parser.add_argument("data", type=Path, help="folder of the benchmark, see docs/benchmarks.md")
    parser.add_argument("--methods", action="append", metavar="METHOD,LIGHTS+NORMALS,...",
                        help="commas or repeat, e.g. lcnet+psfcn,learned,classical (default: all)")  # fmt: skip
    parser.add_argument("--models", type=Path, metavar="DIR",
                        help="--out of `sdps train`, whose models are evaluated (default: shipped ones)")  # fmt: skip
    parser.add_argument("--objects", action="append", help="commas or repeat (default: all in the folder)")
    using.add_arguments(parser)
    parser.add_argument("--out", type=Path, default=Path(out), help="output folder (default: %(default)s)")


def pick(items: list[TestObject], names: Sequence[str]) -> list[TestObject]:
    """Return the objects of `--objects`, or all.

    Raises:
        InputError: a name that is not there.
    """
    known = {item.name: item for item in items}
    for name in names:
        if name not in known:
            raise unknown("object", name, known)
    return [known[name] for name in names] if names else items


def pictured(chosen: Sequence[Method]) -> list[str]:
    """Return the names of the methods to show, and of the first lighting model."""
    names = select.shown(list(chosen))
    lights = [method.name for method in chosen if method.lights and not method.normals][:1]
    return names or lights
