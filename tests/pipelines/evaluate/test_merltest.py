"""`sdps evaluate merltest` with scenes rendered on a Dask cluster."""

import json

import pytest

from pipelines import cli

distributed = pytest.importorskip("distributed")


@pytest.mark.slow
def test_scenes_of_a_cluster_score_what_those_of_one_process_score(tmp_path, capsys):
    words = ["evaluate", "merltest", "--preset", "smoke", "--set", "test.size=32", "--set", "test.spp=4"]
    words += ["--set", "test.materials=[chrome, nylon]", "--set", "test.repeats=2"]
    words += ["--normals", "least-squares", "--lighting", "true"]
    assert cli.main([*words, "--out", str(tmp_path / "a")]) == 0
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address=":0", silence_logs=50
    ) as cluster:
        assert cli.main([*words, "--out", str(tmp_path / "b"), "--cluster", cluster.scheduler_address]) == 0
    a, b = (json.loads((tmp_path / name / "eval" / "results.json").read_text()) for name in "ab")
    assert a["scenes"] == b["scenes"] and len(a["scenes"]) > 1 and a["tables"] == b["tables"]
