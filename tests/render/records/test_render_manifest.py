"""Reading a manifest: quickly where lines are as written by us, strictly where they are not."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from render.records.manifest import MANIFEST, SceneSpec, View, read_failed, read_manifest, write_manifest
from render.shared.config import to_plain
from render.shared.errors import InputError


def line(**changes: object) -> SceneSpec:
    rng = np.random.default_rng(3)
    lights = tuple(tuple(row) for row in rng.normal(size=(5, 3)).tolist())
    plain = {"id": "a", "seed": 0, "split": "train", "shape": "sphere", "material": "chrome", "view": View(scale=0.7),
             "lights": lights, "size": 32, "spp": 4, "bounces": 1}  # fmt: skip
    return SceneSpec(**plain | changes)


@pytest.fixture
def scenes() -> list[SceneSpec]:
    first = line()
    return [
        first,
        replace(first, id="b", material="stripes:0:chrome+steel"),
        replace(first, id="c", view=View(offset=(0.1, -0.2))),
        replace(first, id="d", size=(24, 32)),
        replace(first, id="e", lights=((0.0, 0.0, 1.0),)),
        replace(first, id="f", lights=()),
        replace(first, id="g", seed=1),
    ]


def rewrite(folder: Path, number: int, **changes: object) -> None:
    """Alter fields of a line, counted from 1."""
    rows = [json.loads(row) for row in (folder / MANIFEST).read_text().splitlines()]
    rows[number - 1] |= changes
    (folder / MANIFEST).write_text("".join(json.dumps(row) + "\n" for row in rows))


def test_lines_survive_being_written_and_read(scenes, tmp_path):
    write_manifest(tmp_path, scenes)
    read = read_manifest(tmp_path)
    assert read == scenes
    assert [scene.digest() for scene in read] == [scene.digest() for scene in scenes]
    assert all(isinstance(scene.lights, tuple) and isinstance(scene.view, View) for scene in read)
    assert read[0].lights is read[1].lights  # two materials of a view need its lights once


def test_digest_is_that_of_the_line_as_sorted_json(scenes):
    for scene in scenes:
        text = json.dumps(scene.row(), sort_keys=True)
        assert scene.digest() == hashlib.sha256(text.encode()).hexdigest()
    assert len({scene.digest() for scene in scenes}) == len(scenes)


def test_lights_written_by_hand_are_converted(scenes, tmp_path):
    write_manifest(tmp_path, scenes)
    rewrite(tmp_path, 2, lights=[[0, 0, 1], ["6e-1", 0, 0.8]])
    assert read_manifest(tmp_path)[1].lights == ((0.0, 0.0, 1.0), (0.6, 0.0, 0.8))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lights": [[0.0, 1.0]]}, r"line 2\.lights: expected 3 values"),
        ({"lights": [[0.0, 0.0, 1.0], [0.0, 0.0, "up"]]}, r"line 2\.lights: expected float, got 'up'"),
        ({"lights": [[0.0, 0.0, True]]}, r"line 2\.lights: expected float, got True"),
        ({"lights": "above"}, r"line 2\.lights: expected"),
        ({"lights": [0.0, 0.0, 1.0]}, r"line 2\.lights: expected 3 values"),
        ({"material": ["chrome"]}, r"line 2\.material: expected str"),
        ({"id": None}, r"line 2\.id: expected str"),
        ({"bounces": "many"}, r"line 2\.bounces: expected int"),
        ({"view": {"scale": 0.0}}, r"line 2\.view\.view\.scale|view\.scale must be"),
        ({"view": {"scael": 1.0}}, r"line 2\.view\.scael'; did you mean"),
        ({"colour": 1}, r"line 2\.colour'"),
    ],
)
def test_a_wrong_line_is_named_with_its_field(scenes, tmp_path, changes, message):
    write_manifest(tmp_path, scenes)
    rewrite(tmp_path, 2, **changes)
    with pytest.raises(InputError, match=message):
        read_manifest(tmp_path)


def test_a_missing_field_and_a_line_that_is_no_object_are_named(scenes, tmp_path):
    rows = [to_plain(scene) for scene in scenes[:2]]
    del rows[1]["lights"]
    (tmp_path / MANIFEST).write_text("".join(json.dumps(row) + "\n" for row in rows))
    with pytest.raises(InputError, match=r"line 2: missing key 'lights'"):
        read_manifest(tmp_path)
    (tmp_path / MANIFEST).write_text(json.dumps(rows[1] | {"lights": []}) + "\n[1]\n")
    with pytest.raises(InputError, match="line 2: expected a section"):
        read_manifest(tmp_path)


def test_failures_are_read_past_a_torn_line(tmp_path):
    assert read_failed(tmp_path) == {}
    whole = [{"id": "a", "time": str(number), "reason": "x"} for number in range(2)]
    (tmp_path / "failed.jsonl").write_text("".join(json.dumps(row) + "\n" for row in whole) + '{"id": "b", "ti')
    assert read_failed(tmp_path) == {"a": whole}
