"""The bytes of a visitor: never more than allowed, and fewer again when something fails, is cut off, or goes."""

import asyncio
import io
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from app_server import Client, application, contents, eventually
from PIL import Image

LIMITS = {"files": 60, "bytes": 400_000, "pixels": 200_000}
SETS = 12


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Any]]:
    pytest.importorskip("starlette", reason="needs pip install sdps[app]")
    pytest.importorskip("uvicorn", reason="needs pip install sdps[app]")
    with application(tmp_path_factory.mktemp("root"), **LIMITS) as place:
        yield place


class Visitor(Client):
    """A client that also sees its session from the inside."""

    def __init__(self, served: tuple[str, Any]) -> None:
        super().__init__(served[0])
        self.session = served[1].state.sessions.find(self.token)

    def files(self) -> dict[str, int]:
        """Return all files of the session by path, and their sizes."""
        return contents(self.session.folder)

    def settled(self) -> bool:
        """Tell whether what is counted is what lies there."""
        return self.session.taken == sum(self.files().values())


@pytest.fixture
def visitor(served: tuple[str, Any]) -> Visitor:
    return Visitor(served)


def png(side: int = 8) -> bytes:
    """Return a white picture, which is also a mask."""
    written = io.BytesIO()
    Image.new("L", (side, side), 255).save(written, "png")
    return written.getvalue()


def finish(connections: list[Any]) -> list[int]:
    statuses = []
    for connection in connections:
        answer = connection.getresponse()
        answer.read()
        statuses.append(answer.status)
        connection.close()
    return statuses


def test_uploads_at_the_same_time_are_all_counted(visitor: Visitor) -> None:
    path, half = visitor.new_set(), 100
    uploads = [visitor.begin(f"{path}/uploads/{number}.txt", 2 * half) for number in range(50)]
    for _ in range(2):
        for upload in uploads:
            upload.send(bytes(half))
    assert finish(uploads) == [200] * 50
    assert visitor.session.taken == 50 * 2 * half and visitor.settled()


def test_uploads_at_the_same_time_never_pass_the_limit(visitor: Visitor) -> None:
    path, part = visitor.new_set(), 50_000
    most = {"counted": 0, "there": 0}
    over = threading.Event()

    def watch() -> None:
        while not over.is_set():
            most["counted"] = max(most["counted"], visitor.session.taken)
            seen = visitor.files()
            if seen == visitor.files():  # else a file went or grew while they were looked through
                most["there"] = max(most["there"], sum(seen.values()))

    watching = threading.Thread(target=watch)
    watching.start()
    uploads = [visitor.begin(f"{path}/uploads/{number}.txt", 2 * part) for number in range(10)]
    for _ in range(2):
        for upload in uploads:
            upload.send(bytes(part))
        time.sleep(0.2)
    refused = [status for status in finish(uploads) if status != 200]
    over.set()
    watching.join()
    assert refused and most["counted"] <= LIMITS["bytes"] and most["there"] <= LIMITS["bytes"], most
    assert visitor.session.taken == (10 - len(refused)) * 2 * part and visitor.settled()


def test_files_at_the_same_time_are_no_more_than_allowed(visitor: Visitor) -> None:
    path = visitor.new_set()
    uploads = [visitor.begin(f"{path}/uploads/{number}.txt", 2) for number in range(LIMITS["files"] + 5)]
    for upload in uploads:
        upload.send(b"1")
    for upload in uploads:
        upload.send(b"1")
    statuses = finish(uploads)
    assert statuses.count(200) == LIMITS["files"] == len(visitor.files()) and visitor.settled()


@pytest.mark.parametrize("name", ["photographs", "mask", "studio"])
def test_who_goes_away_in_the_middle_leaves_nothing(visitor: Visitor, name: str) -> None:
    place = visitor.new_set()
    path = {"photographs": f"{place}/uploads/a.png", "mask": f"{place}/mask", "studio": "/studio/uploads/a.ply"}[name]
    upload = visitor.begin(path, 200_000)
    upload.send(bytes(100_000))
    assert eventually(lambda: visitor.session.taken == 100_000)
    assert visitor.send("GET", f"{place}/files/photos/a.png")[0] == 404  # nobody meets half of it
    upload.close()
    assert eventually(lambda: visitor.session.taken == 0 and not visitor.files())
    assert visitor.send("PUT", path, png())[0] == 200 and visitor.settled()


def test_what_is_refused_is_not_counted_and_may_be_sent_again(visitor: Visitor) -> None:
    path = visitor.new_set()
    for body in (b"no picture", png(500), b"\x89PNG" + bytes(LIMITS["bytes"])):
        assert visitor.send("PUT", f"{path}/uploads/a.png", body)[0] == 400
        assert visitor.session.taken == 0 and not visitor.files()
    assert visitor.send("PUT", f"{path}/uploads/a.png", png())[0] == 200
    assert visitor.send("PUT", f"{path}/uploads/a.png", png())[0] == 400  # the name is taken, and the first one stays
    assert list(visitor.files().values()) == [len(png())] and visitor.settled()


def test_a_refusal_arrives_although_much_of_the_upload_is_still_to_come(visitor: Visitor) -> None:
    status, said = visitor.send("PUT", f"{visitor.new_set()}/uploads/a.png", bytes(30_000_000))
    assert status == 400 and b"too large" in said
    status, said = visitor.send("PUT", f"{visitor.new_set()}/uploads/a.exe", bytes(30_000_000))
    assert status == 400 and b"cannot be used" in said


def test_texts_are_not_read_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, visitor: Visitor) -> None:
    from pipelines.app.common import uploads

    monkeypatch.setattr(uploads, "_MOST_TEXT", 1000)
    status, said = visitor.send("PUT", f"{visitor.new_set()}/uploads/lights.txt", bytes(1001))
    assert status == 400 and b"too large" in said and visitor.session.taken == 0
    assert visitor.send("PUT", "/studio/uploads/own.yaml", bytes(1001))[0] == 400


def test_a_mask_is_counted_once_and_no_more_when_it_is_taken_away(visitor: Visitor) -> None:
    path = visitor.new_set()
    for side in (64, 300, 32):
        assert visitor.send("PUT", f"{path}/mask", png(side))[0] == 200
        assert visitor.session.taken > 0 and visitor.settled()
    assert visitor.send("PUT", f"{path}/mask", b"")[0] == 200
    assert visitor.session.taken == 0 and not visitor.files()


def test_masks_at_the_same_time_do_not_meet(visitor: Visitor) -> None:
    path, body = visitor.new_set(), png(64)
    uploads = [visitor.begin(f"{path}/mask", len(body)) for _ in range(5)]
    for part in (body[:50], body[50:]):
        for upload in uploads:
            upload.send(part)
    assert finish(uploads) == [200] * 5 and visitor.settled()


# ---- Sets ----


def studio(visitor: Visitor) -> set[str]:
    """Leave files of the other pages, as their jobs do; return their paths."""
    assert visitor.send("PUT", "/studio/uploads/ball.off", b"OFF")[0] == 200
    for page in ("studio-", "data-"):
        (visitor.session.folder / page).mkdir()
        (visitor.session.folder / page / "basis.bin").write_bytes(b"")
    return set(visitor.files())


def test_only_sets_of_photographs_are_pruned_and_their_bytes_come_back(visitor: Visitor) -> None:
    others, sets = studio(visitor), []
    for _ in range(SETS + 5):
        sets.append(visitor.new_set())
        assert visitor.send("PUT", f"{sets[-1]}/uploads/a.png", png())[0] == 200
    assert others <= set(visitor.files())
    assert len([name for name in visitor.files() if name.endswith("a.png")]) == SETS
    assert visitor.session.taken == SETS * len(png()) + len(b"OFF") and visitor.settled()
    there = [visitor.send("GET", f"{path}/files/photos/a.png")[0] for path in sets]
    assert there == [400] * 5 + [200] * SETS


def test_a_set_that_is_used_stays_and_one_that_is_not_goes(visitor: Visitor) -> None:
    first, second = visitor.new_set(), visitor.new_set()
    for _ in range(SETS - 2):
        visitor.new_set()
    assert visitor.send("PUT", f"{first}/uploads/a.png", png())[0] == 200
    visitor.new_set()
    assert visitor.send("GET", f"{first}/files/photos/a.png")[0] == 200
    assert visitor.send("PUT", f"{second}/uploads/a.png", png())[0] == 400


def test_a_set_with_an_upload_under_way_stays(visitor: Visitor) -> None:
    path = visitor.new_set()
    upload = visitor.begin(f"{path}/uploads/a.txt", 20)
    upload.send(bytes(10))
    assert eventually(lambda: visitor.session.taken == 10)
    for _ in range(2 * SETS):
        visitor.new_set()
    upload.send(bytes(10))
    assert finish([upload]) == [200] and visitor.session.taken == 20


def test_a_set_with_a_job_stays(served: tuple[str, Any], visitor: Visitor, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs = served[1].state.jobs
    path = visitor.new_set()
    place = visitor.session.folder / path.split("/")[-1]
    monkeypatch.setattr(jobs, "works_in", lambda folder: folder == place)
    for _ in range(2 * SETS):
        visitor.new_set()
    assert place.is_dir()
    monkeypatch.setattr(jobs, "works_in", lambda folder: True)
    assert visitor.send("POST", "/photographs/sets")[0] == 503  # and nothing of what is in work is removed
    assert len(list(visitor.session.folder.iterdir())) == SETS


def test_sets_begun_at_the_same_time_give_back_what_is_pruned_once(visitor: Visitor) -> None:
    for _ in range(SETS):
        assert visitor.send("PUT", f"{visitor.new_set()}/uploads/a.png", png())[0] == 200
    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda _: visitor.send("POST", "/photographs/sets"), range(20)))
    assert {status for status, _ in answers} == {200}
    assert visitor.session.taken == 0 and visitor.settled()
    assert len(list(visitor.session.folder.iterdir())) == SETS


@pytest.mark.parametrize("name", ["studio-", "uploads", "data-", ".incoming-0", "0" * 15, "..", "%00"])
def test_what_is_no_set_cannot_be_uploaded_to(visitor: Visitor, name: str) -> None:
    studio(visitor)
    status, _ = visitor.send("PUT", f"/photographs/sets/{name}/uploads/a.png", png())
    assert status in (400, 403, 404, 405)


# ---- The studio ----


def test_an_upload_of_the_studio_takes_the_place_of_the_last_one_once_it_is_whole(visitor: Visitor) -> None:
    for size in (1000, 3000, 500):
        assert visitor.send("PUT", "/studio/uploads/ball.off", bytes(size))[0] == 200
        assert visitor.session.taken == size and visitor.settled()
    upload = visitor.begin("/studio/uploads/ball.off", 2000)
    upload.send(bytes(1000))
    assert eventually(lambda: visitor.session.taken == 1500)
    assert visitor.files()["uploads/ball.off"] == 500
    upload.close()
    assert eventually(lambda: visitor.session.taken == 500 and visitor.settled())
    assert visitor.send("PUT", "/studio/uploads/ball.off", bytes(LIMITS["bytes"]))[0] == 400
    assert visitor.files() == {"uploads/ball.off": 500}


def test_a_name_may_be_used_again_when_there_are_many(visitor: Visitor) -> None:
    for number in range(20):
        assert visitor.send("PUT", f"/studio/uploads/{number}.off", b"OFF")[0] == 200
    assert visitor.send("PUT", "/studio/uploads/new.off", b"OFF")[0] == 400
    assert visitor.send("PUT", "/studio/uploads/7.off", b"other")[0] == 200
    assert visitor.settled()


# ---- Requests that are cancelled ----


def test_one_who_is_cancelled_waits_for_the_thread_before_it_cleans_up(tmp_path: Path) -> None:
    from pipelines.app.common.incoming import Incoming, open_upload, run_in_thread
    from pipelines.app.common.sessions import Session

    session = Session("token", tmp_path)
    written, begun, go = [], threading.Event(), threading.Event()

    def write(coming: Incoming) -> None:
        for number in range(20):
            coming.take(10, "a")
            (coming.folder / str(number)).write_bytes(bytes(10))
            begun.set()
            go.wait(30)  # for what is cancelled
        written.append(coming.folder)

    async def upload() -> None:
        async with open_upload(session, 1000, "0" * 16) as coming:
            await run_in_thread(write, coming)

    async def cancelled() -> None:
        task = asyncio.create_task(upload())
        assert await asyncio.to_thread(begun.wait, 30)
        for _ in range(3):
            task.cancel()
            await asyncio.sleep(0)
        go.set()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(cancelled())
    assert written and session.taken == 0 and not session.under_way and not list(tmp_path.iterdir())


def test_a_body_that_stands_still_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pipelines.app.common import incoming
    from pipelines.app.common.refusals import Refused
    from pipelines.app.common.sessions import Session

    monkeypatch.setattr(incoming, "_STALLED", 0.1)
    session = Session("token", tmp_path)

    async def body():
        yield b"begun"
        await asyncio.sleep(30)

    async def upload() -> None:
        async with incoming.open_upload(session, 1000, "0" * 16) as coming:
            await incoming.receive(body(), coming.folder / "a.png", coming)

    with pytest.raises(Refused, match=r"a\.png: nothing arrived") as refused:
        asyncio.run(upload())
    assert refused.value.status == 408 and session.taken == 0 and not list(tmp_path.iterdir())


def test_a_full_disk_is_said(visitor: Visitor, monkeypatch: pytest.MonkeyPatch) -> None:
    from pipelines.app.common import incoming

    def write(handle: Any, block: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(incoming, "_write", write)
    status, said = visitor.send("PUT", f"{visitor.new_set()}/uploads/a.png", png())
    assert status == 507 and b"full" in said and visitor.session.taken == 0 and not visitor.files()
