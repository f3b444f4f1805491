"""`lab shipped-results`: what the shipped weights were measured to do, as Markdown in their folder and in the docs.

Reads the `results.json` of `sdps eval-merltest` and, where there is one, of `sdps eval-diligent` in one folder that
holds no models of its own, so that every learned row is a shipped one. `make shipped-results` runs all three.
"""

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from render.records.shards import file_hash
from render.shared.errors import InputError
from render.shared.files import read_json, read_text, write_text
from render.shared.templates import fill
from sdps.methods import pretrained

BEGIN, END = "<!-- shipped results: begin -->", "<!-- shipped results: end -->"
RESULTS = "RESULTS.md"
NOT_TRAINED, ABSENT, OURS = "not trained", "-", "ours"
_COMPARED = ("SDPS-Net", "LCNet_reg + NENet", "UPS-FCN deep+mask", "LCNet", "LCNet_reg")
"""Published rows of DiLiGenT that are shown with ours."""

_PAPERS_OWN = ("A0", "B1")
_TEMPLATE = Path(__file__).with_name("shipped_results.md.j2")

Table = Mapping[str, Sequence[Any]]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `python -m lab shipped-results`."""
    parser.add_argument("--out", type=Path, default=Path("out/shipped"),
                        help="--out of eval-merltest and eval-diligent (default: out/shipped)")  # fmt: skip
    parser.add_argument("--into", type=Path, default=None, help="folder (default: the package's own, assets/weights)")
    parser.add_argument("--page", type=Path, default=None,
                        help="page to write between its marks, such as docs/results.md (default: none)")  # fmt: skip
    parser.add_argument("--readme", dest="page", type=Path, default=None, help=argparse.SUPPRESS)  # its name in 0.1


def main(args: argparse.Namespace) -> int:
    """Write <into>/RESULTS.md, and the same tables into the page."""
    text = results_text(args.out)
    file = (args.into or pretrained.shipped_folder()) / RESULTS
    # A page without marks is refused before anything is written.
    page = replace_between_marks(args.page, text) if args.page else None
    write_text(file, f"# What the shipped weights do\n\n{text}")
    if page is not None:
        write_text(args.page, page)
    sys.stdout.write(f"{file}\n")
    return 0


def results_text(out: Path) -> str:
    """Return the tables of an evaluation of shipped weights, and what repeats it.

    Raises:
        InputError: no evaluation of MERL-Test there, or one of weights that are not the shipped ones.
    """
    merltest = _read(out / "eval" / "results.json", "run `make shipped-results`")
    real = out / "diligent" / "results.json"
    diligent = _read(real, "run `make shipped-results DATA=...`") if real.is_file() else {}
    return fill(
        _TEMPLATE,
        config=merltest["config"],
        scenes=merltest["scenes"],
        networks=merltest["networks"],
        merltest={title: _keep_measured(table) for title, table in merltest["tables"].items()},
        real=diligent,
        diligent={title: _keep_compared(table) for title, table in diligent.get("tables", {}).items()},
        weights=_digests({**merltest["weights"], **diligent.get("weights", {})}.values()),
    )


def _read(path: Path, remedy: str) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(f"{path}: no such results; {remedy}")
    return read_json(path, f"delete it and {remedy}")


def _keep_measured(table: Table) -> Table:
    """Leave out the paper's rows that no shipped model belongs to, but for its own networks."""
    rows = []
    for row in table["rows"]:
        if not all(cell.startswith(NOT_TRAINED) for cell in row[2:]):
            rows.append(row)
        elif row[0] in _PAPERS_OWN:
            rows.append([*row[:2], *(cell.removeprefix(NOT_TRAINED).strip() for cell in row[2:])])
    return {"header": table["header"], "rows": rows}


def _keep_compared(table: Table) -> Table:
    """Keep our rows and those of the paper's own method, and the objects that were there."""
    rows = [row for row in table["rows"] if row[1] == OURS or row[0] in _COMPARED]
    ours = [row for row in rows if row[1] == OURS]
    kept = [
        place
        for place, name in enumerate(table["header"])
        if place < 2 or (any(row[place] != ABSENT for row in ours) and name != "this object")
    ]
    return {"header": [table["header"][k] for k in kept], "rows": [[row[k] for k in kept] for row in rows]}


def _digests(files: Iterable[str]) -> dict[str, str]:
    """Return the beginning of each weights file's SHA-256, so that the tables cannot outlive them unnoticed.

    Raises:
        InputError: weights from elsewhere.
    """
    folder = pretrained.shipped_folder().resolve()
    digests = {}
    for file in sorted(map(Path, files)):
        if file.resolve().parent != folder:
            raise InputError(f"{file}: evaluated with the shipped weights; use an --out without trained models")
        digests[file.name] = file_hash(file)[:12]
    return digests


def replace_between_marks(page: Path, text: str) -> str:
    """Return a page's text with what stands between the marks replaced.

    Raises:
        InputError: a page that cannot be read, or without both marks.
    """
    before = read_text(page)
    head, begin, rest = before.partition(BEGIN)
    _, end, tail = rest.partition(END)
    if not begin or not end:
        raise InputError(f"{page}: has no marks {BEGIN!r} and {END!r}; put them where the tables belong")
    return f"{head}{BEGIN}\n{text}{END}{tail}"
