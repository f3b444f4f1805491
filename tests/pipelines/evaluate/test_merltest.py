"""`sdps evaluate merltest`: scenes rendered on a Dask cluster; earlier names of commands and flags."""

import json

import pytest

from pipelines import cli


@pytest.mark.parametrize(
    ("earlier", "now"),
    [
        (["eval-merltest", "--lights", "true"], ["evaluate", "merltest", "--lighting", "true"]),
        (["eval-diligent", "data"], ["evaluate", "diligent", "data"]),
        (["eval-lights", "data", "--dataset", "gourd-apple"], ["evaluate", "gourd-apple", "data"]),
        (["eval-lights", "data", "--dataset", "light-stage"], ["evaluate", "light-stage", "data"]),
        (["eval-photos", "data"], ["evaluate", "uw", "data"]),
        (["eval-classical"], ["evaluate", "classical"]),
        (["report", "out"], ["evaluate", "report", "out"]),
    ],
)
def test_earlier_names_mean_the_same_and_are_not_listed(earlier, now, capsys):
    commands = [[word for word in words if not word.startswith("-")] for words in (earlier, now)]
    first, second = (
        cli.build_parser(names).parse_args(words) for names, words in zip(commands, (earlier, now), strict=True)
    )
    assert vars(first) == vars(second)
    cli.build_parser([]).print_help()
    assert f"  {earlier[0]} " not in capsys.readouterr().out


@pytest.mark.slow
def test_scenes_of_a_cluster_score_what_those_of_one_process_score(tmp_path, capsys):
    distributed = pytest.importorskip("distributed")
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
