"""The study of any light: its scenes, its table, and that a run goes on where it was stopped."""

import pytest
from sdps_scenes import write_data

from lab.studies import any_light_study
from lab.studies.any_light_study import COUNTS, LIGHTS, Row, choose, photograph, summarise
from sdps.data.scene_store import SceneStore, list_finished


def test_a_run_goes_on_and_leaves_out_lights_without_scenes(tmp_path, capsys):
    write_data(tmp_path / "data", ("train", "val", "val"), lights=60, size=32)
    arguments = [str(tmp_path / "data"), str(tmp_path / "out"), "--scenes", "2", "--methods", "constant"]
    assert any_light_study.main(arguments) == 0
    first = capsys.readouterr().out
    rows = (tmp_path / "out" / "rows.jsonl").read_text().splitlines()
    assert len(rows) == 3 * 2 * len(COUNTS)  # no scene has near lamps
    assert any_light_study.main(arguments) == 0
    again = capsys.readouterr().out
    assert (tmp_path / "out" / "rows.jsonl").read_text().splitlines() == rows
    assert again in first and "near lamps" in again


def test_scenes_are_photographed_alike_each_time_and_otherwise_under_other_light(tmp_path):
    write_data(tmp_path, ("val",), lights=6, size=32)
    (scene,), store = list_finished(tmp_path, "val"), SceneStore(tmp_path, cache=False)
    one, again, other = (photograph(scene, store, light) for light in ("surroundings", "surroundings", "distant lamps"))
    assert one.images.shape[0] == max(COUNTS)
    assert (one.images == again.images).all() and not (one.images == other.images).all()
    assert not choose([scene], "near lamps", 3) and choose([scene], "distant lamps", 3) == [scene]


def test_the_table_has_means_of_what_a_method_answered():
    light = next(iter(LIGHTS))
    rows = [Row(light, "a", 4, "x", 10.0), Row(light, "b", 4, "x", 20.0), Row(light, "a", 4, "y", None)]
    line = next(line for line in summarise(rows, ["x", "y"]).splitlines() if light in line)
    assert "15.00" in line and line.rstrip(" |").endswith("-")


def test_light_is_as_its_name_says():
    assert LIGHTS["distant lamps"].single == LIGHTS["near lamps"].single == 1.0
    assert LIGHTS["surroundings"].surrounded == pytest.approx(1.0) and LIGHTS["lamps and room"].steady == 1.0
