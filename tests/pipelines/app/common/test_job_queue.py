"""The queue and its worker: nobody waits for a process on the event loop, and no job is lost to a dead worker."""

import json
import threading
import urllib.request
from collections.abc import Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path

import pretend_worker
import pytest
from app_server import Client, application, eventually

from pipelines.app.common import jobs as module
from pipelines.app.common.jobs import Job, Jobs

PATIENCE = 30.0
"""Seconds after which something that should have happened has not."""


@pytest.fixture
def jobs(monkeypatch: pytest.MonkeyPatch) -> Iterator[Jobs]:
    monkeypatch.setattr(module, "serve", pretend_worker.serve)
    queue = Jobs()
    yield queue
    queue.close()


def state(job: Job, wanted: str) -> bool:
    return eventually(lambda: job.state == wanted)


class Ends:
    """Holds up the end of every process until it is let go, as that of a large one takes long.

    Attributes:
        begun: Set once somebody waits for a process to end.
        missed: Whether somebody waited in vain: nothing that a test calls may be held up by it.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.begun, self.missed, self._go = threading.Event(), False, threading.Event()
        join = BaseProcess.join

        def wait(process: BaseProcess, timeout: float | None = None) -> None:
            self.begun.set()
            self.missed |= not self._go.wait(PATIENCE)
            join(process, timeout)

        monkeypatch.setattr(BaseProcess, "join", wait)

    def let_go(self) -> None:
        """Let processes end; first make sure that somebody waits, and that nobody else had to."""
        assert self.begun.wait(PATIENCE) and not self.missed
        self._go.set()


def test_nothing_but_the_queues_thread_waits_for_a_process(jobs: Jobs, monkeypatch: pytest.MonkeyPatch) -> None:
    running = jobs.submit("me", "sleep", seconds=60, place="/a")
    assert running is not None and state(running, "running")
    ends = Ends(monkeypatch)
    jobs.cancel(running)
    assert jobs.describe(running)["state"] == "cancelled"
    assert ends.begun.wait(PATIENCE)
    waiting = jobs.submit("me", "echo", place="/a")
    other = jobs.submit("you", "echo")
    assert waiting is not None and other is not None
    assert jobs.describe(waiting)["before"] == 0 and jobs.works_in(Path("/a"))
    jobs.forget("me")
    assert not jobs.works_in(Path("/a")) and jobs.get("me", waiting.id) is None
    ends.let_go()
    assert state(other, "done")


def test_the_server_answers_while_a_worker_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("starlette", reason="needs pip install sdps[app]")
    pytest.importorskip("uvicorn", reason="needs pip install sdps[app]")
    monkeypatch.setattr(module, "serve", pretend_worker.serve)
    with application(tmp_path) as (address, app):
        client = Client(address)
        job = client.post("/studio/start/gallery")
        assert client.wait(job)["state"] == "done"
        running = app.state.jobs.submit(client.token, "sleep", seconds=60)
        assert state(running, "running")
        with monkeypatch.context() as patched:
            ends = Ends(patched)
            assert client.post(f"/jobs/{running.id}/cancel")["state"] == "cancelled"
            assert ends.begun.wait(PATIENCE)
            client.get(f"/jobs/{running.id}")
            client.post("/photographs/sets")
            with urllib.request.urlopen(f"{address}/static/icon.svg", timeout=PATIENCE) as answer:
                answer.read()
            ends.let_go()
        running = app.state.jobs.submit(client.token, "sleep", seconds=60)
        assert state(running, "running")
        with monkeypatch.context() as patched:
            ends = Ends(patched)
            app.state.jobs.forget(client.token)
            ends.let_go()


def test_a_worker_that_died_while_idle_costs_no_job(jobs: Jobs) -> None:
    first = jobs.submit("me", "echo", a=1)
    assert first is not None and state(first, "done") and first.result == {"a": 1}
    worker = jobs._worker
    assert worker is not None
    worker.process.kill()
    assert eventually(lambda: not worker.process.is_alive())
    for number in range(3):
        job = jobs.submit("me", "echo", a=number)
        assert job is not None and state(job, "done") and job.result == {"a": number}


def test_one_that_dies_of_a_job_fails_it_alone(jobs: Jobs) -> None:
    killed, after = jobs.submit("me", "die"), jobs.submit("me", "echo")
    assert killed is not None and after is not None
    assert state(killed, "failed") and "worker stopped" in killed.message
    assert state(after, "done")


def test_cancelled_jobs_one_after_another_harm_no_other(jobs: Jobs) -> None:
    for _ in range(5):
        job, after = jobs.submit("me", "sleep", seconds=60), jobs.submit("you", "echo")
        assert job is not None and after is not None and state(job, "running")
        jobs.cancel(job)
        assert state(after, "done") and job.state == "cancelled"


def test_a_worker_that_cannot_be_started_is_tried_again(jobs: Jobs, monkeypatch: pytest.MonkeyPatch) -> None:
    first = jobs.submit("me", "echo")
    assert first is not None and state(first, "done")
    made, worker = [], module._Worker

    def start() -> object:
        made.append(None)
        if len(made) < 3:
            raise OSError("no more processes")
        return worker()

    monkeypatch.setattr(module, "_Worker", start)
    killed, job = jobs.submit("me", "die"), jobs.submit("me", "echo")
    assert killed is not None and job is not None and state(job, "done") and len(made) == 3


def test_numbers_that_json_does_not_have_reach_the_page_as_none(jobs: Jobs) -> None:
    job = jobs.submit("me", "number")
    assert job is not None and state(job, "done")
    said = jobs.describe(job)
    assert json.loads(json.dumps(said, allow_nan=False))["result"] == {"a": None, "b": [None, 1.5], "c": [2, "x"]}


def test_what_ended_is_not_kept_without_end(jobs: Jobs, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_KEPT", 5)
    for _ in range(20):
        job = jobs.submit("me", "echo")
        assert job is not None and state(job, "done")
    assert len(jobs._jobs) <= 6
    jobs.forget("me")
    assert not jobs._jobs


def test_close_ends_the_worker_of_a_running_job(jobs: Jobs) -> None:
    job = jobs.submit("me", "sleep", seconds=60)
    assert job is not None and state(job, "running")
    worker = jobs._worker
    jobs.close()
    assert worker is not None and not worker.process.is_alive() and not jobs._thread.is_alive()
