"""Networks are timed on this machine for the forecast; what it makes of the times, whatever they are."""

from collections.abc import Callable

import pytest
import torch

from render.shared.progress import report_to
from sdps.api import make_runner
from sdps.inference import network_speed
from sdps.inference.estimator import Estimator
from sdps.inference.network_speed import time_lights, time_normals


def find_estimator(method: str, images: int = 8) -> Estimator:
    estimator = make_runner(method, (False, False), None, None, False, images).estimator
    assert estimator is not None
    return estimator


@pytest.fixture
def pretended(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """A list of one number: the seconds that anything takes; what is timed runs once, so that it must work."""
    seconds = [1.0]

    def time_usual(action: Callable[[], object]) -> float:
        action()
        return seconds[0]

    monkeypatch.setattr(network_speed, "time_usual", time_usual)
    monkeypatch.setattr(network_speed, "_told", {})
    return seconds


@pytest.mark.parametrize("method", ["sdps-frames", "sdps-plus", "sdps"])
def test_a_network_is_compared_with_what_it_says_of_itself(pretended: list[float], method: str) -> None:
    estimator = find_estimator(method)
    network, side = estimator.normals.network, network_speed._SIDE  # type: ignore[union-attr]
    pretended[0] = 1.5 * network.inference_seconds(8, side**2, side**2, 1)
    assert time_normals(estimator, 8) == pytest.approx(1.5)
    pretended[0] = 0.02
    assert time_lights(estimator) == pytest.approx(0.02 / network_speed._LIT)
    pretended[0] = 99.0
    assert time_normals(estimator, 8) == pytest.approx(1.5)  # timed once in a process
    assert time_normals(estimator, 9) > 10.0  # another number of images is timed again
    assert time_normals(estimator, 24) == time_normals(estimator, 1000)  # never more than a few


def test_timing_leaves_no_trace(pretended: list[float]) -> None:
    estimator, told = find_estimator("sdps-frames"), []
    before = torch.get_rng_state()
    with report_to(lambda *said: told.append(said)):
        time_normals(estimator, 4)
        time_lights(estimator)
    assert not told and torch.equal(before, torch.get_rng_state())


def test_a_few_times_are_told_by_their_median(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = iter([0.0, 9.0, 10.0, 11.0, 20.0, 23.0, 30.0, 32.0])  # the first one makes the kernels
    monkeypatch.setattr(network_speed.time, "perf_counter", lambda: next(ticks))
    assert network_speed.time_usual(lambda: None) == 2.0
