"""The page of everything evaluated: sections on disk, one self-contained file, whole in a browser, phone and print."""

import html
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from pipelines.cli import main
from pipelines.evaluate.report.page import render
from pipelines.evaluate.report.sections import Picture, Section, SectionWriter, Strip, Table, read_sections
from render.shared.errors import InputError

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), ""
)
FLAGS = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
         "--disable-background-networking", "--disable-component-update", "--virtual-time-budget=4000"]  # fmt: skip
needs_browser = pytest.mark.skipif(not CHROMIUM, reason="no Chromium; Debian's package chromium has one")


def chart() -> Figure:
    figure = Figure(figsize=(9, 3))
    figure.add_subplot().plot([0, 1], [1, 0])
    return figure


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A folder with two sections, out of order, one with a wide table, many rows and every kind of picture."""
    cells = tuple(tuple(f"{row * k}.00" for k in range(14)) for row in range(60))
    wide = Table(title="Wide", header=tuple(f"column {k}" for k in range(14)), rows=cells, published=(1,))
    prose = Table(title="Checks", header=("level", "what"), rows=(("note", "a long sentence " * 20),), prose=(1,))
    late = SectionWriter(Section(name="late", title="Second <b>", text="1 < 2", order=2, tables=(wide, prose)))
    pixels = np.zeros((64, 64, 3), np.uint8)
    late.strip("tiles", [(f"tile {number}", pixels) for number in range(7)])
    late.strip("chart", [("a chart", chart())], wide=True)
    late.write(tmp_path)
    SectionWriter(Section(name="early", title="First", text="x", order=1, command="sdps x")).write(tmp_path)
    return tmp_path


def test_sections_come_back_in_order(out: Path) -> None:
    sections = [section for _, section in read_sections(out)]
    assert [section.name for section in sections] == ["early", "late"]
    assert sections[1].strips[1] == Strip(
        title="chart", pictures=(Picture(caption="a chart", file="007.png", wide=True),)
    )
    assert sections[1].tables[0].rows[2][3] == "6.00"
    SectionWriter(Section(name="late", title="again", text="", order=0)).write(out)  # in place of the earlier one
    assert [section.title for _, section in read_sections(out)] == ["again", "First"]
    assert not (out / "report" / "late" / "000.png").exists()


def test_the_page_is_one_file_and_escapes_what_it_shows(out: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["evaluate", "report", str(out)]) == 0
    page = (out / "report.html").read_text()
    assert capsys.readouterr().out.strip() == str(out / "report.html")
    assert page.index("First") < page.index("Second &lt;b&gt;") and "<b>" not in page
    assert page.count("data:image/png;base64,") == 8
    assert not re.search(r"(src|href)=\"(?!data:|#)", page) and "<script" not in page
    assert page.count('class="published"') == 1 and "<code>sdps x</code>" in page


def test_names_break_no_page(tmp_path: Path) -> None:
    name = '<b>&|"'
    table = Table(title=name, header=(name, "n"), rows=((name, "1"),), note=name)
    writer = SectionWriter(Section(name="x", title=name, text=name, command=name, tables=(table,)))
    writer.strip(name, [(name, np.zeros((8, 8, 3), np.uint8))])
    writer.write(tmp_path)
    render(tmp_path / "page.html", [tmp_path], name, name)
    body = (tmp_path / "page.html").read_text().partition("<body>")[2]
    assert body.count(html.escape(name).replace("&quot;", "&#34;")) == 13 and "<b>" not in body and '"">' not in body


def test_learning_curves_are_shown(tmp_path: Path) -> None:
    for name, seconds in (("lcnet", 60.0), ("nenet", 30.0)):
        (tmp_path / "models" / name).mkdir(parents=True)
        rows = [{"step": k, "seconds": seconds * k, "loss": 1 / k, "val_normal_mae": 9 / k} for k in (1, 2, 3)]
        (tmp_path / "models" / name / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (tmp_path / "models" / "begun").mkdir()
    (tmp_path / "models" / "begun" / "metrics.jsonl").write_text("")
    render(tmp_path / "page.html", [tmp_path], "Title", "")
    page = (tmp_path / "page.html").read_text()
    for text in ("normals, degrees", "lcnet: training loss", "nenet: training loss"):
        assert f'alt="{text} over training"' in page
    assert page.count("data:image/png;base64,") == 3 and '<a href="#s0">Training</a>' in page


def test_what_is_missing_is_one_line(out: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["evaluate", "report", str(tmp_path / "nothing")]) == 2
    assert "nothing evaluated there yet" in capsys.readouterr().err
    (out / "report" / "late" / "003.png").unlink()
    assert main(["evaluate", "report", str(out)]) == 2
    assert "003.png" in capsys.readouterr().err
    (out / "report" / "late" / "section.json").write_text('{"name": "late"')
    with pytest.raises(InputError, match=r"section.json.*run the evaluation"):
        read_sections(out)


def in_browser(page: Path, folder: Path, width: int) -> tuple[int, int, int]:
    """Open a page in a frame of a width; return its scroll width, its pictures, and how many of these were drawn."""
    frame = folder / f"frame-{width}.html"
    frame.write_text(
        f'<body><iframe id="f" width="{width}" height="800" frameborder="0" srcdoc="{html.escape(page.read_text())}">'
        "</iframe><script>onload = () => { const d = document.getElementById('f').contentDocument; "
        "const i = [...d.images]; document.title = [d.documentElement.scrollWidth, i.length, "
        "i.filter(p => p.complete && p.naturalWidth > 0).length].join(' '); document.body.innerHTML = ''; }</script>"
    )
    command = [CHROMIUM, *FLAGS, f"--user-data-dir={folder / 'profile'}", "--dump-dom", frame.as_uri()]
    dom = subprocess.run(command, check=True, capture_output=True, text=True, timeout=120).stdout
    return tuple(int(part) for part in re.search(r"<title>(.*?)</title>", dom)[1].split())


@needs_browser
@pytest.mark.parametrize("width", [390, 1200])
def test_a_browser_draws_every_picture_and_nothing_sticks_out(out: Path, tmp_path: Path, width: int) -> None:
    render(out / "page.html", [out], "Title", "About")
    scroll, pictures, drawn = in_browser(out / "page.html", tmp_path, width)
    assert pictures == drawn == 8
    assert scroll <= width


@needs_browser
def test_it_prints(out: Path, tmp_path: Path) -> None:
    render(out / "page.html", [out], "Title", "About")
    path = tmp_path / "page.pdf"
    flags = [*FLAGS, f"--user-data-dir={tmp_path / 'profile'}", f"--print-to-pdf={path}", "--no-pdf-header-footer"]
    subprocess.run([CHROMIUM, *flags, (out / "page.html").as_uri()], check=True, capture_output=True, timeout=120)
    assert path.read_bytes().startswith(b"%PDF") and path.stat().st_size > 5_000
