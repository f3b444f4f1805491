"""Stages reach who listens, as shares of the whole."""

from render.shared.progress import listening, repeat, stage, together


def test_stages_are_told_to_who_listens_and_to_nobody_else() -> None:
    told: list[tuple[str, float]] = []
    stage("nobody hears", 1, 2)
    with listening(lambda *values: told.append(values)):
        stage("reading", 1, 4)
        with repeat(1, 2):
            stage("lights", 1, 2)
    stage("nobody hears", 1, 2)
    assert told == [("reading", 0.25), ("lights", 0.75)]


def test_stages_of_a_job_are_shares_of_it() -> None:
    told: list[tuple[str, float]] = []
    with listening(lambda *values: told.append(values)), together({"lights": 1.0, "normals": 3.0}):
        stage("lights", 1, 2)
        stage("something else")
        stage("normals", 1, 3)
        stage("normals", 3, 3)
    assert told == [("lights", 0.125), ("normals", 0.5), ("normals", 1.0)]
    with together({"lights": 1.0}):
        stage("lights")
