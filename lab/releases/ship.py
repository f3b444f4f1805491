"""`lab ship`: put trained weights where commands find them when no folder of runs is named, with cards and curves."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from pipelines.shared import presets
from render.shared.errors import InputError
from render.shared.files import read_text, write_text
from sdps.methods import pretrained
from sdps.training import recipes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `python -m lab ship`."""
    presets.add_common_arguments(parser, default="ship")
    parser.add_argument("--models", default=None, metavar="NAME,...",
                        help="models or combinations (default: the preset's)")  # fmt: skip
    parser.add_argument("--into", type=Path, default=None, help="folder (default: the package's own, assets/weights)")


def main(args: argparse.Namespace) -> int:
    """Write float16 weights, a model card and the learning curve of every model asked for."""
    preset, out = presets.from_arguments(args)
    folder = args.into or pretrained.shipped_folder()
    wanted = args.models.split(",") if args.models else list(preset.train)
    for name, size in ship(recipes.expand(wanted, preset.runs), out, folder):
        sys.stdout.write(f"{folder / name}.safetensors  {size / 1e6:.1f} MB\n")
    return 0


def ship(names: Sequence[str], out: Path, folder: Path) -> list[tuple[str, int]]:
    """Copy the finished weights of runs as float16, each with its card and its metrics.

    All of them are looked for before the first is written.

    Args:
        names: Runs.
        out: Folder of the runs.
        folder: Where `<name>.safetensors`, `<name>.md` and `<name>.jsonl` go.

    Returns:
        Every name and the bytes of its weights.

    Raises:
        InputError: a run that is not finished, or an unwritable disk.
    """
    from sdps.models.checkpoint import load_weights, save_weights
    from sdps.publishing.model_card import write_model_card
    from sdps.training.trainer import METRICS

    files = {name: pretrained.trained_file(out, name) for name in names}
    for name, file in files.items():
        if not file.is_file():
            raise InputError(f"{file}: not there; finish the run with `sdps train --models {name} --out {out}`")
    written = []
    for name, file in files.items():
        kept = folder / f"{name}.safetensors"
        save_weights(kept, load_weights(file), half=True)
        write_model_card(kept.with_suffix(".md"), file, out / "data", shipped=kept)
        write_text(kept.with_suffix(".jsonl"), read_text(file.parent / METRICS))
        written.append((name, kept.stat().st_size))
    return written
