"""`sdps data card`: checksums, Croissant metadata and the card agree with the folder."""

import hashlib
import json
import re
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from data_folders import good_folder, scene_of, sphere_shard, write_folder

from pipelines.cli import main
from pipelines.data.data_card import write_card
from render.planning import provenance
from render.planning.plan_counts import count_plan
from render.planning.provenance import ORIGINAL, UNSTATED, material_terms, mesh_terms
from render.publishing.croissant import CONFORMS_TO
from render.records.manifest import read_manifest


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def nodes(value):
    """Yield every mapping of a JSON document."""
    if isinstance(value, dict):
        yield value
        for item in value.values():
            yield from nodes(item)
    elif isinstance(value, list):
        for item in value:
            yield from nodes(item)


@pytest.fixture
def folder(tmp_path) -> Path:
    good_folder(tmp_path)
    (tmp_path / "config.yaml").write_text(
        "name: tiny\ndescription: A test.\ndata: {seed: 0, size: 32}\nlighting: {steps: 4}\n"
    )
    return tmp_path


def parts_of(folder: Path) -> tuple[dict, str]:
    """Return the front matter and the text of the card."""
    _, front, text = (folder / "DATASET_CARD.md").read_text().split("---\n", 2)
    return yaml.safe_load(front), text


def test_the_card_tells_what_is_there(folder, capsys):
    arguments = ["--name", "Tiny spheres", "--license", "CC-BY-4.0", "--creator", "A. Maker", "--cite", "@misc{tiny}"]
    assert main(["data", "card", str(folder), *arguments, "--url", "https://example.org/tiny"]) == 0
    assert capsys.readouterr().out.split() == [
        str(folder / name) for name in ("DATASET_CARD.md", "croissant.json", "checksums.txt")
    ]
    front, text = parts_of(folder)
    assert front["license"] == "cc-by-4.0" and front["pretty_name"] == "Tiny spheres"
    assert front["size_categories"] == ["n<1K"] and "photometric-stereo" in front["tags"]
    for title in (
        "Composition", "How it was made", "Conventions", "Files", "Splits", "Provenance", "Licences", "Known limits",
        "Validation", "Citation",
    ):  # fmt: skip
        assert f"## {title}\n" in text, title
    for phrase in (
        "| scenes | 4, all rendered |", "x right, y up, z to the camera", "| mitsuba, as the shards say | 3.9.1 |",
        "| root seed | 0 |", sha256(folder / "manifest.jsonl"), "research use", "Irradiance of every light: pi",
        "Not validated", "@misc{tiny}", "This data set: CC-BY-4.0.", "size: 32",
    ):  # fmt: skip
        assert phrase in text, phrase
    assert "steps: 4" not in text  # training is no part of how the data were made
    assert re.search(r"\| numpy, when this card was written \| \d", text)


def test_checksums_are_right_and_checkable(folder):
    write_card(folder)
    lines = (folder / "checksums.txt").read_text().splitlines()
    names = [line.split("  ")[1] for line in lines]
    assert names == ["manifest.jsonl", "config.yaml", *(scene.file for scene in read_manifest(folder))]
    assert all(line.split("  ")[0] == sha256(folder / line.split("  ")[1]) for line in lines)
    assert main(["data", "validate", str(folder)]) == 0
    manifest = folder / "manifest.jsonl"
    manifest.write_text(manifest.read_text().replace('": ', '":  ', 1))
    assert main(["data", "validate", str(folder)]) == 1


def test_croissant_is_whole(folder):
    write_card(folder, "Tiny", "cc-by-4.0", "https://example.org", "A. Maker", "@misc{x}")
    data = json.loads((folder / "croissant.json").read_text())
    assert data["conformsTo"] == CONFORMS_TO == "http://mlcommons.org/croissant/1.1"
    assert data["@type"] == "sc:Dataset" and data["@context"]["cr"] == "http://mlcommons.org/croissant/"
    for key in ("name", "description", "license", "url", "creator", "datePublished", "version", "citeAs"):
        assert data[key], key
    objects = {item["@id"]: item for item in data["distribution"]}
    assert set(objects) == {"manifest.jsonl", "config.yaml", "checksums.txt", "shards"}
    for name, item in objects.items():
        assert item["@type"] == ("cr:FileSet" if name == "shards" else "cr:FileObject") and item["encodingFormat"]
        if name != "shards":
            assert item["sha256"] == sha256(folder / name) and item["contentUrl"] == name
    assert objects["shards"]["includes"] == "shards/*.exr"


def test_croissant_ids_and_terms_resolve(folder):
    write_card(folder)
    data = json.loads((folder / "croissant.json").read_text())
    body = [node for key, value in data.items() if key != "@context" for node in nodes(value)]
    ids = [node["@id"] for node in body if len(node) > 1 and "@id" in node]
    assert len(ids) == len(set(ids))
    references = {node["@id"] for node in body if set(node) == {"@id"}}
    assert references and references <= set(ids)
    context = data["@context"]
    terms = {key for node in body for key in node if not key.startswith("@")}
    own = {"extract", "column", "fileProperty", "jsonPath", "regex", "field", "source", "key", "dataType", "includes"}
    assert own <= terms
    for term in terms - {key for node in body if "@type" not in node and "data" in node for key in node}:
        if term.split("/")[0] in ("splits",):
            continue  # inline records, which the context declares to be plain JSON
        assert term in context or context["@vocab"] == "https://schema.org/", term
    assert all(node["@type"].split(":")[0] in context for node in body if "@type" in node)


def test_croissant_fields_are_those_of_the_manifest(folder):
    """Every field can be read from a line, in the shape it is declared to have."""
    write_card(folder)
    data = json.loads((folder / "croissant.json").read_text())
    line = json.loads((folder / "manifest.jsonl").read_text().splitlines()[0])
    records = {item["@id"]: item for item in data["recordSet"]}
    seen = set()
    for field in records["scenes"]["field"]:
        value = line[field["source"]["extract"]["column"]]
        seen.add(field["source"]["extract"]["column"])
        if "transform" in field["source"]:
            value = value[field["source"]["transform"]["jsonPath"].removeprefix("$.")]
        kind = {"sc:Text": str, "sc:Integer": int, "sc:Float": float}[field["dataType"]]
        shape = [int(side) for side in field.get("arrayShape", "").split(",") if side]
        for side in shape:
            assert side in (-1, len(value))
            value = value[0]
        assert isinstance(value, kind), field["@id"]
        assert bool(shape) == field.get("isArray", False)
    assert seen == set(line)
    assert [row["splits/name"] for row in records["splits"]["data"]] == ["train"]
    pattern = records["shard-files"]["field"][1]["source"]["transform"]["regex"]
    assert re.match(pattern, f"{line['id']}.exr").group(1) == line["id"]


def test_what_is_not_given_is_said(folder, capsys):
    assert main(["data", "card", str(folder)]) == 0
    assert "before publishing, give --license, --url, --creator" in capsys.readouterr().out
    front, text = parts_of(folder)
    assert front["license"] == "unknown" and front["pretty_name"] == "Photometric stereo, tiny"
    assert "not stated; give it with `sdps data card --license`" in text and "## Citation" not in text
    assert not {"url", "creator", "citeAs"} & set(json.loads((folder / "croissant.json").read_text()))


@pytest.mark.parametrize(
    ("license", "expected"),
    [
        ("https://example.org/terms", {"license": "other", "license_link": "https://example.org/terms"}),
        ("Research only", {"license": "other", "license_name": "research-only"}),
    ],
)
def test_licences_that_are_no_identifier(folder, license, expected):
    write_card(folder, license=license)
    assert expected.items() <= parts_of(folder)[0].items()


def test_names_break_no_table(folder):
    shard = sphere_shard(name="a")
    write_folder(folder, [shard], [scene_of(shard, shape="meshes/<i>&|.ply", split="va|l")])
    write_card(folder, "Tiny <b> & | co")
    front, text = parts_of(folder)
    assert front["pretty_name"] == "Tiny <b> & | co" and r"# Tiny &lt;b&gt; &amp; \| co" in text
    assert r"| &lt;i&gt;&amp;\|.ply | 1 | 1 | 1 |" in text and r"| va\|l | 1 |" in text
    assert "| `shards/<id>.exr` |" in text  # code is left as it is
    for rows in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        assert len({len(re.findall(r"(?<!\\)\|", row)) for row in rows.splitlines()}) == 1, rows


def test_the_validation_is_quoted_and_a_stale_one_told(folder):
    assert main(["data", "validate", str(folder)]) == 0
    write_card(folder)
    assert "sound; 4 of 4 shards checked, 0 errors" in parts_of(folder)[1]
    write_folder(folder, [sphere_shard(name="other")])
    write_card(folder)
    assert "The manifest has changed since; validate again." in parts_of(folder)[1]


def test_partly_rendered_and_imported_folders(tmp_path):
    shard = sphere_shard()
    shard = replace(
        shard, provenance={"material": "imported:clay", "imported_from": "diligent", "irradiance": "relative"}
    )
    scenes = [scene_of(shard, id=name, shape="imported:cat", material="imported:clay", split="test") for name in "ab"]
    write_folder(tmp_path, [replace(shard, scene_id="a")], scenes)
    write_card(tmp_path)
    text = parts_of(tmp_path)[1]
    assert "2, 1 of them rendered so far" in text and "imported from another data set" in text
    assert "Irradiance of every light: relative." in text and "Mitsuba" not in text and ORIGINAL in text
    assert "No configuration in this folder" in text and "not in the configuration" in text


def test_terms_of_materials_and_meshes(tmp_path):
    groups = material_terms(["chrome", "patches:1:brass+lambertian:0.5", "gone.yaml", "imported:x"])
    terms = {name: group.terms for group in groups for name in group.materials}
    assert (
        "Matusik" in terms["chrome"] and terms["brass"] == terms["chrome"] and terms["lambertian:0.5"] == "none needed"
    )
    assert terms["gone.yaml"] == UNSTATED and terms["imported:x"] == ORIGINAL
    counts = count_plan([scene_of(sphere_shard(), shape=shape) for shape in ("bunny", "blobby:3", "/home/me/cat.ply")])
    meshes = mesh_terms(counts)
    assert "Stanford" in meshes["bunny"] and "generators" in meshes["blobby"] and meshes["cat.ply"] == UNSTATED


def test_commits_are_only_those_of_our_checkout(tmp_path):
    def git(*arguments):
        subprocess.run(
            ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=b@c", *arguments], check=True
        )

    assert provenance.commit(tmp_path) == ""
    git("init", "-q")
    (tmp_path / "__init__.py").write_text("")
    (tmp_path / "copy").mkdir()
    (tmp_path / "copy" / "__init__.py").write_text("")
    git("add", "__init__.py")
    git("commit", "-q", "-m", "first")
    assert provenance.commit(tmp_path / "copy") == ""  # installed below someone's checkout
    head = provenance.commit(tmp_path)
    assert re.fullmatch(r"[0-9a-f]{40}, modified", head)
    git("add", ".")
    git("commit", "-q", "-m", "second")
    assert re.fullmatch(r"[0-9a-f]{40}", provenance.commit(tmp_path))


def test_bad_input_is_one_line(tmp_path, capsys):
    scenes = good_folder(tmp_path / "good")
    write_folder(tmp_path / "empty", [], scenes)
    for arguments, message in (
        ([str(tmp_path)], "no manifest.jsonl"),
        ([str(tmp_path / "empty")], "no shard is there yet"),
        ([str(tmp_path / "good"), "--license", ""], "--license is empty"),
    ):
        assert main(["data", "card", *arguments]) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1
