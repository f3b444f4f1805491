"""`sdps evaluate report`: one page of everything that was evaluated: tables, figures, pictures, training."""

import argparse
import base64
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from pipelines.evaluate.report.sections import Section, Table, read_sections
from pipelines.shared import pictures
from pipelines.shared.presets import Preset
from render.records.manifest import read_manifest
from render.shared.errors import InputError
from render.shared.files import read_bytes, write_text
from render.shared.templates import fill

CURVES = (
    ("val_direction_mae", "light direction, degrees"),
    ("val_normal_mae", "normals, degrees"),
    ("loss", "training loss"),
)
_TEMPLATE = Path(__file__).with_name("page.html.j2")
_SCRIPT = Path(__file__).with_name("page.js")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps evaluate report`."""
    parser.add_argument("folders", nargs="+", type=Path, help="output folders of evaluations and trainings")
    parser.add_argument("--out", type=Path, default=None, help="the page (default: <first folder>/report.html)")


def main(args: argparse.Namespace) -> int:
    """Collect the sections of the folders into a page."""
    path = args.out or args.folders[0] / "report.html"
    if not any(read_sections(folder) for folder in args.folders):
        raise InputError(f"{args.folders[0]}: nothing evaluated there yet; run one of `sdps evaluate` first")
    render(path, args.folders, "Photometric stereo: evaluation", "")
    sys.stdout.write(f"{path}\n")
    return 0


def write(out: Path, preset: Preset) -> Path:
    """Write `report.html` of a run's folder and return its path."""
    path = out / "report.html"
    render(path, [out], f"SDPS-Net, preset {preset.name}", preset.description)
    return path


def render(path: Path, folders: Sequence[Path], title: str, description: str) -> None:
    """Write a page of the sections, learning curves and training scenes of some folders.

    Args:
        path: The HTML file.
        folders: Where to look; folders without one of them are passed over for it.
        title: Its heading.
        description: A sentence below it.

    Raises:
        InputError: a damaged section, or a page that cannot be written.
    """
    sections = [item for folder in folders for item in read_sections(folder)]
    sections.sort(key=lambda item: (item[1].order, item[1].name))
    training = []
    for folder in folders:
        suffix = f": {folder}" if len(folders) > 1 else ""
        training.append((f"Training{suffix}", "chart", _curves(folder)))
        training.append((f"Some training scenes{suffix}", "sheet", _training_scenes(folder)))
    training = [part for part in training if part[2]]
    headings = [*(section.title for _, section in sections), *(part[0] for part in training)]
    page = fill(
        _TEMPLATE, title=title, description=description, headings=headings, sections=sections, training=training,
        column_styles=column_styles, source=_source, script=_script(sections),
    )  # fmt: skip
    write_text(path, page)


def _script(sections: Sequence[tuple[Path, Section]]) -> str:
    """Return the page's script, or nothing where no picture needs it."""
    strips = (strip for _, section in sections for strip in section.strips)
    needed = any(picture.kind for strip in strips for picture in strip.pictures)
    return _SCRIPT.read_text(encoding="utf-8") if needed else ""


def column_styles(table: Table) -> list[str]:
    """Return the class of each column: sentences wrap, words are set flush left, figures (no class) flush right."""
    columns = zip(*table.rows, strict=True) if table.rows else [()] * len(table.header)
    return [
        "prose" if number in table.prose else "text" if _is_text(cells) else "" for number, cells in enumerate(columns)
    ]


def _is_text(cells: Sequence[str]) -> bool:
    return any(cell[:1].isalpha() for cell in cells) and not any(cell[:1].isdigit() for cell in cells)


def _source(file: Path) -> str:
    data = base64.b64encode(read_bytes(file, "missing; run the evaluation again")).decode()
    return f"data:image/{'jpeg' if file.suffix == '.jpg' else 'png'};base64,{data}"


def _curves(out: Path) -> list[tuple[str, str]]:
    """Plot the learning curves found in a run's folder: (alternative text, data URI) of each."""
    from sdps.publishing.learning_curves import metric_figure, read_metrics

    runs = {}
    for file in sorted((out / "models").glob("*/metrics.jsonl")):
        with suppress(InputError):  # a run that has only begun
            runs[file.parent.name] = read_metrics(file)
    plots = []
    for key, text in CURVES:
        having = {name: rows for name, rows in runs.items() if any(key in row for row in rows)}
        # Losses of different models are different quantities: a plot each.
        groups = [having] if key != "loss" else [{name: rows} for name, rows in having.items()]
        for group in filter(None, groups):
            title = text if len(group) > 1 else f"{next(iter(group))}: {text}"
            plots.append((f"{title} over training", pictures.data_uri(metric_figure(group, key, title))))
    return plots


def _training_scenes(out: Path) -> list[tuple[str, str]]:
    """Show some of the training scenes rendered in a run's folder: (alternative text, data URI), if there are any."""
    try:
        sheet = pictures.scene_sheet(read_manifest(out / "data"), out / "data", count=18)
    except InputError:
        return []
    return [("training scenes: normals and three of the images", pictures.data_uri(sheet))]
