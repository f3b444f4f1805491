"""Planning, estimating, running and looking at a data folder from the command line."""

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from pipelines.cli import main
from pipelines.data import status
from pipelines.rendering import render_data
from render.planning import budget, folder_state
from render.planning.budget import Pace
from render.planning.plan import DataConfig, plan
from render.records import ledger
from render.records.manifest import read_manifest
from render.running.supervisor import RunSummary
from render.shared.errors import InputError

TINY = [word for item in ("families={blobby: 4}", "light_count=4", "size=32", "spp=2", "bounces=0")
        for word in ("--set", f"data.{item}")]  # fmt: skip


def command(*words: str) -> int:
    return main([*words[:2], "--preset", "smoke", *TINY, *words[2:]])


def fails(capsys: pytest.CaptureFixture, *words: str) -> str:
    assert main(list(words)) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("sdps: ")]
    assert len(lines) == 1
    return lines[0]


def test_plan_render_in_shares_and_watch(capsys, tmp_path):
    """The life of a data folder: planned with a sample, rendered in two shares, looked at in between."""
    out, folder = str(tmp_path), tmp_path / "data"
    assert command("data", "plan", "--out", out, "--workers", "1") == 0
    text = capsys.readouterr().out
    assert "8 scenes, 32 images (8 blobby; 2 val, 6 train; 4 shapes, 4 views; 0 spatially varying)" in text
    assert "measured on 8 scenes of 4 views" in text and "s per scene and process, 1 at once" in text
    assert sorted(path.name for path in folder.iterdir()) == ["config.yaml", "manifest.jsonl"]
    flags = ["--preset", "smoke", *TINY, "--out", out, "--workers", "1"]
    assert main(["render-data", *flags, "--shard", "1/2"]) == 0
    text = capsys.readouterr().out
    assert "4 of 4 scenes finished" in text and "rendering" in text and "scenes/hour" in text
    assert main(["data", "status", str(folder)]) == 0
    text = capsys.readouterr().out
    assert "4 of 8 scenes done, 0 failed, 4 left" in text and "scenes/hour" in text and "at this rate" in text
    assert main(["render-data", *flags]) == 0
    assert main(["data", "status", str(folder), "--json", "--verify"]) == 0
    text = capsys.readouterr().out
    state = json.loads(text[text.index("{") :])
    assert (state["done"], state["left"], state["failed"], state["bytes_needed"]) == (8, 0, 0, 0)
    assert main(["render-data", *flags]) == 0
    assert "this run" not in capsys.readouterr().out
    assert (folder / "preview.png").stat().st_size > 1000


def test_plan_without_a_sample_and_its_refusals(capsys, tmp_path):
    out = ["--out", str(tmp_path)]
    assert command("data", "plan", *out, "--no-sample") == 0
    assert "not measured" in capsys.readouterr().out
    before = (tmp_path / "data" / "manifest.jsonl").read_bytes()
    line = fails(capsys, "data", "plan", "--preset", "smoke", *TINY, *out, "--no-sample", "--set", "data.spp=3")
    assert "data.spp is 2 there, 3 asked for" in line
    line = fails(capsys, "data", "plan", "--preset", "smoke", *TINY, *out, "--no-sample", "--keep-free", "1e9")
    assert "only" in line and "are free" in line
    assert (tmp_path / "data" / "manifest.jsonl").read_bytes() == before
    line = fails(capsys, "render-data", "--preset", "smoke", *TINY, *out, "--keep-free", "1e9")
    assert "are free" in line and not (tmp_path / "data" / "shards").exists()
    (tmp_path / "data" / "config.yaml").unlink()  # without it, the plans themselves are compared
    line = fails(capsys, "data", "plan", "--preset", "smoke", *TINY, *out, "--no-sample", "--set", "data.seed=1")
    assert "holds another plan" in line


@pytest.mark.parametrize("shard", ["2", "0/2", "3/2", "a/b", "1/"])
def test_wrong_shards_are_told(capsys, tmp_path, shard):
    assert "shard" in fails(capsys, "render-data", "--preset", "smoke", "--out", str(tmp_path), "--shard", shard)
    assert not (tmp_path / "data").exists()


def test_report_counts_failures():
    line = {"id": "a", "reason": "no such material"}
    summary = RunSummary(scenes=5, done=2, lines=[], failed=[line, line], skipped=1, seconds=2.0, workers=1)
    text = render_data.report(summary, Path("data"), 4)
    assert "2 scenes failed now (2 x no such material); 1 failed earlier" in text and "--retry-failed" in text


# ---- Status ----------------------------------------------------------------------------------------


def stamped(folder: Path, scenes: list, starts: list[float], failed: list = ()) -> None:
    """Write shards and ledgers of runs that began at `starts` (seconds ago), one scene every 10 s, two per run."""
    (folder / "shards").mkdir(parents=True)
    for number, start in enumerate(starts):
        with ledger.Ledger(folder) as log:
            for step, scene in enumerate(scenes[2 * number : 2 * number + 2], start=1):
                (folder / scene.file).write_bytes(b"x" * 100)
                time = datetime.now(UTC) - timedelta(seconds=start - 10 * step)
                log.add({"id": scene.id, "spec": scene.digest(), "bytes": 100, "seconds": 10.0,
                         "stages": {"render": 10.0}, "time": time.isoformat(), "worker": 0})  # fmt: skip
    for scene in failed:
        with ledger.Ledger(folder) as log:
            log.fail({"id": scene.id, "reason": "timed out after 600 s", "time": ledger.now()})


def test_status_of_an_interrupted_folder(tmp_path):
    from render.records.manifest import write_manifest

    scenes = plan(DataConfig(families={"blobby": 4}, views=1, light_count=1, size=16))
    write_manifest(tmp_path, scenes)
    stamped(tmp_path, scenes, [10_000, 40], failed=scenes[4:6])
    (tmp_path / scenes[0].file).write_bytes(b"short")
    (tmp_path / "shards" / ".half.1.tmp.exr").write_bytes(b"x")
    state = folder_state.folder_state(tmp_path)
    assert (state["scenes"], state["done"], state["failed"], state["left"], state["damaged"]) == (8, 3, 2, 3, 1)
    assert state["reasons"] == {"timed out after 600 s": 2}
    # 4 scenes in two runs of 20 s each, whatever lies between them
    assert state["overall_per_hour"] == pytest.approx(360, rel=0.05)
    assert state["seconds_left"] == pytest.approx(30, rel=0.05)
    assert state["bytes_used"] == 300 and state["bytes_needed"] == 300
    assert "3 of 8 scenes done, 2 failed, 3 left" in status.render_text(state)


def test_machines_side_by_side_count_once():
    assert folder_state.measure_union([(0, 10), (5, 12), (20, 21)]) == 13
    assert folder_state.scene_rates([]) == {"recent_per_hour": None, "overall_per_hour": None}


def test_status_looks_at_every_scene_a_few_times_however_many_failed(tmp_path, monkeypatch):
    class Counted(list):
        looks = 0

        def __iter__(self):
            Counted.looks += 1
            return super().__iter__()

    ids = Counted(f"s{number}" for number in range(300))
    monkeypatch.setattr(folder_state, "scene_ids", lambda folder: ids)
    monkeypatch.setattr(folder_state, "read_failed", lambda folder: {id: [{"reason": "x"}] for id in list(ids)[:200]})
    monkeypatch.setattr(folder_state.budget, "disk_bytes", lambda scenes: 0)
    monkeypatch.setattr(folder_state, "read_manifest", lambda folder: [])
    assert folder_state.folder_state(tmp_path)["failed"] == 200
    assert Counted.looks < 10


def test_status_reads_ids_in_any_form_and_tells_what_is_no_data_folder(capsys, tmp_path):
    scenes = plan(DataConfig(families={"blobby": 1}, views=1, light_count=1, validation=0))
    from render.records.manifest import write_manifest
    from render.shared.config import to_plain

    write_manifest(tmp_path, scenes)
    assert folder_state.scene_ids(tmp_path) == [scene.id for scene in scenes]
    rows = [json.dumps(to_plain(scene), sort_keys=True) for scene in scenes]
    (tmp_path / "manifest.jsonl").write_text("\n".join(rows) + "\n")
    assert folder_state.scene_ids(tmp_path) == [scene.id for scene in scenes] == [s.id for s in read_manifest(tmp_path)]
    assert "sdps data plan" in fails(capsys, "data", "status", str(tmp_path / "none"))


# ---- Arithmetic ------------------------------------------------------------------------------------


def test_disk_estimate():
    (scene, *_) = plan(DataConfig(families={"blobby": 1}, views=1, light_count=64, size=128))
    assert budget.raw_bytes(scene) == 64 * 128 * 128 * 6
    assert 0.3 < budget.disk_bytes([scene]) / budget.raw_bytes(scene) < 0.4
    small = replace(scene, size=64)
    assert budget.disk_bytes([scene] * 10, [(small, 1000), (small, 3000)]) == 10 * 4 * 2000
    with pytest.raises(InputError, match=r"needs about 0 MB and .* kept free, but only"):
        budget.require_space(Path("nowhere/at/all"), 1, 10**18)


def test_paces():
    lines = [{"seconds": float(k), "stages": {"shape": 1.0, "render": k - 1.0}} for k in (3, 5, 100)]
    assert budget.recent_pace(lines, 2) == Pace(5.0, 2) and budget.recent_pace([], 2) is None
    assert Pace(5.0, 2).per_hour() == 1440 and Pace(5.0, 2).left(10) == 25
    assert budget.estimate_pace(lines[:2], 0.25, 1).seconds == pytest.approx(3.25)
    assert [budget.duration(s) for s in (45, 600, 9000, 200_000)] == ["45 s", "10 min", "2.5 h", "2.3 days"]
    assert budget.gigabytes(34e6) == "34 MB" and budget.gigabytes(1.25e9) == "1.2 GB"
    assert budget.default_workers("cuda_ad_rgb") == 1 <= budget.default_workers("llvm_ad_rgb") <= budget.cores()
