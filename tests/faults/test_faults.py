"""Full disks and lost power, injected at every file operation; kill -9 of real commands is slow, see `make faults`."""

import builtins
import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from data_folders import good_folder, scene_of, sphere_shard
from fault_run import FAULTS, ROOT, digests, disturbed, finished, left_over

from pipelines.cli import main
from pipelines.evaluate.benchmarks.lit_photographs import object_folders
from pipelines.evaluate.report.sections import FOLDER, Section, SectionWriter, read_sections
from pipelines.rendering.render_data import write_preview
from render.exchange.export import claim
from render.records.shards import read_shard, write_shard
from render.shared import files
from render.shared.errors import InputError
from render.shared.images import write_png
from render.shared.temporary import temporary_path
from sdps.methods import pretrained
from sdps.models.checkpoint import load_state, save_state


def _folder(path: Path) -> None:
    with files.atomic_folder(path) as temporary:
        for number in range(3):
            write_png(temporary / f"{number}.png", np.zeros((4, 4), np.uint8))


WRITERS = {
    "text": lambda path: files.write_text(path, "text"),
    "shard": lambda path: write_shard(path, sphere_shard(count=3)),
    "state": lambda path: save_state(path, {"step": 1}),
    "folder": _folder,
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_disk_that_fails_leaves_what_was_there(name: str, call: str, tmp_path: Path, monkeypatch) -> None:
    target = tmp_path / f"a{'.exr' if name == 'shard' else ''}"
    WRITERS[name](target)
    before = digests(tmp_path, ("**/*",))

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, call, full)
    with pytest.raises(InputError, match=r"cannot be written \(No space left on device\); free space"):
        WRITERS[name](target)
    monkeypatch.undo()
    assert digests(tmp_path, ("**/*",)) == before and not left_over(tmp_path)


class Disk:
    """A model of a disk that loses power: what was written is on it only after `fsync`; a renaming may outrun it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.safe: set[int] = set()
        self.torn: list[str] = []
        real_sync, real_replace = os.fsync, os.replace

        def sync(descriptor: int) -> None:
            real_sync(descriptor)
            self.safe.add(os.fstat(descriptor).st_ino)

        def replace(source: Path, target: Path) -> None:
            inside = [path for path in Path(source).rglob("*") if path.is_file()] if Path(source).is_dir() else [source]
            if ".old" not in str(target):
                self.torn += [str(path) for path in inside if os.stat(path).st_ino not in self.safe]
            real_replace(source, target)

        monkeypatch.setattr(os, "fsync", sync)
        monkeypatch.setattr(os, "replace", replace)


@pytest.mark.parametrize("name", WRITERS)
def test_no_file_gets_its_name_before_its_bytes_are_on_the_disk(name: str, tmp_path: Path, monkeypatch) -> None:
    disk = Disk(monkeypatch)
    target = tmp_path / f"a{'.exr' if name == 'shard' else ''}"
    WRITERS[name](target)
    WRITERS[name](target)
    assert disk.safe and not disk.torn


STRUCK = """
import os, signal, sys
from pathlib import Path
from render.shared import files

strike, out = sys.argv[1], Path(sys.argv[2])

def write(text, moment=0):
    steps = 0

    def struck(real):
        def step(*words, **options):
            nonlocal steps
            steps += 1
            if steps == moment:
                strike_now()
            result = real(*words, **options)
            steps += 1
            if steps == moment:
                strike_now()
            return result
        return step

    def strike_now():
        if strike == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        raise KeyboardInterrupt

    for name in ("replace", "rename", "rmdir", "unlink", "fsync") if moment else ():
        setattr(os, name, struck(getattr(os, name)))
    with files.atomic_folder(out / "a[1]") as folder:
        for name in ("one", "two"):
            (folder / name).write_text(text)

for moment in range(1, 999):
    write("old")
    child = os.fork()
    if child == 0:
        try:
            write("new", moment)
        except KeyboardInterrupt:
            os._exit(130)
        os._exit(0)
    ended = os.waitpid(child, 0)[1]
    before = sorted(path.name for path in out.iterdir())
    if moment % 2:
        files.tidy(out)
    else:
        with files.atomic_folder(out / "b"):
            pass
        (out / "b").rmdir()
    texts = sorted(path.read_text() for path in (out / "a[1]").iterdir())
    left = [path.name for path in out.iterdir() if path.name != "a[1]"]
    print(ended, "a[1]" in before, *texts, *left, sep="|", flush=True)
    if ended == 0:
        break
"""


@pytest.mark.parametrize("strike", ["kill", "Ctrl-C"])
def test_a_folder_replaced_is_the_old_one_or_the_new_one_whenever_the_writer_ends(strike: str, tmp_path: Path) -> None:
    """Struck before and after every renaming, removal and flush; what a kill moved aside comes back to the next run."""
    words = [sys.executable, "-c", STRUCK, strike, str(tmp_path)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True)
    rows = [line.split("|") for line in done.stdout.splitlines()]
    kinds = [row[2:] for row in rows]
    assert len(rows) > 20 and rows[-1][0] == "0" and kinds.count(["old"] * 2) > 5 and kinds.count(["new"] * 2) > 5
    assert kinds == sorted(kinds, reverse=True) and {*map(tuple, kinds)} == {("old", "old"), ("new", "new")}
    gone = [row for row in rows if row[1] == "False"]
    assert (len(gone) > 0) == (strike == "kill")  # between the renamings; Ctrl-C has its chance to put the old one back


def test_a_report_shows_what_a_killed_run_moved_aside_and_nothing_half_written(tmp_path: Path) -> None:
    SectionWriter(Section(name="a", title="old", text="")).write(tmp_path)
    place = tmp_path / FOLDER / "a"
    place.rename(temporary_path(place, "old"))
    shown = [section.title for _, section in read_sections(tmp_path)]
    assert shown == ["old"] and not left_over(tmp_path)
    shutil.copytree(place, temporary_path(place))  # by another process, so far
    assert [section.title for _, section in read_sections(tmp_path)] == ["old"]


def test_what_is_half_written_is_neither_trained_nor_an_object_nor_in_the_way(tmp_path: Path) -> None:
    """What a run that was killed, or one on another machine, left: weights, an object's folder, the first file."""
    half = tmp_path / "models" / "nenet" / "nenet.safetensors"
    half.parent.mkdir(parents=True)
    temporary_path(half, suffix=True).touch()
    assert pretrained.list_trained(tmp_path) == []
    for folder in (tmp_path / "cat", temporary_path(tmp_path / "dog")):
        folder.mkdir()
        (folder / "light_directions.txt").touch()
    assert object_folders(tmp_path, "light_directions.txt", "") == [tmp_path / "cat"]
    tree = tmp_path / "tree"
    tree.mkdir()
    temporary_path(tree / "export.json", suffix=True).touch()
    claim(tree, {"layout": "psfcn"})
    assert (tree / "export.json").is_file()


@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_what_was_torn_is_not_accepted(share: float, tmp_path: Path) -> None:
    """Files as a file system without order leaves them: cut short, or of full length with zeros at the end."""
    shard = sphere_shard(count=3)
    for name, write, read in (
        ("a.exr", lambda path: write_shard(path, shard), lambda path: read_shard(path, scene_of(shard))),
        ("a.pt", lambda path: save_state(path, {"weights": np.zeros(9).tolist()}), load_state),
    ):
        write(tmp_path / name)
        data = (tmp_path / name).read_bytes()
        kept = int(share * len(data))
        for torn in (data[:kept], data[:kept] + bytes(len(data) - kept)):
            (tmp_path / name).write_bytes(torn)
            if name == "a.pt" and torn[: -len(data) // 10] == data[: -len(data) // 10]:
                continue  # an archive's last bytes may matter to nobody
            with pytest.raises(InputError, match=name):
                read(tmp_path / name)


def test_a_folder_that_may_not_be_written_is_one_line(tmp_path: Path, monkeypatch, capsys) -> None:
    good_folder(tmp_path / "data")
    real = builtins.open

    def refuse(file, mode="r", *rest, **options):
        if "w" in mode or "a" in mode:
            raise PermissionError(errno.EROFS, "Read-only file system", str(file))
        return real(file, mode, *rest, **options)

    monkeypatch.setattr(Path, "mkdir", lambda self, *_, **__: refuse(self, "w"))
    assert main(["data", "export", str(tmp_path / "data"), "--layout", "psfcn", "--out", str(tmp_path / "tree")]) == 2
    said = capsys.readouterr().err
    assert "Read-only file system" in said and "Traceback" not in said
    assert not (tmp_path / "tree").exists()


def test_a_line_that_the_disk_refuses_is_told_once(tmp_path: Path) -> None:
    """In a process of its own, whose files may not grow beyond 60 bytes, as on a full disk."""
    code = (
        "import resource, sys\nfrom pathlib import Path\nfrom sdps.training.loggers import JsonlLogger\n"
        "from render.records.ledger import Ledger\nfrom render.shared.errors import InputError\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (60, 60))\n"
        "logger, folder = JsonlLogger(Path(sys.argv[1]) / 'metrics.jsonl', 0), Path(sys.argv[1])\n"
        "try:\n    [logger.log(step, {'loss': 0.5}) for step in range(9)]\n"
        "except InputError as error:\n    print(error)\n"
        "logger.close()\n"
        "try:\n    with Ledger(folder) as ledger:\n        [ledger.add({'id': str(k)}) for k in range(9)]\n"
        "except InputError as error:\n    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path], capture_output=True, text=True, check=True, cwd=ROOT)
    told = done.stdout.splitlines()
    assert len(told) == 2 and all("cannot be written (File too large)" in line for line in told), done.stderr


def test_a_folder_that_vanished_while_it_was_rendered_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the shards that were rendered are gone"):
        write_preview([scene_of(sphere_shard(count=3))], tmp_path / "data")


@pytest.mark.slow
def test_an_export_that_is_killed_again_and_again_ends_in_the_same_bytes(tmp_path: Path) -> None:
    import random

    good_folder(tmp_path / "data")
    trees = [tmp_path / kind / "tree" for kind in ("whole", "broken")]
    words = [["data", "export", str(tmp_path / "data"), "--layout", "psfcn", "--out", str(tree)] for tree in trees]
    code, seconds = finished(words[0])
    assert code == 0
    rng = random.Random(0)
    for fault in list(FAULTS) * 2:
        found = disturbed(words[1], fault, seconds, rng, trees[1].parent)
        assert not found["hang"] and not found["traceback"], (fault, found)
    assert finished(words[1])[0] == 0
    assert digests(trees[0], ("**/*.*",)) == digests(trees[1], ("**/*.*",)) and not left_over(trees[1])
