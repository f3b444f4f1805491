"""A small seeded part of `make fuzz`; and that its corpus is sound, or every mutation would be refused for nothing."""

import gzip
import io
import struct
import zlib
from contextlib import redirect_stderr
from pathlib import Path

import pytest
from fuzz_mutate import sealed_png, sealed_shard
from fuzz_run import BAD, Corpus, _peak, _reset_peak, judged, run, table
from fuzz_targets import TARGETS

from render.shapes.files.mesh_file import load_mesh
from render.shared import images
from render.shared.errors import InputError
from render.shared.imaging import environments
from sdps.photos import picture_file


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Corpus:
    return Corpus(tmp_path_factory.mktemp("corpus"))


@pytest.mark.parametrize("name", [name for name in TARGETS if name not in ("MERL tables", "command lines")])
def test_what_is_mutated_was_sound(name: str, corpus: Corpus) -> None:
    files = corpus.files(name)
    assert files
    for path, data in files:
        said = io.StringIO()
        with redirect_stderr(said):
            try:
                TARGETS[name].read(corpus.place(name), path)
            except InputError as error:  # of one reader of a file that several read
                assert path.name in ("named.txt", "lights.txt", "alpha.png"), error
        assert "sdps:" not in said.getvalue(), said.getvalue()
        for seal in {".png": [sealed_png], ".exr": [sealed_shard]}.get(path.suffix, []):
            assert seal(data) == data


def test_no_mutated_file_ends_in_more_than_a_line(tmp_path: Path) -> None:
    counts = run(tmp_path, seed=1, inputs=100, minutes=1.0)
    assert counts
    bad = {key: count for key, count in counts.items() if key[1] in BAD}
    notes = [path.read_text() for path in sorted((tmp_path / "findings").glob("*.txt"))]
    assert not bad, "\n".join([table(counts), *notes])
    again = run(tmp_path, seed=1, inputs=1, minutes=0.5)  # goes on where it was: nothing is left to do
    assert again == counts


def test_refusals_are_judged() -> None:
    assert judged("sdps: a.png: damaged; copy it again\n")[0] == "refused"
    assert judged("sdps: a\nb\n")[0] == judged("sdps: \x1b[31m\n")[0] == "refused badly"


@pytest.mark.parametrize("message", ["a\nb", "a\r\n  b", "a\u2028b", "a \x0c\n b"])
def test_an_input_error_is_one_line(message: str) -> None:
    assert str(InputError(message)) == "a b"


def test_an_input_error_quotes_no_control_characters_and_is_not_endless() -> None:
    assert str(InputError("file \x1b[31m.png: \0; rename it")) == r"file \x1b[31m.png: \x00; rename it"
    long = str(InputError("x.yaml: " + "y" * 10**6 + "; remove it"))
    assert len(long) < 1100 and long.startswith("x.yaml: y") and long.endswith("; remove it")


def _huge_png(side: int) -> bytes:
    head = struct.pack(">2I5B", side, side, 16, 2, 0, 0, 0)
    chunks = [(b"IHDR", head), (b"IDAT", zlib.compress(bytes(100))), (b"IEND", b"")]
    parts = [struct.pack(">I", len(data)) + kind + data + bytes(4) for kind, data in chunks]
    return sealed_png(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


def test_headers_that_announce_gigabytes_are_refused_before_decoding(tmp_path: Path, corpus: Corpus) -> None:
    """Files of a few hundred bytes; decoding them would take gigabytes, so the peak of memory is looked at."""
    (tmp_path / "a.png").write_bytes(_huge_png(12_000))
    files = {path.name: data for path, data in corpus.files("environment maps")}
    (tmp_path / "a.hdr").write_bytes(files["sky.hdr"].replace(b"-Y 8 +X 16", b"-Y 30000 +X 60000"))
    window = b"dataWindow\0box2i\0\x10\0\0\0"
    at = files["sky.exr"].index(window) + len(window)
    exr = files["sky.exr"][:at] + struct.pack("<4i", 0, 0, 39_999, 19_999) + files["sky.exr"][at + 16 :]
    (tmp_path / "a.exr").write_bytes(exr)
    (tmp_path / "a.ply.gz").write_bytes(gzip.compress(bytes(200 << 20)))
    before = _reset_peak()
    for name, read in (
        ("a.png", picture_file.decode), ("a.png", images.read_image), ("a.exr", picture_file.decode),
        ("a.exr", lambda path: environments.load(str(path))), ("a.hdr", lambda path: environments.load(str(path))),
        ("a.ply.gz", load_mesh),
    ):  # fmt: skip
        with pytest.raises(InputError, match=name):
            read(tmp_path / name)
    assert _peak() - before < 400 << 20
