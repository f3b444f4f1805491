"""`sdps curves`: learning curves of runs over each other, and where they are heading."""

import argparse
import sys
from pathlib import Path

import numpy as np

from pipelines.shared.text_tables import number, render_text
from render.shared.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps curves`."""
    parser.add_argument("runs", nargs="+", type=Path, help="folders of runs, or metrics files (.jsonl)")
    parser.add_argument("--value", default="val_direction_mae_expectation", metavar="METRIC",
                        help="what to draw (default: val_direction_mae_expectation)")  # fmt: skip
    parser.add_argument("--between", default="", metavar="FIRST:LAST",
                        help="steps a power law is fitted to, at one learning rate (default: no fit)")  # fmt: skip
    parser.add_argument("--at", type=int, action="append", default=None, metavar="STEP",
                        help="step the law is asked for; repeat for more")  # fmt: skip
    parser.add_argument("--picture", type=Path, default=Path("out/curves.png"), help="PNG (default: out/curves.png)")


def main(args: argparse.Namespace) -> int:
    """Draw the curves, print the last value of each run and, where asked for, the law's."""
    from sdps.publishing.extrapolation import fit_power_law, predicted_range
    from sdps.publishing.learning_curves import compare_curves, read_metrics, series

    files, span, asked = named(args.runs), between(args.between), args.at or []
    rows, fits = [], {}
    for name, file in files.items():
        steps, values = series(read_metrics(file), args.value)
        if not len(steps):
            continue
        cells = [name, f"{steps[-1]:.0f}", number(values[-1])]
        if span is not None:
            inside = (steps >= span[0]) & (steps <= span[1])
            law = fit_power_law(steps[inside], values[inside])
            far = np.geomspace(steps[0], max([*asked, steps[-1]]), 100)
            fits[name] = far, np.asarray(law.at(far))
            cells.append(f"{law.floor:.3g} + {law.scale:.3g} step^-{law.exponent:.2f}")
            for at in asked:
                low, middle, high = predicted_range(steps[inside], values[inside], at)
                cells.append(f"{number(middle)} ({number(low)} to {number(high)})")
        rows.append(cells)
    compare_curves(files, args.picture, args.value, fits)
    header = ["run", "last step", args.value, *([] if span is None else ["fit", *(f"at {k:,}" for k in asked)])]
    sys.stdout.write(render_text("", header, rows) + f"{args.picture}\n")
    return 0


def named(runs: list[Path]) -> dict[str, Path]:
    """Return the metrics file of every run by a name for it.

    Raises:
        InputError: two runs of one name.
    """
    found: dict[str, Path] = {}
    for run in runs:
        file = run / "metrics.jsonl" if run.suffix != ".jsonl" else run
        name = file.parent.name if file.name == "metrics.jsonl" else file.stem
        if name in found:  # the same model of two experiments
            name = "/".join(file.parent.parts[-3:])
        if name in found or file.resolve() in map(Path.resolve, found.values()):
            raise InputError(f"{run}: given twice")
        found[name] = file
    return found


def between(text: str) -> tuple[float, float] | None:
    """Read FIRST:LAST.

    Raises:
        InputError: anything else.
    """
    if not text:
        return None
    first, _, last = text.partition(":")
    if not (first.isdecimal() and last.isdecimal() and int(first) < int(last)):
        raise InputError(f"--between takes two steps such as 1000:8000, got {text!r}")
    return float(first), float(last)
