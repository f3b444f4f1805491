"""`lab bench-infer`: seconds and memory from a folder of photographs to everything `sdps infer` writes.

The photographs are 16-bit pictures of the object of `bench-classical`, which fills the frame but for a margin. Every
run is a process of its own; both kinds of processor are measured (`lab.shared.machines`). With `--many`, a
second folder repeats the pictures up to that number, to show that memory does not grow with them. With `--large`,
seven JPEG files of twelve megapixels are inferred as well, as `sdps infer` does with no flag but for its page, and each
stage is timed; `--only-large` takes others (6000x4000x100).
"""

import argparse
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from lab.bench.bench_scenes import BenchClassicalConfig, add_size, large_object, size_from
from lab.bench.large_photographs import LargeConfig, photograph_large
from lab.shared.machines import hold, kinds, processor
from lab.shared.memory import measure, peak_gib
from pipelines.evaluate.workbench import write_photographs
from pipelines.shared import network_flags
from pipelines.shared.flags import add_models, add_out, split_list
from pipelines.shared.text_tables import render_text
from render.shared.errors import InputError
from render.shared.files import write_json
from render.shared.progress import progress_bar, report_to
from sdps.api import infer, load, plan
from sdps.inference.inference_config import InferenceConfig, inference_config
from sdps.photos import check

SECONDS, GIBIBYTES = 180.0, 3.0
"""The limits of a folder of 96 pictures of 612x512 on two cores."""
STEPS = ("load", "check", "method", "save")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `python -m lab bench-infer`."""
    parser.add_argument("--methods", action="append", help="commas or repeat (default: sdps)")
    add_models(parser)
    network_flags.add_arguments(parser)
    add_size(parser)
    parser.add_argument("--many", type=int, default=0, help="also infer a folder of this many pictures")
    parser.add_argument("--large", action="store_true", help="also infer seven JPEG files of 12 megapixels")
    parser.add_argument("--quick", action="store_true", help="only the large case, at half a megapixel")
    parser.add_argument("--only-large", type=_read_large, default=None, metavar="WIDTHxHEIGHTxPICTURES[xSHARE]",
                        help="only the large case, of this size; SHARE of the frame is object "
                        f"(default: {LargeConfig.share:g})")  # fmt: skip
    add_out(parser, Path("out/bench-infer"))


def main(args: argparse.Namespace) -> int:
    """Write the photographs, infer them with every method, print the tables and write bench_infer.json."""
    config, used = size_from(args), inference_config(args)
    if args.quick or args.only_large:
        return _large(args, args.only_large or LargeConfig(width=800, height=600))
    folders = {args.images: photograph(args.out / "photographs", config)}
    if args.many:
        folders[args.many] = repeat(args.out / "many", folders[args.images], args.many)
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for kind in kinds():
        with hold(kind):
            found[kind] = {
                f"{name}, {count} pictures": measure(_work, folder, name, args.models, used)
                for name in split_list(args.methods) or ["sdps"]
                for count, folder in folders.items()
            }
    write_json(args.out / "bench_infer.json", {"config": vars(config), "networks": used.options(), "kinds": found})
    tables = (table(rows, config, f"{processor()}, {kind}") for kind, rows in found.items())
    sys.stdout.write("\n".join(tables) + f"{args.out / 'bench_infer.json'}\n")
    return _large(args, LargeConfig()) if args.large else 0


def _read_large(text: str) -> LargeConfig:
    """Return the size of large photographs from a flag; argparse refuses anything else."""
    width, height, pictures, share = (*text.lower().split("x"), str(LargeConfig.share), "", "")[:4]
    try:
        return LargeConfig(width=int(width), height=int(height), pictures=int(pictures), share=float(share))
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a size such as 6000x4000x100 or 6000x4000x100x0.1"
        ) from error


def _large(args: argparse.Namespace, config: LargeConfig) -> int:
    """Infer large photographs on this machine as it is; print what every stage took, and write bench_large.json."""
    folder = photograph_large(args.out / "large", config)
    found = measure(_large_work, folder, args.models, inference_config(args))
    write_json(args.out / "bench_large.json", {"config": vars(config), **found})
    if found["error"]:
        raise InputError(found["error"])
    title = (
        f"{processor()}: {config.pictures} JPEG files of {config.width}x{config.height}, {found['pixels']:,} pixels of "
        f"object, {found['method']}; {found['seconds'] / 60:.1f} minutes ({found['cpu_seconds'] / 60:.1f} of work), "
        f"expected {found['expected'] / 60:.1f}; peak {found['peak_gib']:.2f} GiB, expected {found['expected_gib']:.1f}"
    )
    rows = [
        [name, f"{seconds / 60:.2f}", f"{worked / 60:.2f}", "-" if peak is None else f"{peak:.2f}"]
        for name, (seconds, worked, peak) in found["stages"].items()
    ]
    header = ["stage", "minutes", "work", "peak GiB until its end"]
    sys.stdout.write(f"{render_text(title, header, rows)}\n{args.out / 'bench_large.json'}\n")
    return 0


def _large_work(folder: Path, models: Path | None, config: InferenceConfig) -> dict[str, Any]:
    """Do what `sdps infer` does but for its page; return what every stage took, peak_gib, and what was expected."""
    stages: dict[str, tuple[float, float, float | None]] = {}  # seconds, seconds of processors, GiB
    began = last = time.perf_counter(), time.process_time()  # the second tells more where other work runs beside this

    def tell(name: str, _: float) -> None:
        nonlocal last
        now, before = (time.perf_counter(), time.process_time()), stages.get(name, (0.0, 0.0, None))
        stages[name] = before[0] + now[0] - last[0], before[1] + now[1] - last[1], peak_gib()
        last = now

    with report_to(tell), tempfile.TemporaryDirectory() as out:
        photos = load(folder)
        findings = tuple(check(photos))
        expected = plan(photos, models=models, config=config)
        result = infer(photos, models=models, config=config, findings=findings)
        result.save(out)
    return {
        "stages": stages, "seconds": time.perf_counter() - began[0], "cpu_seconds": time.process_time() - began[1],
        "expected": expected.total, "expected_stages": expected.seconds, "peak_gib": peak_gib(),
        "expected_gib": expected.gib, "pixels": int(photos.mask.sum()), "method": result.method,
    }  # fmt: skip


def photograph(folder: Path, config: BenchClassicalConfig) -> Path:
    """Write the pictures and the mask of the bench's object.

    Raises:
        InputError: the folder cannot be written.
    """
    images, mask, *_ = large_object(config)
    scale = 1.0 / float(np.percentile(images[:, mask], 99.5))
    shutil.rmtree(folder, ignore_errors=True)
    return write_photographs(folder, (image * scale for image in progress_bar(images, desc="photograph")), mask)


def repeat(folder: Path, source: Path, count: int) -> Path:
    """Fill a folder with links to the pictures of another one, again and again."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    pictures = sorted(path for path in source.glob("*.png") if path.name != "mask.png")
    (folder / "mask.png").hardlink_to(source / "mask.png")
    for number in range(count):
        (folder / f"{number:04d}.png").hardlink_to(pictures[number % len(pictures)])
    return folder


def _work(folder: Path, method: str, models: Path | None, config: InferenceConfig) -> dict[str, Any]:
    """Do what `sdps infer --no-refine` does; return seconds per step and in all, peak_gib, pixels, precision."""
    marks = [time.perf_counter()]

    def done(result: Any) -> Any:
        marks.append(time.perf_counter())
        return result

    photos = done(load(folder))
    findings = done(tuple(check(photos)))
    result = done(infer(photos, method, models=models, config=config, refine=False, findings=findings))
    with tempfile.TemporaryDirectory() as out:
        done(result.save(out))
    return {
        **dict(zip(STEPS, np.diff(marks).round(2).tolist(), strict=True)),
        "seconds": marks[-1] - marks[0],
        "peak_gib": peak_gib(),
        "pixels": int(photos.mask.sum()),
        "precision": result.estimate.precision or "-",
    }


def table(found: dict[str, dict[str, Any]], config: BenchClassicalConfig, machine: str) -> str:
    """Lay the figures of one kind of machine out as text, with the limits."""
    rows = []
    for name, item in found.items():
        if item["error"]:
            rows.append([name, *["-"] * (len(STEPS) + 3), item["error"]])
            continue
        size = "-" if item["peak_gib"] is None else f"{item['peak_gib']:.2f}"
        kept = item["seconds"] <= SECONDS and (item["peak_gib"] or 0.0) <= GIBIBYTES
        seconds = [f"{item[step]:.1f}" for step in STEPS]
        rows.append([name, item["precision"], *seconds, f"{item['seconds']:.1f}", size, "yes" if kept else "no"])
    pixels = next((item["pixels"] for item in found.values() if not item["error"]), 0)
    title = f"{machine}: pictures of {config.width}x{config.height}, 16 bits, {pixels:,} pixels of object"
    limit = f"within {SECONDS:.0f} s, {GIBIBYTES:.0f} GiB"
    return render_text(title, ["method", "precision", *STEPS, "seconds", "peak GiB", limit], rows)
