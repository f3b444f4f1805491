"""ZIP archives: whole or not at all, nothing outside their set, and no more memory or disk than they may have."""

import io
import stat
import struct
import tempfile
import zipfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from app_server import Client, application, contents
from PIL import Image

from sdps.photos.pictures.sources import archive_files

LIMITS = {"files": 20, "bytes": 4_000_000, "pixels": 200_000}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder far above the sessions, so that what leaves a session still lies in it."""
    return tmp_path_factory.mktemp("root")


@pytest.fixture(scope="module")
def served(root: Path) -> Iterator[tuple[str, Any]]:
    pytest.importorskip("starlette", reason="needs pip install sdps[app]")
    pytest.importorskip("uvicorn", reason="needs pip install sdps[app]")
    deep = root / "a" / "b" / "c" / "d"
    deep.mkdir(parents=True)
    before, tempfile.tempdir = tempfile.tempdir, str(deep)
    try:
        with application(root / "shown", **LIMITS) as place:
            tempfile.tempdir = before
            yield place
    finally:
        tempfile.tempdir = before


@pytest.fixture
def client(served: tuple[str, Any]) -> Client:
    return Client(served[0])


@pytest.fixture
def folder(served: tuple[str, Any], client: Client) -> Path:
    """The client's session."""
    return served[1].state.sessions.find(client.token).folder


def png(side: int = 8) -> bytes:
    written = io.BytesIO()
    Image.new("L", (side, side), 99).save(written, "png")
    return written.getvalue()


def packed(*files: tuple[str | zipfile.ZipInfo, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    written = io.BytesIO()
    with zipfile.ZipFile(written, "w", method) as opened:
        for name, data in files:
            opened.writestr(name, data)
    return written.getvalue()


def link(name: str, target: str) -> tuple[zipfile.ZipInfo, bytes]:
    item = zipfile.ZipInfo(name)
    item.create_system = 3  # Unix
    item.external_attr = (stat.S_IFLNK | 0o777) << 16
    return item, target.encode()


def sent(client: Client, path: str, data: bytes) -> tuple[int, str]:
    status, said = client.send("PUT", path, data)
    return status, said.decode()


# ---- Nothing outside ----

UP = [f"{'../' * steps}evil.png" for steps in range(1, 9)]
WINDOWS = [
    r"..\evil.png",
    r"..\..\..\evil.png",
    r"C:\evil.png",
    "C:evil.png",
    r"\\host\share\evil.png",
    r"a\..\evil.png",
]


@pytest.mark.parametrize("page", ["photographs", "studio"])
@pytest.mark.parametrize("name", [*UP, *WINDOWS, "/ROOT/evil.png", "//ROOT/evil.png", "a/../../evil.png", "./evil.png"])
def test_nothing_leaves_the_folder_it_is_for(client: Client, root: Path, folder: Path, name: str, page: str) -> None:
    """Every name is one that would leave it if it were taken as it is: on this system, or on Windows."""
    path = f"{client.new_set()}/uploads" if page == "photographs" else "/studio/uploads"
    place = folder / (f"{path.split('/')[3]}/photos" if page == "photographs" else "uploads/some")
    before = contents(root)
    evil = packed(("inside/good.png", png()), (name.replace("ROOT", str(root).lstrip("/")), png()))
    status, said = sent(client, f"{path}/some.zip", evil)
    new = {root / name for name in contents(root).keys() - before.keys()}
    assert all(item.parent == place for item in new), new
    assert status == 200, said
    assert {item.name for item in new} <= {"good.png", "evil.png", "C_evil.png"} and len(new) == 2
    assert not any(item.is_symlink() for item in new)


@pytest.mark.parametrize("name", [*UP, *WINDOWS, "/ROOT/evil.png", "//ROOT/evil.png", "a/../../evil.png"])
def test_nothing_is_unpacked_outside_even_for_a_moment(tmp_path: Path, name: str) -> None:
    """What is unpacked is moved later, which would hide that it was written elsewhere first."""
    from pipelines.app.common.archives import unpack
    from pipelines.app.common.incoming import Incoming
    from pipelines.app.common.sessions import Session
    from pipelines.app.common.uploads import Limits

    deep = tmp_path.joinpath(*"abcdefghij")
    deep.mkdir(parents=True)
    archive, target = deep / "some.zip", deep / "unpacked"
    archive.write_bytes(packed((name.replace("ROOT", str(tmp_path).lstrip("/")), png())))
    files = unpack(archive, target, Limits(), Incoming(Session("token", deep), 1000, "set"))
    assert {tmp_path / item for item in contents(tmp_path)} == set(files) and len(files) == 1
    assert files[0].parent == target and not any(letter in files[0].name for letter in "\\/:")


@pytest.mark.parametrize("target", ["/etc/passwd", "../../../../x", "good.png"])
def test_links_are_refused(client: Client, root: Path, folder: Path, target: str) -> None:
    path, before = client.new_set(), contents(root)
    for files in ([("good.png", png()), link("evil.png", target)], [link("evil.png", target), ("a/evil.png", png())]):
        status, said = sent(client, f"{path}/uploads/some.zip", packed(*files))
        assert status == 400 and "evil.png is a link" in said
        assert contents(root) == before


def test_a_folder_that_is_a_link_leads_nowhere(client: Client, root: Path, folder: Path) -> None:
    path, before = client.new_set(), contents(root)
    evil = packed(link("out", str(root)), ("out/evil.png", png()))
    assert sent(client, f"{path}/uploads/some.zip", evil)[0] == 200
    new = {root / name for name in contents(root).keys() - before.keys()}
    assert [item.parent.name for item in new] == ["photos"] and not any(item.is_symlink() for item in new)


# ---- Whole or not at all ----


@cache
def failing() -> dict[str, bytes]:
    good = [(f"{number}.png", png(8 + number)) for number in range(5)]
    whole = packed(*good)
    torn = bytearray(packed(*good, ("5.png", bytes(range(256)) * 40), method=zipfile.ZIP_STORED))
    at = torn.index(bytes(range(256)) * 2)
    torn[at : at + 16] = bytes(16)
    return {
        "a picture that is none": packed(*good, ("5.png", b"nothing")),
        "a picture that is none, first": packed(("5.png", b"nothing"), *good),
        "too many pixels": packed(*good, ("5.png", png(600))),
        "too large unpacked": packed(*good, ("5.png", bytes(50_000_000))),
        "damaged in the middle": bytes(torn),
        "cut off": whole[:-30],
        "a name twice": packed(*good, ("again/0.png", png())),
        "too many files": packed(*good, *((f"more{number}.png", png()) for number in range(30))),
        "a text without end": packed(*good, ("lights.txt", bytes(9 << 20))),
    }


@pytest.mark.parametrize("kind", failing())
@pytest.mark.parametrize("page", ["photographs", "studio"])
def test_one_that_fails_leaves_nothing_and_its_retry_works(
    served: tuple[str, Any], client: Client, folder: Path, kind: str, page: str
) -> None:
    session = served[1].state.sessions.find(client.token)
    path = f"{client.new_set()}/uploads/some.zip" if page == "photographs" else "/studio/uploads/some.zip"
    for _ in range(2):
        status, said = sent(client, path, failing()[kind])
        assert status == 400 and "message" in said
        assert not contents(folder) and session.taken == 0 and not list(folder.glob(".*"))
    good = {f"{number}.png": png(8 + number) for number in range(5)}
    assert sent(client, path, packed(*good.items())) == (200, sent_well(page))
    assert {Path(name).name: size for name, size in contents(folder).items()} == {
        name: len(data) for name, data in good.items()
    }
    assert session.taken == sum(map(len, good.values()))


def sent_well(page: str) -> str:
    return '{"files":5}' if page == "photographs" else '{"name":"some"}'


def test_one_that_meets_a_file_of_the_set_adds_nothing(client: Client, folder: Path) -> None:
    path = client.new_set()
    assert sent(client, f"{path}/uploads/3.png", png(30))[0] == 200
    before = contents(folder)
    data = packed(*((f"{number}.png", png()) for number in range(5)))
    status, said = sent(client, f"{path}/uploads/some.zip", data)
    assert status == 400 and "3.png: there are two files of this name" in said
    assert contents(folder) == before
    data = packed(*((f"x{number}.png", png()) for number in range(LIMITS["files"])))
    status, said = sent(client, f"{path}/uploads/some.zip", data)
    assert status == 400 and "more than 20 files" in said and contents(folder) == before


def test_a_move_that_fails_in_the_middle_is_undone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pipelines.app.common import incoming
    from pipelines.app.common.sessions import Session

    session = Session("token", tmp_path)
    folder = tmp_path / "photos"
    folder.mkdir()
    coming = incoming.Incoming(session, 1000, "0" * 16)
    coming.folder.mkdir()
    files = [coming.folder / name for name in ("1.png", "2.png", "3.png")]
    for file in files:
        file.write_bytes(b"x")
    rename = incoming.os.rename

    def failing(source: Path, target: Path) -> None:
        if Path(target) == folder / "3.png":
            raise OSError("no")
        rename(source, target)

    monkeypatch.setattr(incoming.os, "rename", failing)
    with pytest.raises(OSError, match="no"):
        coming.add(files, folder, 10)
    assert not list(folder.iterdir()) and all(file.is_file() for file in files)


def test_maps_that_fail_leave_those_of_the_last_upload(client: Client, folder: Path) -> None:
    assert sent(client, "/studio/uploads/Bricks.zip", packed(("a_Color.png", png())))[0] == 200
    before = contents(folder)
    assert sent(client, "/studio/uploads/Bricks.zip", packed(("b_Color.png", b"no")))[0] == 400
    assert contents(folder) == before and list(before) == ["uploads/Bricks/a_Color.png"]


# ---- No more than they may have ----


def test_an_archive_and_its_files_never_take_more_together_than_allowed(
    served: tuple[str, Any], client: Client, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of three quarters of what is allowed: unpacked in the usual way, both would take one and a half of it."""
    session = served[1].state.sessions.find(client.token)
    noise = [png()[:-12] + bytes(400_000) for _ in range(7)]  # a PNG's header, then anything
    data = packed(*((f"{number}.png", item) for number, item in enumerate(noise)), method=zipfile.ZIP_STORED)
    assert 0.7 * LIMITS["bytes"] < len(data) < 0.8 * LIMITS["bytes"]
    most, extract = [0], archive_files._extract

    def watched(*arguments: Any) -> None:
        extract(*arguments)  # now a file is there twice, packed and unpacked, and nothing else moves
        most.extend([session.taken, sum(contents(folder).values())])

    monkeypatch.setattr(archive_files, "_extract", watched)
    answer = sent(client, f"{client.new_set()}/uploads/some.zip", data)
    assert len(most) == 1 + 2 * 7
    assert answer == (200, '{"files":7}')
    assert max(most) <= LIMITS["bytes"]
    assert session.taken == sum(contents(folder).values()) == sum(map(len, noise))


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_methods_that_are_unpacked_whole_are_refused(client: Client, method: int) -> None:
    """A megabyte of them can hold gigabytes, which `zipfile` would unpack into memory at once."""
    status, said = sent(client, f"{client.new_set()}/uploads/some.zip", packed(("a.png", png()), method=method))
    assert status == 400 and "make the ZIP with Deflate" in said


def test_a_password_is_said(client: Client) -> None:
    data = bytearray(packed(("a.png", png())))
    for at, field in ((data.index(b"PK\3\4"), 6), (data.index(b"PK\1\2"), 8)):
        data[at + field] |= 1
    status, said = sent(client, f"{client.new_set()}/uploads/some.zip", bytes(data))
    assert status == 400 and "needs a password" in said


def test_a_table_of_contents_without_end_is_not_read(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    from sdps.photos.pictures.sources import archive_files

    monkeypatch.setattr(archive_files, "MOST_LISTING", 100_000)
    data = packed(*((f"{number}.dat", b"") for number in range(3000)), ("a.png", png()))
    status, said = sent(client, f"{client.new_set()}/uploads/some.zip", data)
    assert status == 400 and "contains too many files" in said


def test_files_that_share_their_bytes_are_refused(client: Client, folder: Path) -> None:
    """A thousand names for one piece of data make a small archive large."""
    data = bytearray(packed(("a.png", png()), ("b.png", png())))
    second = data.rindex(b"PK\1\2")
    struct.pack_into("<I", data, second + 42, 0)
    status, said = sent(client, f"{client.new_set()}/uploads/some.zip", bytes(data))
    assert status == 400 and "cannot be unpacked" in said and not contents(folder)


def test_what_is_of_no_use_is_passed_over(client: Client, folder: Path) -> None:
    files = ["__MACOSX/a.png", ".hidden/a.png", "a/._b.png", "Thumbs.db", "x.sh", " . .png", "deep/er/folder/good.png"]
    data = packed(*((name, png()) for name in files))
    assert sent(client, f"{client.new_set()}/uploads/some.zip", data) == (200, '{"files":1}')
    assert [Path(name).name for name in contents(folder)] == ["good.png"]
