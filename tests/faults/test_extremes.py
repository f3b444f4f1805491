"""Extreme but legal scenes, each in a process of its own, and many rounds in one process."""

from pathlib import Path

import pytest
from endurance_run import Held, grown, watch
from extreme_run import CHEAP, run

LIMIT = 2048  # MiB


@pytest.mark.slow
@pytest.mark.parametrize("name", CHEAP)
def test_an_extreme_scene_is_rendered_or_refused(name: str) -> None:
    found = run(name)
    assert found["good"], found
    assert found["peak"] < LIMIT, found


@pytest.mark.slow
@pytest.mark.parametrize(("task", "count"), [("infer", 20), ("render", 100), ("train", 100)])
def test_many_rounds_hold_no_more_than_few(task: str, count: int, tmp_path: Path) -> None:
    rows = watch(task, count, tmp_path)
    assert not grown(rows), rows


def test_what_grows_is_seen() -> None:
    still = [Held(number, 100.0, 5, 2, 0, 0.1) for number in range(20)]
    assert not grown(still)
    assert grown([row._replace(memory=100.0 + 2 * number) for number, row in enumerate(still)])
    assert grown([row._replace(files=5 + number) for number, row in enumerate(still)])
