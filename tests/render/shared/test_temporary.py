"""Temporary names: one per writer, removed by nobody while the writer may be alive, and folders that come back."""

import errno
import fcntl
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from render.shared import files, storage, temporary
from render.shared.errors import InputError
from render.shared.temporary import is_temporary, may_be_alive, temporary_path, tidy

ROOT = Path(__file__).resolve().parents[3]
HOLD = """
import sys, time
from render.shared.files import atomic_folder
with atomic_folder(sys.argv[1]) as folder:
    (folder / "half").write_text("half")
    print(folder.name, flush=True)
    sys.stdin.read()
"""


def of_another_machine(path: Path) -> Path:
    return path.with_name(path.name.replace(f"-{temporary._machine()}-", "-00000000-"))


@pytest.mark.parametrize("name", ["a", "a.exr", ".a", "a.b.c", "a[1-3]*?.exr", "\u0101" * 120 + ".json", "x" * 250])
@pytest.mark.parametrize("suffix", [False, True])
def test_a_name_differs_from_others_keeps_its_suffix_and_fits(name: str, suffix: bool, tmp_path: Path) -> None:
    path = tmp_path / name
    made = temporary_path(path, suffix=suffix)
    made.write_text("")
    assert is_temporary(made.name) and not is_temporary(name)
    assert made.suffix == (path.suffix if suffix and path.suffix else ".tmp")
    assert may_be_alive(made, lambda: float("inf"))


@pytest.mark.parametrize("name", ["a", ".a", ".tmp.exr", "a.1.tmp", ".hidden.json", ".storage.json"])
def test_other_names_are_nobodys_temporary_files(name: str) -> None:
    assert not is_temporary(name)


def test_a_number_that_another_process_has_by_now_is_no_owner(tmp_path: Path) -> None:
    path = temporary_path(tmp_path / "a")
    start = temporary._start(os.getpid())
    if not start:
        pytest.skip("this system does not tell when processes start")
    path.with_name(path.name.replace(f"-{start}-", f"-{start + 1}-")).mkdir()
    tidy(tmp_path)
    assert not list(tmp_path.iterdir())


def test_what_ended_and_was_not_waited_for_is_dead() -> None:
    with subprocess.Popen([sys.executable, "-c", ""], stdout=subprocess.PIPE) as process:
        process.stdout.read()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert temporary._runs(process.pid, 1) is False


@pytest.mark.parametrize("name", ["tree", "tree[0-9]", "t*e"])
def test_a_folder_that_another_process_is_writing_is_left_alone(name: str, tmp_path: Path) -> None:
    """As two exports into one tree: the second must not remove what the first has written so far."""
    words = [sys.executable, "-c", HOLD, str(tmp_path / name)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        theirs = tmp_path / process.stdout.readline().strip()
        with files.atomic_folder(tmp_path / name) as folder:
            (folder / "mine").write_text("")
        assert (theirs / "half").read_text() == "half"
        process.kill()
    with files.atomic_folder(tmp_path / name) as folder:
        (folder / "again").write_text("")
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")] == [name, f"{name}/again"]


def test_names_like_a_pattern_take_nothing_of_others(tmp_path: Path) -> None:
    other = tmp_path / temporary_path(tmp_path / "a1").name.replace(f"-{os.getpid()}-", "-999999999-")
    kept = of_another_machine(other)
    for folder in (other, kept):
        folder.mkdir()
    with files.atomic_folder(tmp_path / "a[1]"):
        pass
    assert {path.name for path in tmp_path.iterdir()} == {"a[1]", kept.name}  # of the dead, whatever its name


def test_another_machines_folder_moved_aside_comes_back_or_goes_by_its_age(tmp_path: Path, monkeypatch) -> None:
    old = of_another_machine(temporary_path(tmp_path / "a", "old"))
    old.mkdir()
    (old / "file").write_text("old")
    tidy(tmp_path)
    assert (tmp_path / "a" / "file").read_text() == "old" and not old.exists()
    old.mkdir()
    tidy(tmp_path)
    assert old.exists()
    monkeypatch.setattr(temporary, "AGE", -60.0)
    tidy(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"a"}


def test_a_name_too_long_to_be_kept_whole_comes_back_to_who_asks_for_it(tmp_path: Path) -> None:
    name = "x" * 240
    temporary_path(tmp_path / name, "old").mkdir()
    tidy(tmp_path)
    assert not (tmp_path / name).exists() and len(list(tmp_path.iterdir())) == 1
    tidy(tmp_path, "other", name)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_threads_that_write_one_path_do_not_mix(tmp_path: Path) -> None:
    together = threading.Barrier(8)

    def write(number: int) -> None:
        together.wait()
        for _ in range(20):
            with files.atomic_path(tmp_path / "a.txt") as path, path.open("w") as handle:
                for _ in range(50):
                    handle.write(str(number))

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, range(8)))
    text = (tmp_path / "a.txt").read_text()
    assert len(text) == 50 and len(set(text)) == 1 and len(list(tmp_path.iterdir())) == 1


def test_threads_that_replace_one_folder_leave_a_whole_one(tmp_path: Path) -> None:
    together, names = threading.Barrier(4), [f"{number}.txt" for number in range(5)]

    def write(number: int) -> None:
        together.wait()
        for _ in range(10):
            with files.atomic_folder(tmp_path / "a") as folder:
                for name in names:
                    (folder / name).write_text(str(number))

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write, range(4)))
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == names
    assert len({path.read_text() for path in (tmp_path / "a").iterdir()}) == 1


def test_a_folder_is_put_in_place_however_often_another_process_is_faster(tmp_path: Path, monkeypatch) -> None:
    real, faster = os.replace, iter(range(40))

    def replace(source: Path, target: Path) -> None:
        if target == tmp_path / "a" and next(faster, None) is not None:
            target.mkdir()
            (target / "theirs").write_text("")
        real(source, target)

    monkeypatch.setattr(os, "replace", replace)
    with files.atomic_folder(tmp_path / "a") as folder:
        (folder / "ours").write_text("")
    assert next(faster, None) is None
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["ours"]


def test_a_folder_that_may_not_be_put_in_place_fails_at_once(tmp_path: Path, monkeypatch) -> None:
    def replace(*_paths: Path) -> None:
        raise PermissionError(errno.EPERM, "not permitted")

    (tmp_path / "a").mkdir()
    monkeypatch.setattr(os, "replace", replace)
    monkeypatch.setattr(time, "sleep", lambda _: pytest.fail("waited"))
    with pytest.raises(InputError, match="not permitted"), files.atomic_folder(tmp_path / "a"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_link_or_a_file_in_the_place_of_a_folder_is_replaced_itself(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "kept").write_text("")
    (tmp_path / "link").symlink_to("there")
    (tmp_path / "gone").symlink_to("nowhere")
    (tmp_path / "file").write_text("")
    for name in ("link", "gone", "file"):
        with files.atomic_folder(tmp_path / name) as folder:
            (folder / "new").write_text("")
        assert [path.name for path in (tmp_path / name).iterdir()] == ["new"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "gone", "link", "there"]
    assert (tmp_path / "there" / "kept").is_file()


def test_what_is_flushed_was_opened_for_writing_where_it_may_be(tmp_path: Path, monkeypatch) -> None:
    """Windows refuses to flush what was opened for reading."""
    flushed = {}

    def sync(descriptor: int) -> None:
        mode = fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE
        flushed[os.path.basename(os.readlink(f"/proc/self/fd/{descriptor}"))] = mode

    monkeypatch.setattr(os, "fsync", sync)
    with files.atomic_folder(tmp_path / "a") as folder:
        (folder / "b").mkdir()
        (folder / "b" / "c").write_text("")
    assert flushed["c"] == os.O_RDWR and flushed["b"] == flushed[tmp_path.name] == os.O_RDONLY
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    files._flush(tmp_path / "a" / "b" / "c")
    assert flushed["c"] == os.O_RDONLY


def test_the_store_that_is_a_folder_names_and_hides_what_is_being_written(tmp_path: Path) -> None:
    pytest.importorskip("fsspec")
    store, seen, go = storage.Store(f"file://{tmp_path}"), [], threading.Barrier(2)
    driver, _ = store._open()
    real = driver.pipe_file

    def pipe(path: str, data: bytes, **_: object) -> None:
        real(path, data)
        seen.append((path, set(store.files())))
        go.wait(10)

    class Driver:
        protocol, makedirs, pipe_file = driver.protocol, driver.makedirs, staticmethod(pipe)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda text: storage._put(Driver, f"{tmp_path}/shards/a.exr", text), (b"one", b"two")))
    assert len({path for path, _ in seen}) == 2 and seen[0][1] == set()
    assert set(store.files()) == {"shards/a.exr"} and store.read("shards/a.exr") in (b"one", b"two")


def test_a_disk_that_takes_nothing_more_leaves_the_old_folder(tmp_path: Path, monkeypatch) -> None:
    """The second renaming fails: what was moved aside comes back at once."""
    with files.atomic_folder(tmp_path / "a") as folder:
        (folder / "old").write_text("")
    real = os.replace

    def replace(source: Path, target: Path) -> None:
        if Path(target) == tmp_path / "a":
            raise OSError(28, "No space left on device")
        real(source, target)

    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(InputError, match="No space left"), files.atomic_folder(tmp_path / "a") as folder:
        (folder / "new").write_text("")
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")] == ["a", "a/old"]
