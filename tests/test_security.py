"""No code runs from a file, no name from a file leads out of a folder, and no text from a file is markup on a page."""

import ast
import json
import re
import tomllib
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from data_folders import scene_of, sphere_shard, write_folder

from pipelines.cli import main
from pipelines.evaluate.report.sections import Picture, Section, SectionWriter
from render.exchange.layouts import LAYOUTS
from render.exchange.layouts.layout_base import legal_name
from render.records.ledger import read_runs
from render.records.manifest import read_failed, read_manifest
from render.shared.config import parse_yaml
from render.shared.errors import InputError
from render.shared.files import parse_json
from sdps.models.checkpoint import load_state

ROOT = Path(__file__).resolve().parent.parent
SOURCES = [path for package in ("render", "sdps", "pipelines") for path in sorted((ROOT / package).rglob("*.py"))]
HOSTILE = ("../../x", "/tmp/x", "..", ".x", "a/b", "a\\b", "a\0b", "a\nb", "", "x" * 300)
MARKUP = '<script>alert(1)</script><img src=x onerror="alert(1)">'


class Ran:
    """Pickles as a call that would leave a file behind."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_nothing_that_runs_code_from_data_is_called(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = {alias.name for alias in node.names} | {getattr(node, "module", None)}
            assert not names & {"pickle", "marshal", "shelve", "dill", "joblib", "cloudpickle"}, node.lineno
        if not isinstance(node, ast.Call):
            continue
        called, keywords = ast.unparse(node.func), {word.arg: ast.unparse(word.value) for word in node.keywords}
        assert called not in ("eval", "exec", "compile", "__import__", "os.system", "os.popen"), node.lineno
        assert keywords.get("shell", "False") == keywords.get("allow_pickle", "False") == "False", node.lineno
        if called == "torch.load":
            assert keywords.get("weights_only") == "True", node.lineno
        if called in ("yaml.load", "yaml.load_all"):
            assert "SafeLoader" in keywords.get("Loader", ""), node.lineno
        assert called not in ("yaml.unsafe_load", "yaml.full_load"), node.lineno
        assert not called.endswith((".extractall", "unpack_archive")), "archives are read member by member"


def test_neither_checkpoints_nor_yaml_run_code(tmp_path: Path) -> None:
    ran = tmp_path / "ran"
    torch.save({"step": Ran(ran)}, tmp_path / "checkpoint.pt")
    with pytest.raises(InputError, match=r"checkpoint.pt: damaged or not a checkpoint .*delete it"):
        load_state(tmp_path / "checkpoint.pt")
    with pytest.raises(InputError, match=r"x\.yaml: line 1 is not valid YAML"):
        parse_yaml(f"!!python/object/apply:os.mkdir [{ran}]", "x.yaml")
    assert not ran.exists()


def test_the_lock_file_agrees_with_the_versions_and_names_no_server() -> None:
    text = (ROOT / "requirements.lock").read_text()
    pinned = re.findall(r"^([\w.-]+)==([^\s;\\]+)", text, re.MULTILINE)
    listed = re.findall(r"^([\w.-]+)==(\S+)", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    versions = {re.sub(r"[._]", "-", name).lower(): version for name, version in listed}
    assert len(pinned) > 70 and all(versions[name] == version for name, version in pinned)
    assert "torch" not in dict(pinned) and "://" not in text
    parts = re.split(r"^(?=[\w.-]+==)", text, flags=re.MULTILINE)[1:]
    assert all("--hash=sha256:" in part for part in parts)
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = [re.match(r"[\w.-]+", line)[0].lower().replace("_", "-")
              for line in (*wanted["dependencies"], *wanted["optional-dependencies"]["test"])]  # fmt: skip
    assert set(needed) - set(dict(pinned)) == {"torch"}


@pytest.mark.parametrize("text", ["1" * 256, f"[{'9' * 400}]", f"a: 0x{'f' * 300}", f"a: {'59:' * 200}1"])
def test_numbers_that_no_float_holds_are_refused_where_they_are_read(text: str) -> None:
    with pytest.raises(InputError, match="a number of more than 255 digits"):
        parse_yaml(f"{' ' * 70}{text}" if ":" not in text else text, "x.yaml")
    with pytest.raises(ValueError):
        parse_json(text)


_TENFOLD = "".join(f"{after}: &{after} [{', '.join(['*' + name] * 10)}]\n" for name, after in pairwise("abcdefgh"))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (f"a: &a [1, 2]\n{_TENFOLD}", "references within it make more than 100,000 values of it"),
        ("a: &a {b: *a}", "nested too deeply, or a reference to what holds it"),
        ("&a [1, [*a]]", "nested too deeply, or a reference to what holds it"),
    ],
)
def test_references_within_yaml_neither_fill_the_memory_nor_go_round(text: str, reason: str) -> None:
    with pytest.raises(InputError, match=rf"x\.yaml: is not valid YAML \({reason}\)"):
        parse_yaml(text, "x.yaml")


def test_no_two_places_of_yaml_share_a_value() -> None:
    read = parse_yaml("a: &a {x: [1, &b {y: 2}]}\nc: *a\nd: [*b, {<<: *a, z: 3}]\ne: &e text\nf: *e", "x.yaml")
    assert read == {"a": {"x": [1, {"y": 2}]}, "c": {"x": [1, {"y": 2}]}, "e": "text", "f": "text",
                    "d": [{"y": 2}, {"x": [1, {"y": 2}], "z": 3}]}  # fmt: skip
    read["a"]["x"][1]["y"] = 5
    read["d"][1]["x"].append(7)
    assert read["c"] == {"x": [1, {"y": 2}]} and read["d"][0] == {"y": 2} and read["a"]["x"] == [1, {"y": 5}]


def test_half_a_surrogate_pair_is_no_text() -> None:
    assert parse_json(r'"\ud83d\ude00"') == "\U0001f600"
    with pytest.raises(ValueError, match="surrogate"):
        parse_json(r'{"a": "\ud83d"}')


def test_a_damaged_validation_is_left_out_of_card_and_preview(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_folder(tmp_path, [sphere_shard(count=3)])
    (tmp_path / "validation.json").write_text(
        '{"checked": Infinity, "planned": 1, "errors": 0, "warnings": 0, "checks": []}'
    )
    for command in ("card", "preview"):
        assert main(["data", command, str(tmp_path)]) == 0, capsys.readouterr().err


def test_damaged_lines_of_ledgers_count_as_torn(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    scenes = write_folder(tmp_path, [sphere_shard(count=3)])
    (tmp_path / "log").mkdir()
    good = {"id": "a", "spec": scenes[0].digest(), "bytes": 5, "seconds": 1.0, "time": "2026-01-01T00:00:00+00:00"}
    bad = [{"time": "2026-01-01"}, {"time": "x"}, {"seconds": "x"}, {"seconds": None}, {"bytes": []}]
    lines = [json.dumps(good | change) for change in bad]
    (tmp_path / "log" / "done-x-1-1.jsonl").write_text("\n".join([*lines, json.dumps(good), ""]))
    failed = [{"id": "a", "time": "2026", "reason": ["x"]}, {"id": "a", "time": "2026"}]
    (tmp_path / "failed.jsonl").write_text("".join(json.dumps(line) + "\n" for line in failed))
    assert read_runs(tmp_path) == [[good]] and read_failed(tmp_path) == {}
    assert main(["data", "status", str(tmp_path)]) == 0, capsys.readouterr().err


@pytest.mark.parametrize("name", HOSTILE)
def test_a_manifest_names_no_file_outside_its_folder(name: str, tmp_path: Path) -> None:
    shard = sphere_shard(count=3)
    write_folder(tmp_path, [shard])
    line = (tmp_path / "manifest.jsonl").read_text()
    assert line.count('"id": "a"') == 1
    (tmp_path / "manifest.jsonl").write_text(line.replace('"id": "a"', f'"id": {json.dumps(name)}'))
    with pytest.raises(InputError, match=r"manifest.jsonl: line 1.*id: .* cannot name a file"):
        read_manifest(tmp_path)


@pytest.mark.parametrize("name", HOSTILE)
def test_exported_places_stay_in_the_tree(name: str) -> None:
    scene = scene_of(sphere_shard(count=3), shape=name or "x", material=name or "x")
    for layout in LAYOUTS.values():
        (folder,) = layout.name_folders([scene]).values()
        assert re.fullmatch(r"((Images|pmsData)/)?[A-Za-z0-9-]+(/[A-Za-z0-9-]+|\.data)?", folder)
    assert re.fullmatch(r"[A-Za-z0-9-]{1,80}", legal_name(name))


@pytest.mark.parametrize("name", HOSTILE)
def test_a_report_embeds_no_file_from_elsewhere(name: str) -> None:
    with pytest.raises(InputError, match="is not the name of a picture"):
        Picture(caption="x", file=name)


@pytest.mark.parametrize("entry", ["../x", "x/..", "./x", "/x", "x/"])
def test_an_imported_list_names_no_sample_outside_its_tree(entry: str, tmp_path: Path, capsys) -> None:
    (tmp_path / "tree").mkdir()
    (tmp_path / "tree" / "train_mtrl.txt").write_text(f"{entry}\n")
    assert main(["data", "import", str(tmp_path / "tree"), "--layout", "psfcn", "--out", str(tmp_path / "out")]) != 0
    assert "is not '<shape>/<material>'" in "".join(capsys.readouterr())


def test_no_page_or_card_takes_names_for_markup(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Scene, shape and material names, reasons of failures and names in sections, through every page there is."""
    shard = sphere_shard(name="<b>a", count=4)
    shard = replace(shard, provenance=shard.provenance | {"material": MARKUP, "mitsuba": MARKUP})
    write_folder(tmp_path, [shard], [scene_of(shard, shape=MARKUP, material=MARKUP)])
    failed = json.dumps({"id": "<b>a", "time": "2026", "reason": MARKUP, "seed": 1}) + "\n"
    (tmp_path / "failed.jsonl").write_text(failed)
    (tmp_path / "config.yaml").write_text(f"name: '{MARKUP}'\ndescription: '{MARKUP}'\n")
    for command in ("preview", "card"):
        assert main(["data", command, str(tmp_path)]) == 0, capsys.readouterr().err
    section = Section(name="x", title=MARKUP, text=MARKUP, command=MARKUP)
    writer = SectionWriter(section)
    writer.strip(MARKUP, [(MARKUP, np.zeros((8, 8, 3), np.uint8))])
    writer.write(tmp_path)
    assert main(["report", str(tmp_path)]) == 0
    pages = [path for path in tmp_path.rglob("*") if path.suffix in (".html", ".md")]
    assert {path.name for path in pages} >= {"preview.html", "report.html"} and len(pages) >= 3
    for path in pages:
        shown = re.sub(r"```.*?```|`[^`\n]*`|\A---\n.*?\n---\n", "", path.read_text(), flags=re.DOTALL)
        shown = shown if path.suffix == ".md" else without_ours(path.read_text())
        assert "<script" not in shown and "<img src=x" not in shown and "<b>a" not in shown, path.name


def without_ours(page: str) -> str:
    """Return a page without the one script it may have, which is a file of ours, and the data of that script."""
    for script in ("pipelines/data/preview.js", "pipelines/evaluate/report/page.js"):
        page = page.replace(f"<script>\n{(ROOT / script).read_text()}</script>", "")
    return re.sub(r'<script type="application/json" id="stages">[^<>]*</script>', "", page)


def test_the_test_of_sources_sees_what_it_should() -> None:
    assert len(SOURCES) > 200
