"""The queue and its worker: nobody waits for a process on the event loop, and no job is lost to a dead worker."""

import json
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from pathlib import Path

import pretend_worker
import pytest
from app_server import Client, application, eventually

from pipelines.app.common import jobs as module
from pipelines.app.common.jobs import Job, Jobs

SLOW = 4.0
AT_ONCE = 2.0
"""Seconds, generous for a busy machine; a call that waits for the slow end of a process takes twice as many."""


@pytest.fixture
def jobs(monkeypatch: pytest.MonkeyPatch) -> Iterator[Jobs]:
    monkeypatch.setattr(module, "serve", pretend_worker.serve)
    queue = Jobs()
    yield queue
    queue.close()


def state(job: Job, wanted: str) -> bool:
    return eventually(lambda: job.state == wanted)


def slow_to_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the end of a process take seconds, as that of a large one may."""
    join = BaseProcess.join
    monkeypatch.setattr(BaseProcess, "join", lambda self, timeout=None: (time.sleep(SLOW), join(self, timeout))[1])


@contextmanager
def at_once() -> Iterator[None]:
    began = time.monotonic()
    yield
    assert time.monotonic() - began < AT_ONCE


def test_nothing_but_the_queues_thread_waits_for_a_process(jobs: Jobs, monkeypatch: pytest.MonkeyPatch) -> None:
    running = jobs.submit("me", "sleep", seconds=60, place="/a")
    assert running is not None and state(running, "running")
    slow_to_end(monkeypatch)
    with at_once():
        jobs.cancel(running)
        assert jobs.describe(running)["state"] == "cancelled"
    time.sleep(0.4)  # now the thread waits
    with at_once():
        waiting = jobs.submit("me", "echo", place="/a")
        other = jobs.submit("you", "echo")
        assert waiting is not None and other is not None
        assert jobs.describe(waiting)["before"] == 0 and jobs.works_in(Path("/a"))
        jobs.forget("me")
        assert not jobs.works_in(Path("/a")) and jobs.get("me", waiting.id) is None
    assert state(other, "done")
    monkeypatch.undo()


def test_the_server_answers_while_a_worker_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("starlette", reason="needs pip install sdps[app]")
    pytest.importorskip("uvicorn", reason="needs pip install sdps[app]")
    monkeypatch.setattr(module, "serve", pretend_worker.serve)
    with application(tmp_path) as (address, app):
        client, longest, over = Client(address), [0.0], threading.Event()

        def watch() -> None:
            while not over.is_set():
                began = time.monotonic()
                with urllib.request.urlopen(f"{address}/static/icon.svg", timeout=30) as answer:
                    answer.read()
                longest[0] = max(longest[0], time.monotonic() - began)
                time.sleep(0.05)

        job = client.post("/studio/start/gallery")
        assert client.wait(job)["state"] == "done"
        running = app.state.jobs.submit(client.token, "sleep", seconds=60)
        assert state(running, "running")
        with monkeypatch.context() as patched:
            slow_to_end(patched)
            watching = threading.Thread(target=watch)
            watching.start()
            with at_once():
                assert client.post(f"/jobs/{running.id}/cancel")["state"] == "cancelled"
            for _ in range(4):
                time.sleep(0.1)
                with at_once():
                    client.get(f"/jobs/{running.id}")
                    client.post("/photographs/sets")
            app.state.jobs.submit(client.token, "sleep", seconds=60)
            time.sleep(SLOW)
            with at_once():
                app.state.jobs.forget(client.token)
            over.set()
            watching.join()
        assert longest[0] < AT_ONCE


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
