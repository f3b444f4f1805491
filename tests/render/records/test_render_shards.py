"""The shard: exact round trip, legible to any EXR viewer, whole or absent, and nothing damaged accepted."""

import errno
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from render.records import shards
from render.records.manifest import SceneSpec, View
from render.records.shards import Shard, read_shard, to_half, write_exr, write_shard
from render.shared.errors import InputError

SIZE, COUNT = 16, 3


@pytest.fixture
def shard() -> Shard:
    rng = np.random.default_rng(5)
    mask = rng.random((SIZE, SIZE)) > 0.4
    normals = rng.normal(size=(SIZE, SIZE, 3))
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True) * mask[..., None]
    lights = rng.normal(size=(COUNT, 3)) + np.array([0, 0, 4])
    return Shard(
        scene_id="blobby-00001-v0-m0",
        images=to_half(rng.exponential(size=(COUNT, SIZE, SIZE, 3)).astype(np.float32)),
        normals=normals.astype(np.float32),
        depth=(rng.normal(size=(SIZE, SIZE)) * mask).astype(np.float32),
        mask=mask,
        coverage=rng.random((SIZE, SIZE)).astype(np.float32),
        light_directions=(lights / np.linalg.norm(lights, axis=1, keepdims=True)).astype(np.float32),
        provenance={"seed": 17, "material": "chrome", "mitsuba": "3.9.1", "exposure": 0.5},
    )


@pytest.fixture
def scene(shard) -> SceneSpec:
    return SceneSpec(
        id=shard.scene_id, seed=17, split="train", shape="blobby:1", material="chrome", view=View(),
        lights=tuple(tuple(float(c) for c in row) for row in shard.light_directions), size=SIZE, spp=4, bounces=1,
    )  # fmt: skip


@pytest.fixture
def path(shard, scene, tmp_path) -> Path:
    sealed = replace(shard, provenance=shard.provenance | {"spec": scene.digest()})
    write_shard(tmp_path / "shards" / "a.exr", sealed)
    return tmp_path / "shards" / "a.exr"


def files(folder: Path) -> list[str]:
    return sorted(item.name for item in folder.iterdir())


def test_positions_of_near_lights_and_the_camera_come_back(shard, scene, tmp_path):
    near = replace(scene, light_distances=(2.0, 3.0, 2.5), view=View(offset=(0.1, 0.2), camera_distance=4.0))
    about = {"spec": near.digest(), "camera_distance": 4.0, "light_reference": "0.1 0.2 0"}
    written = replace(shard, light_positions=near.light_positions(), provenance=about)
    write_shard(tmp_path / "a.exr", written)
    read = read_shard(tmp_path / "a.exr", near)
    np.testing.assert_array_equal(read.light_positions, near.light_positions())
    assert read.camera_distance == 4.0 and read.centre.tolist() == [0.1, 0.2, 0.0]
    part = OpenEXR.File(str(tmp_path / "a.exr")).parts[2]
    np.testing.assert_array_equal(np.asarray(part.header["ps:light_pos"], np.float32), near.light_positions()[1])
    for other in (scene, replace(near, light_distances=(2.0, 3.0, 2.6))):
        with pytest.raises(InputError, match="light positions differ from the manifest"):
            read_shard(tmp_path / "a.exr", other)
    assert shard.light_positions is None and shard.camera_distance is None


def test_round_trip_is_exact(path, shard, scene):
    read = read_shard(path, scene)
    for name in ("images", "normals", "depth", "mask", "coverage", "light_directions"):
        array, expected = getattr(read, name), getattr(shard, name)
        assert array.dtype == expected.dtype and array.tobytes() == expected.tobytes(), name
    assert read.scene_id == shard.scene_id and read.provenance == shard.provenance | {"spec": scene.digest()}
    assert files(path.parent) == ["a.exr"]


def test_same_shard_same_bytes(path, scene):
    write_shard(path.with_name("b.exr"), read_shard(path, scene))
    assert shards.file_hash(path) == shards.file_hash(path.with_name("b.exr"))


def test_an_ordinary_reader_finds_standard_parts_and_channels(path, shard):
    parts = OpenEXR.File(str(path), separate_channels=True).parts
    assert [part.name() for part in parts] == ["gt", "L000", "L001", "L002"]
    assert set(parts[0].channels) == {"normal.X", "normal.Y", "normal.Z", "Z", "mask", "coverage"}
    assert parts[0].channels["normal.Y"].pixels.dtype == np.float32
    assert set(parts[1].channels) == {"R", "G", "B"}
    np.testing.assert_array_equal(parts[2].channels["G"].pixels, shard.images[1, ..., 1])
    assert all(part.header["compression"] == OpenEXR.ZIP_COMPRESSION for part in parts)
    np.testing.assert_array_equal(parts[3].header["ps:light_dir"], shard.light_directions[2])
    assert parts[0].header["ps:material"] == "chrome" and parts[0].header["ps:seed"] == 17


def test_every_truncation_is_refused(path, scene, capfd):
    data = path.read_bytes()
    for length in [0, 1, 4, 100, 1000, *range(2000, len(data), len(data) // 40), len(data) - 1]:
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match=r"a\.exr: .*render it again"):
            read_shard(path, scene)
    path.write_bytes(data + b"\0")
    with pytest.raises(InputError, match="altered"):
        read_shard(path)
    assert capfd.readouterr().err == ""  # refused before OpenEXR complains on its own


def test_every_altered_byte_is_refused(path, scene):
    data = path.read_bytes()
    header = data.index(b"ps:digest") + 100
    for position in [*range(header), *range(header, len(data), 37), len(data) - 1]:
        altered = bytearray(data)
        altered[position] ^= 0x20
        path.write_bytes(altered)
        with pytest.raises(InputError):
            read_shard(path, scene)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"id": "other"}, "holds scene"),
        ({"lights": ((0.0, 0.0, 1.0),) * COUNT}, "light directions"),
        ({"lights": ((0.0, 0.0, 1.0),) * 2}, "3 lights, the manifest says 2"),
        ({"size": 32}, "the manifest says 32"),
        ({"seed": 18}, "another manifest line"),
        ({"shape": "blobby:2"}, "another manifest line"),
        ({"view": View(scale=0.5)}, "another manifest line"),
        ({"spp": 5}, "another manifest line"),
    ],
)
def test_another_manifest_line_is_refused(path, scene, change, message):
    with pytest.raises(InputError, match=message):
        read_shard(path, replace(scene, **change))


def test_foreign_and_missing_files_are_refused(tmp_path):
    foreign = tmp_path / "foreign.exr"
    write_exr(foreign, [("rgba", {}, {"RGB": np.ones((4, 4, 3), np.float16)})])
    with pytest.raises(InputError, match="not a shard"):
        read_shard(foreign)
    write_exr(foreign, [("left", {"ps:digest": "0" * 64}, {"RGB": np.ones((4, 4, 3), np.float16)})])
    with pytest.raises(InputError, match="not a shard"):
        read_shard(foreign)
    foreign.write_text("P6 not an EXR")
    with pytest.raises(InputError, match="not a shard"):
        read_shard(foreign)
    with pytest.raises(InputError, match="no such shard"):
        read_shard(tmp_path / "absent.exr")
    with pytest.raises(InputError, match="cannot be read"):
        read_shard(tmp_path)


@pytest.mark.parametrize("field", ["images", "normals", "depth", "coverage"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_non_finite_values_are_refused_and_leave_nothing(shard, tmp_path, field, value):
    array = getattr(shard, field).copy()
    array.flat[7] = value
    with pytest.raises(InputError, match="infinite or NaN"):
        write_shard(tmp_path / "a.exr", replace(shard, **{field: array}))
    assert files(tmp_path) == []


def test_wrong_types_and_shapes_are_refused(shard):
    for change in (
        {"images": shard.images.astype(np.float32)},
        {"normals": shard.normals[..., :2]},
        {"mask": shard.mask.astype(np.uint8)},
        {"light_directions": shard.light_directions[:2]},
    ):
        with pytest.raises(InputError, match=f"{next(iter(change))} must be"):
            replace(shard, **change)


def fail(error: Exception):
    """Return a stand-in for OpenEXR.File whose write leaves half a file and fails."""

    class Failing:
        def __init__(self, *_args) -> None:
            pass

        def write(self, name: str) -> None:
            Path(name).write_bytes(b"half")
            raise error

    return Failing


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), RuntimeError("write failed")])
def test_a_full_disk_is_one_line_and_leaves_the_old_file(path, shard, monkeypatch, error):
    before = path.read_bytes()
    monkeypatch.setattr(OpenEXR, "File", fail(error))
    with pytest.raises(InputError, match=r"a\.exr: cannot be written .*free space") as caught:
        write_shard(path, shard)
    assert "\n" not in str(caught.value)
    assert path.read_bytes() == before and files(path.parent) == ["a.exr"]


def test_an_interrupted_write_leaves_nothing(shard, tmp_path, monkeypatch):
    monkeypatch.setattr(OpenEXR, "File", fail(KeyboardInterrupt()))
    with pytest.raises(KeyboardInterrupt):
        write_shard(tmp_path / "a.exr", shard)
    assert files(tmp_path) == []


@pytest.mark.parametrize(
    "view",
    [
        lambda a: a[..., :3], lambda a: a[:, ::-1, :3], lambda a: a[::2, 1:, 1:], lambda a: a.swapaxes(0, 1)[..., :3],
        lambda a: np.asfortranarray(a[..., :3]), lambda a: np.moveaxis(np.moveaxis(a, 2, 0)[:3].copy(), 0, 2),
        lambda a: a[..., 0], lambda a: a[..., 1].T,
    ],
)  # fmt: skip
def test_views_are_written_right(tmp_path, view):
    """OpenEXR's binding alone writes wrong pixels for each of these."""
    array = view(np.arange(10 * 12 * 4, dtype=np.float32).reshape(10, 12, 4))
    key = "RGB" if array.ndim == 3 else "Z"
    write_exr(tmp_path / "view.exr", [("gt", {}, {key: array})])
    np.testing.assert_array_equal(OpenEXR.File(str(tmp_path / "view.exr")).parts[0].channels[key].pixels, array)


def test_two_channels_or_doubles_are_a_defect(tmp_path):
    for array in (np.ones((4, 4, 2), np.float32), np.ones((4, 4, 1), np.float32), np.ones((4, 4), np.float64)):
        with pytest.raises(AssertionError):
            write_exr(tmp_path / "x.exr", [("gt", {}, {"RGB": array})])


def test_half_precision_saturates():
    rounded = to_half(np.array([0.1, 65504.0, 65520.0, 1e9, np.nan], np.float32))
    assert rounded.dtype == np.float16
    np.testing.assert_array_equal(rounded[1:4], np.float16(65504))
    assert np.isnan(rounded[4])


# ---- Spatially-varying scenes -----------------------------------------------------------------------


@pytest.fixture
def varying(shard) -> Shard:
    """Return a shard of three materials."""
    weights = np.random.default_rng(6).random((3, SIZE, SIZE)).astype(np.float32)
    weights = np.where(shard.mask, weights / weights.sum(0), 0).astype(np.float32)
    return replace(shard, weights=weights, materials=("chrome", "lambertian:0.8/0.3/0.1", "folder/mine.binary"))


def test_material_weights_make_the_round_trip(varying, tmp_path):
    path = tmp_path / "a.exr"
    write_shard(path, varying)
    read = read_shard(path)
    assert read.materials == varying.materials
    assert read.weights.dtype == np.float32 and read.weights.tobytes() == varying.weights.tobytes()
    for name in ("images", "normals", "depth", "mask", "coverage", "light_directions"):
        assert getattr(read, name).tobytes() == getattr(varying, name).tobytes(), name
    parts = OpenEXR.File(str(path), separate_channels=True).parts
    assert [part.name() for part in parts] == ["gt", "materials", "L000", "L001", "L002"]
    assert set(parts[1].channels) == {"w0", "w1", "w2"}
    assert parts[1].header["ps:materials"] == "chrome+lambertian:0.8/0.3/0.1+folder/mine.binary"


def test_more_weights_than_a_digit_keep_their_order(varying, tmp_path):
    """OpenEXR sorts channels by name, where w10 comes before w2."""
    weights = np.arange(12, dtype=np.float32)[:, None, None] + np.zeros((SIZE, SIZE), np.float32)
    many = replace(varying, weights=weights, materials=tuple(f"lambertian:0.{k + 10}" for k in range(12)))
    write_shard(tmp_path / "a.exr", many)
    np.testing.assert_array_equal(read_shard(tmp_path / "a.exr").weights, weights)


def test_a_shard_of_one_material_has_no_weights(path):
    read = read_shard(path)
    assert read.weights is None and read.materials == ()
    assert b"ps:materials" not in path.read_bytes()


@pytest.mark.parametrize(
    "change",
    [
        {"materials": ("chrome",)}, {"materials": ()}, {"weights": None},
        {"weights": np.zeros((3, SIZE, SIZE - 1), np.float32)}, {"weights": np.zeros((3, SIZE, SIZE))},
        {"weights": np.zeros((2, SIZE, SIZE), np.float32)}, {"weights": np.zeros((3, SIZE, SIZE, 1), np.float32)},
    ],
)  # fmt: skip
def test_weights_that_do_not_fit_are_refused(varying, change):
    with pytest.raises(InputError, match=r"weights must be float32 of shape \(\d, 16, 16\)"):
        replace(varying, **change)


def test_weights_that_are_not_finite_are_refused(varying, tmp_path):
    weights = varying.weights.copy()
    weights[1, 2, 3] = np.nan
    with pytest.raises(InputError, match=r"materials\.w1: .*infinite or NaN"):
        write_shard(tmp_path / "a.exr", replace(varying, weights=weights))
    assert files(tmp_path) == []


def test_damaged_weights_are_refused(varying, tmp_path):
    path = tmp_path / "a.exr"
    write_shard(path, varying)
    data = path.read_bytes()
    start = data.index(b"ps:materials")
    for position in [*range(start, start + 80), *range(len(data) // 4, len(data), len(data) // 40)]:
        altered = bytearray(data)
        altered[position] ^= 0x01
        path.write_bytes(altered)
        with pytest.raises(InputError, match="altered"):
            read_shard(path)
