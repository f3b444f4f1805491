"""`sdps data validate`: check every shard of a data folder and say what is wrong with which, and what to do."""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path

from pipelines.shared.flags import add_cache_argument
from render.checks.known_checks import CHECKS, ERROR, NOTE, WARNING
from render.checks.shard_checks import Limits
from render.checks.validate import REPORT, Validation, to_report, validate, write_report
from render.records.mirror import display_name, open_folder
from render.shared.config import build, parse_yaml
from render.shared.errors import InputError

SHOWN = 5  # worst offenders per check


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps data validate`."""
    parser.add_argument("folder", type=Path, help="data folder (the one with manifest.jsonl)")
    parser.add_argument("--workers", type=int, default=1, help="processes (default: 1)")
    parser.add_argument("--limit", type=int, default=None, help="check at most this many shards, spread evenly")
    parser.add_argument("--json", action="store_true", help="print the report as JSON instead of the summary")
    about = "move a threshold, e.g. min_area=0.05 (docs/reference/checks.md lists them); may be repeated"
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="LIMIT=VALUE", help=about)
    add_cache_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Check, write `validation.json`, and return 0 when sound, 1 when there are findings of level error."""
    limits = build(Limits, dict(map(_override, args.overrides)))
    with open_folder(args.folder, args.cache_gb) as folder:
        result = validate(folder, limits=limits, workers=args.workers, limit=args.limit)
        write_report(result)
    if args.json:
        sys.stdout.write(json.dumps(to_report(result), indent=2) + "\n")
    else:
        sys.stdout.write("".join(f"{line}\n" for line in summary(result)))
    return 0 if result.sound else 1


def _override(text: str) -> tuple[str, object]:
    """Parse one LIMIT=VALUE."""
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise InputError(f"--set {text}: expected LIMIT=VALUE, e.g. min_area=0.05")
    return name.strip(), parse_yaml(value, f"--set {text}")


def summary(result: Validation) -> Iterator[str]:
    """Yield the lines of the readable summary."""
    where = display_name(result.folder)
    yield f"{where}: {result.checked} shards checked, {result.planned} planned, {result.left} left to render"
    yield ""
    width = max(map(len, CHECKS))
    for check in CHECKS.values():
        scenes = len({finding.where for finding in result.of(check.name)})
        fine = "-" if check.name in result.skipped or not result.checked else "ok"
        state = fine if not scenes else f"{scenes} {check.level}{'s' if scenes > 1 else ''}"
        yield f"  {check.name:<{width}}  {state:<12}  {check.about}"
    for check in CHECKS.values():
        found = result.of(check.name)
        if found:
            yield ""
            yield f"{check.level}: {check.name}; {check.remedy}"
            yield from (f"  {finding.where}: {finding.message}" for finding in found[:SHOWN])
            if len(found) > SHOWN:
                yield f"  and {len(found) - SHOWN} more, see {REPORT}"
    yield ""
    if result.statistics:
        yield from _statistics(result.statistics)
    yield verdict(result)


def _statistics(statistics: dict[str, dict[str, float]]) -> Iterator[str]:
    """Yield a small table of the measures."""
    names = {
        "area": "mask area, share of the frame", "level": "95th percentile of radiance", "peak": "largest radiance",
        "lit": "share of values above 0", "slant": "mean slant of normals, degrees", "bytes": "file size, bytes",
    }  # fmt: skip
    columns = ("min", "p5", "median", "p95", "max")
    yield f"  {'':<32}" + "".join(f"{column:>11}" for column in columns)
    for name, about in names.items():
        yield f"  {about:<32}" + "".join(f"{statistics[name][column]:>11.4g}" for column in columns)
    yield ""


def verdict(result: Validation) -> str:
    """Say in one line whether the folder is sound."""
    counts = [f"{result.count(level)} {level}s" for level in (ERROR, WARNING, NOTE) if result.count(level)]
    if result.checked == 0:
        return "nothing to check: no shard of the manifest is there yet"
    word = "sound" if result.sound else "not sound"
    return f"{word}: {', '.join(counts) if counts else 'no findings'}"
