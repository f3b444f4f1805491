"""Stages reach who listens, as shares of the whole."""

import pytest

from render.shared import progress
from render.shared.progress import bars, repeat, report_to, retell, share, share_out, stage


def test_stages_are_reported_to_who_listens_and_to_nobody_else() -> None:
    reported: list[tuple[str, float]] = []
    stage("nobody hears", 1, 2)
    with report_to(lambda *values: reported.append(values)):
        stage("reading", 1, 4)
        with repeat(1, 2):
            stage("lights", 1, 2)
    stage("nobody hears", 1, 2)
    assert reported == [("reading", 0.25), ("lights", 0.75)]


def test_stages_of_a_job_are_shares_of_it() -> None:
    reported: list[tuple[str, float]] = []
    with report_to(lambda *values: reported.append(values)), share_out({"lights": 1.0, "normals": 3.0}):
        stage("lights", 1, 2)
        stage("something else")
        stage("normals", 1, 3)
        stage("normals", 3, 3)
    assert reported == [("lights", 0.125), ("normals", 0.5), ("normals", 1.0)]
    with share_out({"lights": 1.0}):
        stage("lights")


def test_parts_of_a_stage_may_be_nested() -> None:
    reported: list[tuple[str, float]] = []
    with report_to(lambda *values: reported.append(values)), repeat(1, 4):
        with share(0.0, 0.5), repeat(1, 2):
            stage("normals", 1, 2)
        with share(0.5, 1.0):
            stage("normals", 1, 1)
    stage("normals")
    assert reported == [("normals", 0.25 + 0.25 * 0.375), ("normals", 0.5)]


def test_a_stage_that_comes_again_has_a_name_of_its_own() -> None:
    reported: list[tuple[str, float]] = []
    with report_to(lambda name, done: reported.append((name, done))), retell("normals", "second look"):
        stage("survey", 1, 1)
        stage("normals", 1, 2)
    with retell("normals", "second look"):  # nobody listens
        stage("normals", 1, 2)
    assert reported == [("second look", 0.5)]


def test_long_stages_have_a_bar_with_the_time_left(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(progress, "_SHORT", 0.0)
    monkeypatch.setattr(progress.sys.stderr, "isatty", lambda: True, raising=False)  # or lines come every minute
    with bars(without=("reading",)):
        stage("reading", 1, 2)
        for number in range(3):
            stage("normals", number + 1, 4)
        stage("depth", 1, 1)
    shown = capsys.readouterr().err
    assert "normals:  75%" in shown and "left" in shown and "depth: 100%" in shown and "reading" not in shown


def test_short_stages_have_none(capsys) -> None:
    with bars():
        stage("normals", 1, 2)
        stage("normals", 2, 2)
    assert capsys.readouterr().err == ""


def test_a_log_has_whole_lines_and_few_of_them(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(progress, "_SHORT", 0.0)
    monkeypatch.setattr(progress.sys.stderr, "isatty", lambda: False, raising=False)
    with bars():
        for number in range(200):
            stage("normals", number + 1, 200)
        stage("depth", 1, 1)
    for _ in progress.progress_bar(range(50), desc="photographs"):
        pass
    shown = capsys.readouterr().err
    assert "\r" not in shown and "\x1b" not in shown and "" not in shown.splitlines()
    lines = [line for name in ("normals", "depth", "photographs") for line in shown.splitlines() if name in line]
    assert len(lines) == len(shown.splitlines()) <= 6 and "normals: 100%" in shown
