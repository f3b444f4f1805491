"""`sdps report`: one self-contained page of everything that was evaluated: tables, figures, pictures, training."""

import argparse
import base64
import html
import sys
from collections.abc import Sequence
from pathlib import Path
from string import Template

import numpy as np

from pipelines.report.sections import Picture, Section, Strip, Table, read_sections
from pipelines.shared import pictures
from pipelines.shared.presets import Preset
from render.records.manifest import read_manifest
from render.shared.errors import InputError
from render.shared.files import read_bytes, read_jsonl, write_text

CURVES = (
    ("val_direction_mae", "light direction, degrees"),
    ("val_normal_mae", "normals, degrees"),
    ("loss", "training loss"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps report`."""
    parser.add_argument("folders", nargs="+", type=Path, help="output folders of evaluations and trainings")
    parser.add_argument("--out", type=Path, default=None, help="the page (default: <first folder>/report.html)")


def main(args: argparse.Namespace) -> int:
    """Collect the sections of the folders into a page."""
    path = args.out or args.folders[0] / "report.html"
    if not any(read_sections(folder) for folder in args.folders):
        raise InputError(f"{args.folders[0]}: nothing evaluated there yet; run `sdps eval-merltest` or its kin first")
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
    parts = [section_html(section, folder, number) for number, (folder, section) in enumerate(sections)]
    links = [(f"s{number}", section.title) for number, (_, section) in enumerate(sections)]
    for folder in folders:
        suffix = f": {folder}" if len(folders) > 1 else ""
        for heading, body in (("Training", _curves(folder)), ("Some training scenes", _training_scenes(folder))):
            if body:
                links.append((f"s{len(links)}", heading + suffix))
                parts.append(f'<section id="{links[-1][0]}"><h2>{html.escape(links[-1][1])}</h2>{body}</section>')
    template = Template((Path(__file__).parent / "page.html").read_text(encoding="utf-8"))
    menu = "".join(f'<li><a href="#{anchor}">{html.escape(text)}</a></li>' for anchor, text in links)
    page = template.substitute(
        title=html.escape(title), description=html.escape(description), menu=menu, sections="\n".join(parts)
    )
    write_text(path, page)


def section_html(section: Section, folder: Path, number: int) -> str:
    """Render one section."""
    command = f'<p class="note">Made by <code>{html.escape(section.command)}</code></p>' if section.command else ""
    tables = "".join(table_html(table) for table in section.tables)
    strips = "".join(strip_html(strip, folder) for strip in section.strips)
    return (
        f'<section id="s{number}"><h2>{html.escape(section.title)}</h2><p class="note">{html.escape(section.text)}</p>'
        f"{command}{strips + tables if section.pictures_first else tables + strips}</section>"
    )


def table_html(table: Table) -> str:
    """Render one table; rows of published figures are marked by their class."""
    columns = list(zip(*table.rows, strict=True)) or [()] * len(table.header)
    styles = [
        ' class="prose"' if number in table.prose else ' class="text"' if _is_text(cells) else ""
        for number, cells in enumerate(columns)
    ]

    def cells(row: Sequence[str], tag: str) -> str:
        return "".join(f"<{tag}{style}>{html.escape(cell)}</{tag}>" for style, cell in zip(styles, row, strict=True))

    head = cells(table.header, "th")
    body = "".join(
        f'<tr class="{"published" if number in table.published else "ours"}">{cells(row, "td")}</tr>'
        for number, row in enumerate(table.rows)
    )
    note = f'<p class="note">{html.escape(table.note)}</p>' if table.note else ""
    caption = html.escape(table.title)
    long = " long" if len(table.rows) > 40 else ""
    return (
        f'<div class="wide{long}"><table><caption>{caption}</caption><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>{note}"
    )


def _is_text(cells: Sequence[str]) -> bool:
    """Return whether a column holds words rather than figures, and is set flush left."""
    return any(cell[:1].isalpha() for cell in cells) and not any(cell[:1].isdigit() for cell in cells)


def strip_html(strip: Strip, folder: Path) -> str:
    """Render a row of pictures."""
    figures = "".join(_figure(picture, folder) for picture in strip.pictures)
    heading = f"<h3>{html.escape(strip.title)}</h3>" if strip.title else ""
    return f'<div class="scene">{heading}<div class="strip">{figures}</div></div>'


def _figure(picture: Picture, folder: Path) -> str:
    data = base64.b64encode(read_bytes(folder / picture.file, "missing; run the evaluation again")).decode()
    kind = "jpeg" if picture.file.endswith(".jpg") else "png"
    text = html.escape(picture.caption)
    style = "chart" if picture.wide else "tile"
    return (
        f'<figure class="{style}"><img src="data:image/{kind};base64,{data}" alt="{text}">'
        f"<figcaption>{text}</figcaption></figure>"
    )


def _curves(out: Path) -> str:
    """Plot the training curves found in a run's folder."""
    series: dict[str, list[tuple[str, np.ndarray, np.ndarray]]] = {key: [] for key, _ in CURVES}
    for path in sorted((out / "models").glob("*/metrics.jsonl")):
        rows, minutes = [], 0.0
        for row in read_jsonl(path):
            minutes = row.get("seconds", minutes * 60) / 60
            rows.append((minutes, row))
        for key in series:
            points = [(when, row[key]) for when, row in rows if key in row]
            if points:
                series[key].append((path.parent.name, *np.array(points).T))
    figures = []
    for key, text in CURVES:
        # Losses of different models are different quantities: a plot each.
        groups = [series[key]] if key != "loss" else [[one] for one in series[key]]
        for group in groups:
            if group:
                title = text if len(group) > 1 else f"{group[0][0]}: {text}"
                source = pictures.data_uri(pictures.curve_plot(group, title))
                alt = f"{html.escape(title)} over training"
                figures.append(f'<figure class="chart"><img src="{source}" alt="{alt}"></figure>')
    return f'<div class="strip">{"".join(figures)}</div>' if figures else ""


def _training_scenes(out: Path) -> str:
    """Show some of the training scenes rendered in a run's folder."""
    try:
        sheet = pictures.scene_sheet(read_manifest(out / "data"), out / "data", count=18)
    except InputError:
        return ""
    alt = "training scenes: normals and three of the images"
    return f'<img class="sheet" src="{pictures.data_uri(sheet)}" alt="{alt}">'
