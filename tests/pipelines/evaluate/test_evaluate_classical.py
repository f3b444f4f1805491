"""`sdps evaluate classical`, and the scores kept on disk."""

import json

from pipelines import cli
from pipelines.evaluate.evaluation import ScoreCache

SMALL = ["--set", "test.shapes=[sphere]", "--set", "test.materials=['lambertian:0.5', red-phenolic]",
         "--set", "test.size=32", "--set", "test.spp=4", "--set", "test.bounces=0"]  # fmt: skip


def test_tables_hold_scores_and_reasons_and_are_kept(tmp_path, capsys):
    command = ["evaluate", "classical", *SMALL, "--out", str(tmp_path), "--light-sets", "near-uniform:24,biased:24"]
    assert cli.main([*command, "--methods", "least-squares,factorisation,sm10"]) == 0
    text = capsys.readouterr().out
    assert "Normals, mean angular error in degrees: sphere, near-uniform:24" in text
    results = json.loads((tmp_path / "results.json").read_text())
    rows = {(row["method"], row["lights"], row["category"]): row for row in results["rows"]}
    assert len(rows) == 3 * 2 * 2
    assert set(rows["least-squares", "biased:24", "lambertian"]["scores"]).isdisjoint({"direction_mae"})
    assert rows["least-squares", "near-uniform:24", "lambertian"]["scores"]["normal_mae"] < 15
    assert "intensity_error" in rows["factorisation", "near-uniform:24", "lambertian"]["scores"]
    ledger = (tmp_path / "eval" / "scores.jsonl").read_text()
    assert cli.main([*command, "--methods", "least-squares,factorisation"]) == 0  # nothing runs twice
    assert (tmp_path / "eval" / "scores.jsonl").read_text() == ledger


def test_unknown_method_is_one_line(capsys):
    assert cli.main(["evaluate", "classical", "--methods", "pf-14"]) == 2
    assert "did you mean 'pf14'" in capsys.readouterr().err


def test_scores_outlive_a_torn_line(tmp_path):
    path = tmp_path / "scores.jsonl"
    ScoreCache(path, "a").add(("method", "scene"), [1.0])
    with path.open("a") as handle:
        handle.write('{"identity": "a", "key": ["met')
    cache = ScoreCache(path, "a")
    assert cache.get(("method", "scene")) == [1.0]
    cache.add(("other", "scene"), 2)
    again = ScoreCache(path, "a")
    assert again.get(("other", "scene")) == 2 and again.get(("method", "scene")) == [1.0]
    assert ScoreCache(path, "b").get(("method", "scene")) is None
