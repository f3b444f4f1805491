"""Running methods on a benchmark's objects, and what is written about it: results.json and the report's section."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from pipelines.evaluate.evaluation import Evaluation, Found, TestObject
from pipelines.evaluate.object_pictures import tiles
from pipelines.evaluate.published import read_published_rows
from pipelines.evaluate.report.sections import Section, SectionWriter, Table
from pipelines.evaluate.score_tables import object_table, publish, weights_of
from pipelines.shared import network_flags
from pipelines.shared.flags import add_out, pick_names, split_list
from render.shared.config import to_plain
from sdps.inference.inference_config import InferenceConfig, inference_config
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
    # read whole, so that no method is blamed for a damaged file
    objects = ((item.name, replace(item, load=partial(lambda load: load().open(), item.load))) for item in items)
    for name, runner, result in evaluation.run(objects, runners, len(items), "evaluate", shown):
        found[runner.method.name][name] = result
    return found, runners


@dataclass(frozen=True)
class Benchmark:
    """Real objects with published results.

    Attributes:
        name: Folder name of its results.
        title: Its name in tables.
        order: Place of its section in the report.
        known: Its objects in the order of the published tables.
        tables: Caption, published quantity, score and digits of each table.
        note: A sentence below the tables.
    """

    name: str
    title: str
    order: int
    known: tuple[str, ...]
    tables: tuple[tuple[str, str, str, int], ...]
    note: str = ""


def named_methods(args: argparse.Namespace) -> list[Method]:
    """Return the methods of `--methods`; none where it is not given."""
    return select.select_methods(split_list(args.methods), select.runs_folder(args.models), inference_config(args))


def evaluate(
    bench: Benchmark,
    args: argparse.Namespace,
    items: Sequence[TestObject],
    chosen: Sequence[Method],
    *,
    text: str,
    protocol: dict[str, Any],
    command: str,
) -> int:
    """Run methods, print the tables, and write `<out>/<name>/results.json` and the report's section.

    Args:
        bench: The benchmark.
        args: Flags of `add_arguments`.
        items: Its objects.
        chosen: The methods.
        text: What the numbers are of.
        protocol: The same for results.json.
        command: The command that does it again, without `--out`.
    """
    config, shown, file = inference_config(args), pick_pictured(chosen), args.out / bench.name / "results.json"
    found, runners = run(items, chosen, select.runs_folder(args.models), file.parent / "cache", config, shown)
    section = Section(
        name=bench.name, title=bench.title, text=text + network_flags.describe(runners, config), order=bench.order,
        tables=build_tables(bench, items, found, chosen), command=f"{command} --out {args.out}",
    )  # fmt: skip
    writer = SectionWriter(section)
    for item in items:
        writer.strip(f"{item.name}, {len(item.true_directions)} images", tiles(item, found, shown))
    values = {
        "protocol": protocol | to_plain(config),
        "weights": weights_of(runners),
        "objects": {item.name: _about(item) for item in items},
        "methods": {
            name: {
                key: {"scores": one.scores, "seconds": one.seconds, "refused": one.reason} for key, one in row.items()
            }
            for name, row in found.items()
        },
    }
    publish(writer, args.out, file, values, left=(0, 1), footer=list_refusals(found))
    return 0


def build_tables(
    bench: Benchmark, items: Sequence[TestObject], found: Found, chosen: Sequence[Method]
) -> tuple[Table, ...]:
    """Return a benchmark's tables, ours and published rows; those of lights list each lighting model once."""
    lights = drop_repeated_lights(found, chosen)
    return tuple(
        object_table(
            caption, found if metric == "normal_mae" else lights, metric, present=[item.name for item in items],
            known=bench.known, published=read_published_rows(bench.name, quantity), digits=digits, note=bench.note,
        )
        for caption, quantity, metric, digits in bench.tables
    )  # fmt: skip


def _about(item: TestObject) -> dict[str, Any]:
    height, width = item.mask.shape
    return {
        "images": len(item.true_directions), "pixels": int(item.mask.sum()), "height": height, "width": width,
        "digest": item.digest,
    }  # fmt: skip


def list_refusals(found: Found) -> str:
    """List which methods refused which objects and why, a line each."""
    lines = [
        f"{name} refused {key}: {one.reason}" for name, row in found.items() for key, one in row.items() if one.reason
    ]
    return "".join(f"\n{line}" for line in lines) + ("\n" if lines else "")


def drop_repeated_lights(found: Found, chosen: Sequence[Method]) -> Found:
    """Leave out methods whose lights another method, one without normals, has a row for already."""
    alone = {_lights_of(method) for method in chosen if method.lighting and not method.normals}
    kept = [method.name for method in chosen if not (method.normals and _lights_of(method) in alone)]
    return {name: found[name] for name in kept}


def _lights_of(method: Method) -> tuple[str, str | None, int | None]:
    return method.lighting, method.read_out, method.light_views


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags every benchmark has."""
    parser.add_argument("data", type=Path, help="folder of the benchmark, see docs/guides/evaluate.md")
    parser.add_argument("--methods", action="append", metavar="METHOD,LIGHTS+NORMALS,...",
                        help="commas or repeat, e.g. lcnet+psfcn,learned,classical (default: all)")  # fmt: skip
    parser.add_argument("--models", type=Path, metavar="DIR",
                        help="--out of `sdps train`, whose models are evaluated (default: shipped ones)")  # fmt: skip
    parser.add_argument("--objects", action="append", help="commas or repeat (default: all in the folder)")
    network_flags.add_arguments(parser)
    add_out(parser, Path("out/real"))


def pick_objects(items: Sequence[TestObject], names: list[str] | None) -> list[TestObject]:
    """Return the objects of `--objects`, or all.

    Raises:
        InputError: a name that is not there.
    """
    known = {item.name: item for item in items}
    return [known[name] for name in pick_names("object", names, known)]


def pick_pictured(chosen: Sequence[Method]) -> list[str]:
    """Return the names of the methods to show, and of the first lighting model."""
    names = select.list_shown(list(chosen))
    lights = [method.name for method in chosen if method.lighting and not method.normals][:1]
    return names or lights
