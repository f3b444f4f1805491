"""Running a plan with several processes: failures stay with their scene, and nothing depends on how work is shared.

Most tests run processes that only pretend to render, so that they start at once and fail on command.
"""

import json
import os
import signal
import threading
import time
from dataclasses import replace
from multiprocessing import active_children
from pathlib import Path

import pytest
from pretend_renderer import pretend, stillborn

from render.planning import budget, chunks
from render.planning.plan import DataConfig, plan
from render.records import ledger
from render.records.ledger import Ledger
from render.records.manifest import SceneSpec, View
from render.records.shards import file_hash
from render.running.supervisor import RunOptions, render_supervised
from render.running.worker_pool import LocalPool
from render.shared import temporary
from render.shared.errors import InputError
from render.shared.temporary import temporary_path

LIGHTS = ((0.0, 0.0, 1.0), (0.6, 0.0, 0.8))


def planned(materials: list[list[str]]) -> list[SceneSpec]:
    """Return a plan of one view per inner list, each of a shape of its own, with these materials."""
    return [
        SceneSpec(
            id=f"s{shape}-m{slot}", seed=shape, split="train", shape=f"blobby:{shape}", material=material, view=View(),
            lights=LIGHTS, size=16, spp=4, bounces=0,
        )
        for shape, row in enumerate(materials)
        for slot, material in enumerate(row)
    ]  # fmt: skip


def run(scenes: list[SceneSpec], folder: Path, serve=pretend, **options):
    return render_supervised(scenes, folder, RunOptions(**{"workers": 1} | options), serve=serve)


def files(folder: Path) -> set[str]:
    return {path.name for path in (folder / "shards").iterdir()} if (folder / "shards").exists() else set()


def failures(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "failed.jsonl").read_text().splitlines()]


class Waiting:
    """A pool that waits for a while and then has done its only scene."""

    slots = count = 1
    chunk_bytes, note = 0, ""

    def submit(self, chunks) -> None:
        self.notes = ["waits for workers"] * 3 + ["", ""]

    def busy(self) -> bool:
        return bool(self.notes)

    def poll(self) -> list:
        self.note = self.notes.pop(0)
        return []

    def close(self) -> None:
        pass


def test_what_a_pool_waits_for_is_shown_once_and_taken_back(tmp_path, capsys):
    render_supervised(planned([["ok"]]), tmp_path, pool=Waiting())
    said = capsys.readouterr().err
    assert said.count("waits for workers") == 1 and "waits" not in said.rpartition("render:")[2]


# ---- Isolation -------------------------------------------------------------------------------------


def test_failing_hanging_and_dying_scenes_cost_only_themselves(tmp_path):
    scenes = planned([["ok", "raise", "ok"], ["ok", "hang"], ["die", "ok"], ["ok", "quit"]])
    (tmp_path / "shards").mkdir()
    summary = run(scenes, tmp_path, timeout=3)  # which no other scene takes, however busy the machine
    assert (summary.scenes, summary.done, len(summary.failed), summary.skipped) == (9, 5, 4, 0)
    assert files(tmp_path) == {f"{scene.id}.exr" for scene in scenes if scene.material == "ok"}
    lines = {line["material"]: line for line in failures(tmp_path)}
    assert lines["raise"]["reason"] == "ValueError: no" and "Traceback" in lines["raise"]["traceback"]
    assert lines["hang"]["reason"] == "timed out after 3 s"
    assert "in pretend" in lines["hang"]["traceback"]  # the fault handler tells where it hung
    assert lines["die"]["reason"] == "worker died, signal 11"
    assert lines["quit"]["reason"] == "worker died, exit code 3"
    assert {"id", "seed", "shape", "material", "reason", "traceback", "seconds", "attempt", "time"} == set(lines["die"])
    assert not active_children()

    again = run(scenes, tmp_path)  # nothing left to try: no process is started
    assert (again.done, again.skipped, again.lines) == (5, 4, [])
    mended = [replace(scene, material="ok") for scene in scenes if scene.material != "ok"]
    assert run(mended[:1], tmp_path).skipped == 1
    retried = run(mended[:1], tmp_path, retry_failed=True)
    assert (retried.done, len(retried.lines), retried.skipped) == (1, 1, 0)
    assert run(mended[:1], tmp_path).skipped == 0


def test_processes_that_send_nonsense_cost_only_their_scenes(tmp_path):
    bad = ["garbage", "other type", "other scene", "other plan", "torn line", "no shard"]
    scenes = planned([["ok", *bad[:3], "ok"], [*bad[3:], "ok"]])
    (tmp_path / "shards").mkdir()
    summary = run(scenes, tmp_path)
    assert (summary.done, [line["id"] for line in summary.lines]) == (3, ["s0-m0", "s0-m4", "s1-m3"])
    assert [line["material"] for line in failures(tmp_path)] == bad
    assert {line["reason"] for line in failures(tmp_path)} == {"worker sent a damaged or wrong message"}
    assert not active_children()


def test_a_process_that_dies_before_it_begins_costs_the_first_view_of_its_chunk(tmp_path):
    summary = run(planned([["die unbegun", "ok"], ["ok"]]), tmp_path)
    assert (summary.done, len(summary.failed)) == (1, 2)
    assert failures(tmp_path)[0]["reason"] == "worker died, exit code 4"


def test_attempts_are_counted(tmp_path):
    scenes = planned([["raise"]])
    run(scenes, tmp_path)
    run(scenes, tmp_path, retry_failed=True)
    assert [line["attempt"] for line in failures(tmp_path)] == [1, 2]


def test_what_concerns_the_whole_run_stops_it(tmp_path):
    scenes = planned([["ok", "ok", "full", "ok"]])
    with pytest.raises(InputError, match=r"No space left on device\) \(2 scenes of this run are finished and kept"):
        run(scenes, tmp_path)
    assert files(tmp_path) == {"s0-m0.exr", "s0-m1.exr"} and not (tmp_path / "failed.jsonl").exists()
    with pytest.raises(InputError, match=r"did not start \(worker died, exit code 7\): LLVM ERROR.*sdps doctor"):
        run(scenes, tmp_path, serve=stillborn)
    with pytest.raises(InputError, match=r"the first 20 scenes all failed.*ValueError: no"):
        run(planned([["raise"] * 30]), tmp_path / "other")
    (tmp_path / "third").mkdir()
    (tmp_path / "third" / "shards").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        run(scenes, tmp_path / "third")
    assert not active_children()


def test_disk_is_watched_before_and_while_running(tmp_path, monkeypatch):
    scenes = planned([["ok"] * 6])
    with pytest.raises(InputError, match=r"needs about .* kept free, but only .* are free"):
        run(scenes, tmp_path, keep_free=10**18)
    assert not files(tmp_path)
    answers = iter([10**12, 10**12, 10**12])
    monkeypatch.setattr(budget, "free_bytes", lambda folder: next(answers, 10**6))
    with pytest.raises(InputError, match=r"less than 1\.0 GB of disk are free; 3 scenes of this run are finished"):
        run(scenes, tmp_path, keep_free=10**9)
    assert len(files(tmp_path)) >= 3
    monkeypatch.undo()
    assert run(scenes, tmp_path).done == 6


def test_interrupt_stops_all_processes_and_keeps_what_is_finished(tmp_path, monkeypatch):
    scenes, add = planned([["ok"], ["ok", "hang"]]), Ledger.add

    def stop(ledger: Ledger, line: dict) -> None:
        add(ledger, line)
        if line["id"] == "s1-m0":
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(Ledger, "add", stop)
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt):
        render_supervised(scenes, tmp_path, RunOptions(workers=1), serve=pretend)
    assert files(tmp_path) == {"s0-m0.exr", "s1-m0.exr"} and not active_children()
    assert signal.getsignal(signal.SIGTERM) is before and not (tmp_path / "failed.jsonl").exists()


# ---- Sharing the work ------------------------------------------------------------------------------


def test_shares_of_a_manifest_are_disjoint_and_whole(tmp_path):
    scenes = planned([["ok", "ok"]] * 5)
    parts = [run(scenes, tmp_path, part=part, parts=3) for part in (1, 2, 3)]
    assert [part.scenes for part in parts] == [4, 4, 2]
    assert all(part.done == part.scenes for part in parts)
    assert len(files(tmp_path)) == 10 and run(scenes, tmp_path).lines == []
    assert len(list((tmp_path / "log").glob("done-*.jsonl"))) == 3


def test_workers_are_replaced_and_all_of_them_are_used(tmp_path):
    scenes = planned([["ok"]] * 4)
    summary = run(scenes, tmp_path, recycle=2)
    assert summary.done == 4 and {line["worker"] for line in summary.lines} == {0, 1}
    assert summary.stage_shares()["render"] > 0 and summary.workers == 1


def test_chunks_are_whole_views_of_one_shape():
    scenes = plan(DataConfig(families={"blobby": 2}, views=33, materials_per_view=2, light_count=1))
    wanted = {scene.id for scene in scenes[1:]}
    pieces = chunks.cut(scenes, wanted, workers=1)
    assert max(len(piece.groups) for piece in pieces) == chunks.VIEWS_PER_CHUNK
    assert [scene for piece in pieces for scene in piece.scenes()] == scenes[1:]
    assert all(len(group) == 2 and group[0].shape == piece.shape for piece in pieces for group in piece.groups)
    assert len(chunks.cut(scenes[:8], wanted, workers=8)) == 4
    left = pieces[0].without([scenes[1].id, scenes[2].id])
    assert left.scenes() == pieces[0].scenes()[2:] and len(left.groups) == len(pieces[0].groups) - 1
    assert pieces[0].without([scene.id for scene in scenes]) is None


@pytest.mark.parametrize(
    ("options", "message"),
    [({"part": 3, "parts": 2}, "shard"), ({"part": 0}, "shard"), ({"timeout": -1}, "timeout"),
     ({"workers": -2}, "workers"), ({"recycle": 0}, "recycle"), ({"timeout": float("nan")}, "timeout")],
)  # fmt: skip
def test_options_are_checked(options, message):
    with pytest.raises(InputError, match=message):
        RunOptions(**options)


# ---- What is finished ------------------------------------------------------------------------------


def test_resume_trusts_the_ledger_only_where_size_and_line_agree(tmp_path):
    scenes = planned([["ok"] * 4])
    run(scenes, tmp_path)
    assert ledger.survey(tmp_path, scenes).done == {scene.id for scene in scenes}
    (tmp_path / scenes[0].file).write_bytes(b"short")
    (tmp_path / scenes[1].file).unlink()
    changed = [*scenes[:2], replace(scenes[2], spp=8), scenes[3]]
    assert ledger.survey(tmp_path, changed).done == {scenes[3].id}
    assert not ledger.survey(tmp_path, scenes, verify=True).done  # what the pretenders wrote is no shard
    (log,) = (tmp_path / "log").iterdir()
    log.write_text(log.read_text()[:-20])  # torn by a crash
    assert scenes[3].id not in ledger.survey(tmp_path, scenes).done


def test_half_written_shards_are_swept_unless_somebody_may_be_writing_them(tmp_path):
    """Those of dead processes of this machine are; of another machine's, and of no known one, those a day old."""
    place = tmp_path / "shards"
    place.mkdir()
    shard = place / "s.exr"
    mine = temporary_path(shard, suffix=True)
    dead = mine.with_name(mine.name.replace(f"-{os.getpid()}-", "-999999999-"))
    elsewhere = mine.with_name(mine.name.replace(f"-{temporary._machine()}-", "-00000000-"))
    nameless = place / f".s.{os.getpid()}.tmp.exr"  # of an earlier version, which named no machine
    for path in (mine, dead, elsewhere, nameless):
        path.write_text("")
    ledger.sweep(tmp_path)
    assert set(place.iterdir()) == {mine, elsewhere, nameless}
    assert not ledger.shard_sizes(tmp_path)


def test_another_machines_half_written_shards_go_by_the_clock_of_the_file_server(tmp_path, monkeypatch):
    place = tmp_path / "shards"
    place.mkdir()
    path = temporary_path(place / "s.exr", suffix=True)
    path = path.with_name(path.name.replace(f"-{temporary._machine()}-", "-00000000-"))
    path.write_text("")
    os.utime(path, (0, 0))  # a copy may bear the date of what it is made of
    monkeypatch.setattr(time, "time", lambda: 1e12)  # this machine's clock is wrong
    ledger.sweep(tmp_path)
    assert path.exists()
    monkeypatch.setattr(temporary, "server_time", lambda folder: path.stat().st_ctime + temporary.AGE + 1)
    ledger.sweep(tmp_path)
    assert not path.exists()


# ---- The real renderer -----------------------------------------------------------------------------


def test_real_processes_write_the_bytes_of_a_plain_run_whatever_else_fails(tmp_path, monkeypatch):
    """Two processes; one scene's material file is missing, another one blocks its process, which is then killed."""
    from render.running import rendered_view
    from render.running.scene_rendering import render_scenes

    commit = "0" * 40  # a file of the checkout that changes meanwhile would show in the headers
    monkeypatch.setattr(rendered_view, "_commit", commit)
    config = DataConfig(families={"blobby": 4}, views=1, materials_per_view=2, light_count=4, size=24, spp=4)
    scenes = plan(config)
    assert render_scenes(scenes, tmp_path / "plain") == 8
    pipe = tmp_path / "pipe.yaml"
    os.mkfifo(pipe)
    bad = [replace(scenes[2], material=str(tmp_path / "gone.yaml")), replace(scenes[5], material=str(pipe))]
    mixed = [*scenes[:2], bad[0], *scenes[3:5], bad[1], *scenes[6:]]

    def kill_the_blocked_one() -> None:
        descriptor = os.open(pipe, os.O_WRONLY)  # returns when someone reads, and keeps the reader waiting
        stuck = [child for child in active_children() if Path(f"/proc/{child.pid}/fd").exists() and pipe.name in str(
            [os.readlink(link) for link in Path(f"/proc/{child.pid}/fd").iterdir() if link.is_symlink()])]  # fmt: skip
        for child in stuck:
            child.kill()
        os.close(descriptor)

    helper = threading.Thread(target=kill_the_blocked_one, daemon=True)
    helper.start()
    summary = render_supervised(mixed, tmp_path, pool=LocalPool(tmp_path, tmp_path, workers=2, commit=commit))
    helper.join()
    assert (summary.done, len(summary.failed)) == (4, 4)
    reasons = {line["id"]: line["reason"] for line in summary.failed}
    assert all("gone.yaml" in reasons[scene.id] for scene in scenes[2:4])
    assert all(reasons[scene.id] == "worker died, signal 9" for scene in scenes[4:6])
    for name in files(tmp_path):
        assert file_hash(tmp_path / "shards" / name) == file_hash(tmp_path / "plain" / "shards" / name)
    assert set(summary.lines[0]["stages"]) == {"shape", "build", "render", "write"}
