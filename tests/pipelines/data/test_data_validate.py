"""`sdps data validate`: sound data pass, and every kind of damage is found and named."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from data_folders import MATERIALS, good_folder, light_directions, scene_of, sphere_shard, write_folder

from pipelines.cli import main
from render.checks.known_checks import CHECKS, ERROR, check_shard
from render.checks.light_checks import measure_agreement
from render.checks.shard_checks import Limits
from render.checks.validate import validate
from render.records import shards
from render.records.manifest import View
from render.records.shards import HALF_LIMIT, Shard, write_shard
from render.shared.errors import InputError


def found(shard: Shard, **limits) -> set[str]:
    """Return the names of the checks with findings, those without a verdict left out."""
    return {finding.check for finding in check_shard(shard, Limits(**limits))} - {"unresolved"}


def images_of(shard: Shard, values: np.ndarray) -> Shard:
    return replace(shard, images=np.asarray(values).astype(np.float16))


def normals_of(shard: Shard, values: np.ndarray) -> Shard:
    return replace(shard, normals=np.asarray(values).astype(np.float32))


def spoil(array: np.ndarray, value: float) -> np.ndarray:
    array = array.copy()
    array[tuple(length // 2 for length in array.shape)] = value
    return array


def mask_of(shard: Shard, mask: np.ndarray) -> Shard:
    """Change mask and coverage alike, and cut the rest to it."""
    return replace(
        shard,
        mask=mask,
        coverage=mask.astype(np.float32),
        normals=shard.normals * mask[..., None],
        depth=shard.depth * mask,
    )


def darken(shard: Shard, number: int) -> Shard:
    images = shard.images.copy()
    images[number] = 0
    return replace(shard, images=images)


def overhead(shard: Shard) -> int:
    """Return the number of the light nearest to the camera."""
    return int(shard.light_directions[:, 2].argmax())


@pytest.mark.parametrize("material", MATERIALS)
def test_sound_shards_have_no_finding(material):
    assert check_shard(sphere_shard(material), Limits()) == []


def test_relief_is_in_the_normals_and_not_in_the_depth():
    shard = sphere_shard(MATERIALS[0])
    flat = replace(shard, depth=shard.depth * np.float32(0.7))
    assert found(flat) == {"depth"}
    rough = replace(flat, provenance=flat.provenance | {"material": "procedural:weave:3"})
    assert found(rough) == set()
    assert found(replace(rough, depth=-rough.depth)) == {"depth"}


def test_compositions_fill_the_frame_and_have_an_object_everywhere():
    shard = sphere_shard(MATERIALS[0])
    named = replace(shard, objects=shard.mask.astype(np.uint32))
    assert found(named) == set() and found(named, max_area=0.01, min_area=0.0) == set()
    assert found(shard, max_area=0.01, min_area=0.0) == {"mask"}
    assert found(replace(named, objects=named.objects * 0)) == {"objects"}


CORRUPTIONS = {
    "nan image": (lambda s: images_of(s, spoil(s.images, np.nan)), "values"),
    "infinite depth": (lambda s: replace(s, depth=spoil(s.depth, np.inf)), "values"),
    "nan normal": (lambda s: normals_of(s, spoil(s.normals, np.nan)), "values"),
    "negative": (lambda s: images_of(s, spoil(s.images, -0.1)), "values"),
    "saturated": (lambda s: images_of(s, np.where(s.images > 0.4, HALF_LIMIT, s.images)), "values"),
    "long normals": (lambda s: normals_of(s, s.normals * 1.01), "normals"),
    "normals outside": (lambda s: normals_of(s, np.where(s.mask[..., None], s.normals, [0, 0, 1])), "normals"),
    "away from the camera": (lambda s: normals_of(s, s.normals * [1, 1, -1]), "facing"),
    "empty mask": (lambda s: mask_of(s, np.zeros_like(s.mask)), "mask"),
    "tiny mask": (lambda s: mask_of(s, s.mask & (np.arange(s.mask.size).reshape(s.mask.shape) == 500)), "mask"),
    "full mask": (lambda s: replace(s, mask=np.ones_like(s.mask), coverage=np.ones_like(s.coverage)), "mask"),
    "mask and coverage": (lambda s: replace(s, coverage=s.coverage * np.float32(0.4)), "mask"),
    "coverage above 1": (lambda s: replace(s, coverage=s.coverage * np.float32(1.5)), "mask"),
    "depth away": (lambda s: replace(s, depth=-s.depth), "depth"),
    "depth in pixels": (lambda s: replace(s, depth=s.depth * np.float32(16)), "depth"),
    "depth outside": (lambda s: replace(s, depth=s.depth + np.float32(0.5)), "depth"),
    "long lights": (lambda s: replace(s, light_directions=s.light_directions * np.float32(1.1)), "lights"),
    "lights below": (lambda s: replace(s, light_directions=s.light_directions * np.float32([1, 1, -1])), "lights"),
    "one black image": (lambda s: darken(s, overhead(s)), "black"),
    "all black": (lambda s: images_of(s, s.images * 0), "black"),
    "normals x flipped": (lambda s: normals_of(s, s.normals * [-1, 1, 1]), "shading"),
    "axes swapped": (lambda s: normals_of(s, s.normals[..., [1, 0, 2]]), "shading"),
    "normals y flipped": (lambda s: normals_of(s, s.normals * [1, -1, 1]), "shading"),
    "lights x flipped": (lambda s: replace(s, light_directions=s.light_directions * np.float32([-1, 1, 1])), "shading"),
    "lights y flipped": (lambda s: replace(s, light_directions=s.light_directions * np.float32([1, -1, 1])), "shading"),
    "both flipped": (lambda s: replace(s, light_directions=s.light_directions * np.float32([-1, -1, 1])), "shading"),
    "lights reordered": (lambda s: replace(s, light_directions=np.roll(s.light_directions, 3, axis=0)), "shading"),
    "images upside down": (lambda s: images_of(s, s.images[:, ::-1]), "shading"),
    "ambient light": (lambda s: images_of(s, s.images + 0.3 * s.images.max() * s.mask[..., None]), "attached"),
    "too dim": (lambda s: images_of(s, s.images.astype(np.float32) * 5e-6), "exposure"),
}  # fmt: skip


@pytest.mark.parametrize(("corrupt", "check"), CORRUPTIONS.values(), ids=CORRUPTIONS.keys())
def test_every_corruption_is_found(corrupt, check):
    assert check in found(corrupt(sphere_shard()))


@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("axis", [0, 1])
def test_flips_are_found_whatever_the_material(material, axis):
    sign = np.ones(3)
    sign[axis] = -1
    shard = sphere_shard(material)
    assert "shading" in found(normals_of(shard, shard.normals * sign))


def test_shading_is_unresolved_without_evidence():
    few = sphere_shard(count=3)
    assert {finding.check for finding in check_shard(few, Limits())} == {"unresolved"}
    shard = sphere_shard()
    flat = normals_of(shard, shard.mask[..., None] * np.array([0.0, 0.0, 1.0]))
    flat = images_of(
        flat,
        shard.light_directions[:, 2, None, None, None] * np.where(shard.mask, 0.5, 0)[None, ..., None] * np.ones(3),
    )
    names = [finding.check for finding in check_shard(replace(flat, depth=shard.mask.astype(np.float32)), Limits())]
    assert names == ["unresolved"] * 3


def test_mirror_images_of_a_symmetric_light_set_resolve():
    """Evidence must not come from the lights being lopsided."""
    lights = light_directions(8)
    both = np.concatenate([lights, lights * np.float32([-1, 1, 1])])
    shard = sphere_shard()
    cosine = np.maximum(np.einsum("hwc,lc->lhw", shard.normals, both), 0)
    shard = replace(shard, light_directions=both, images=(cosine[..., None] * np.ones(3)).astype(np.float16))
    assert measure_agreement(shard).margins["x flipped"] > 0.3


WEIGHT_FAULTS = {
    "sum": lambda w, m: w * 0.9,
    "negative": lambda w, m: np.stack([w[0] + 0.2, w[1] - 0.2]) * m,
    "outside": lambda w, m: np.full_like(w, 0.5),
    "nan": lambda w, m: spoil(w, np.nan),
    "one too many": lambda w, m: np.concatenate([w, 0 * w[:1]]),
}


@pytest.mark.parametrize("fault", [None, *WEIGHT_FAULTS])
def test_material_weights(fault):
    shard = sphere_shard()
    ramp = np.linspace(0, 1, shard.mask.shape[1], dtype=np.float32)
    weights = np.stack([shard.mask * ramp, shard.mask * (1 - ramp)])
    if fault:
        weights = WEIGHT_FAULTS[fault](weights, shard.mask)
    object.__setattr__(shard, "weights", weights)  # past the constructor, which refuses other counts
    object.__setattr__(shard, "materials", ("chrome", "pink-plastic"))
    assert found(shard) == ({"weights"} if fault else set())


def test_limits_move_and_are_checked():
    shard = sphere_shard()
    assert found(shard, min_area=0.9) == {"mask"}
    assert "mask" not in found(replace(shard, mask=shard.mask), max_area=0.95)
    for wrong in ({"min_area": 0.5, "max_area": 0.4}, {"depth_scale": 0.5}, {"margin": -1.0}, {"black_lights": 2.0}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            Limits(**wrong)


def test_a_sound_folder(tmp_path, capsys):
    good_folder(tmp_path)
    assert main(["data", "validate", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "4 shards checked, 4 planned, 0 left" in text and "sound: no findings" in text
    report = json.loads((tmp_path / "validation.json").read_text())
    assert report["sound"] and report["checked"] == 4 and report["errors"] == 0
    assert {check["name"] for check in report["checks"]} == set(CHECKS)
    assert 0.3 < report["statistics"]["area"]["median"] < 0.6
    assert sorted(item.name for item in tmp_path.iterdir()) == ["manifest.jsonl", "shards", "validation.json"]


def test_damage_in_the_folder_is_named(tmp_path, capsys):
    """One folder with every fault of files and folder at once."""
    scenes = good_folder(tmp_path)
    good = sphere_shard(name="sphere-00000")
    extra = [scene_of(good, id=name, shape=f"blobby:{number}") for number, name in enumerate("bcdefg")]
    copies = [*scenes, *extra, replace(scenes[1], id="twin", seed=9, split="val"), scenes[2]]
    write_folder(tmp_path, [], copies)
    cut, altered, foreign, same, again = (tmp_path / scene.file for scene in extra[:5])
    whole = (tmp_path / scenes[0].file).read_bytes()
    cut.write_bytes(whole[: len(whole) // 2])
    altered.write_bytes(whole[:-300] + b"\1" + whole[-299:])
    write_shard(foreign, replace(good, scene_id="d", provenance=good.provenance | {"spec": "0" * 64}))
    for path, scene in ((same, extra[3]), (again, extra[4])):
        write_shard(path, replace(sphere_shard(seed=5), scene_id=scene.id, light_directions=good.light_directions))
    (tmp_path / "shards" / "stranger.exr").write_bytes(whole)
    (tmp_path / "shards" / ".e.123.tmp.exr").write_bytes(b"")
    assert main(["data", "validate", str(tmp_path), "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    worst = {check["name"]: {row["where"] for row in check["worst"]} for check in report["checks"] if check["findings"]}
    assert worst["file"] == {"b", "c"} and worst["manifest"] == {"d"}
    assert worst["ids"] == {scenes[2].id} and worst["twins"] >= {scenes[1].id}
    assert worst["duplicates"] == {scenes[0].id, "e"}  # d has the pixels of the first scene, f those of e
    assert worst["unplanned"] == {"shards/stranger.exr"} and worst["temporary"] == {"shards/.e.123.tmp.exr"}
    assert "shading" in worst and report["left"] == 2 and not report["sound"]
    assert all(check["level"] == CHECKS[check["name"]].level and check["remedy"] for check in report["checks"])


def test_non_finite_shards_are_found_on_disk(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(shards, "_check", lambda array, name: np.ascontiguousarray(array))
    shard = sphere_shard()
    write_folder(tmp_path, [images_of(shard, spoil(shard.images, np.nan))])
    assert main(["data", "validate", str(tmp_path)]) == 1
    text = capsys.readouterr().out
    assert "a: images has 1 infinite or NaN values" in text and "render-data" in text


def test_other_parts_or_types_are_found_on_disk(tmp_path, monkeypatch):
    written = shards.write_exr
    scenes = good_folder(tmp_path)

    def lose_a_light(path, parts):
        written(path, parts[:-1])

    def lose_a_channel(path, parts):
        channels = {key: value for key, value in parts[0][2].items() if key != "Z"}
        written(path, [(parts[0][0], parts[0][1], channels), *parts[1:]])

    def widen(path, parts):
        wide = [(name, header, {"RGB": channels["RGB"].astype(np.float32)}) for name, header, channels in parts[1:]]
        written(path, [parts[0], *wide])

    for scene, fault in zip(scenes[:3], (lose_a_light, lose_a_channel, widen), strict=True):
        monkeypatch.setattr(shards, "write_exr", fault)
        write_shard(tmp_path / scene.file, replace(sphere_shard(), scene_id=scene.id))
    result = validate(tmp_path)
    assert {finding.where for finding in result.of("file")} == {scene.id for scene in scenes[:3]}
    assert result.count(ERROR) == 3


def test_checksums_are_compared_where_there_are_some(tmp_path):
    scenes = good_folder(tmp_path)
    assert "checksum" in validate(tmp_path).skipped
    sums = [f"{shards.file_hash(tmp_path / scene.file)}  {scene.file}" for scene in scenes]
    (tmp_path / "checksums.txt").write_text("\n".join(sums) + "\n")
    assert validate(tmp_path).of("checksum") == [] and "checksum" not in validate(tmp_path).skipped
    (tmp_path / "checksums.txt").write_text("\n".join([f"{'0' * 64}  {scenes[0].file}", *sums[1:]]) + "\n")
    assert [finding.where for finding in validate(tmp_path).of("checksum")] == [scenes[0].id]


def test_partly_rendered_folders_and_limit(tmp_path, capsys):
    shard = sphere_shard()
    scenes = [scene_of(shard, id=f"s{number}", shape=f"blobby:{number}") for number in range(8)]
    write_folder(tmp_path, [], scenes)
    assert main(["data", "validate", str(tmp_path)]) == 1  # nothing checked is not sound
    assert "nothing to check" in capsys.readouterr().out
    for number in range(5):
        turned = replace(sphere_shard(seed=number), scene_id=f"s{number}", light_directions=shard.light_directions)
        write_shard(tmp_path / scenes[number].file, turned)
    result = validate(tmp_path, limit=3)
    assert (result.checked, result.planned, result.left) == (3, 8, 3)


def test_several_processes_find_the_same(tmp_path):
    good_folder(tmp_path)
    for path in sorted((tmp_path / "shards").iterdir())[:1]:
        path.write_bytes(path.read_bytes()[:-1])
    alone, together = validate(tmp_path), validate(tmp_path, workers=2)
    assert alone == together and together.count(ERROR) == 1


def test_bad_input_is_one_line(tmp_path, capsys):
    good_folder(tmp_path / "good")
    for arguments, message in (
        ([str(tmp_path)], "no manifest.jsonl"),
        ([str(tmp_path / "good"), "--workers", "0"], "--workers"),
        ([str(tmp_path / "good"), "--limit", "0"], "--limit"),
        ([str(tmp_path / "good"), "--set", "min_are=0.1"], "min_area"),
        ([str(tmp_path / "good"), "--set", "min_area"], "LIMIT=VALUE"),
        ([str(tmp_path / "good"), "--set", "min_area=much"], "min_area"),
    ):
        assert main(["data", "validate", *arguments]) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1


def test_imported_scenes_of_one_name_are_no_twins(tmp_path):
    shard = sphere_shard()
    pair = [scene_of(shard, id=name, shape="imported:cat", material="imported:glaze", view=View()) for name in "ab"]
    write_folder(tmp_path, [shard, images_of(replace(shard, scene_id="b"), shard.images * 0.5)], pair)
    assert validate(tmp_path).findings == ()


def test_rendered_scenes_are_sound_and_their_flips_found(tmp_path):
    """Real renders of the hardest materials: mirror-like, black and white with interreflections."""
    from render.running.scene_rendering import render_scenes

    lights = tuple(tuple(round(float(c), 6) for c in row) for row in light_directions(16))
    base = scene_of(sphere_shard(), shape="blobby:3", lights=lights, bounces=1)
    names = ("chrome", "black-obsidian", "white-acrylic")
    scenes = write_folder(tmp_path, [], [replace(base, id=name, material=name) for name in names])
    render_scenes(scenes, tmp_path)
    assert validate(tmp_path).findings == ()
    for scene in scenes:
        shard = shards.read_shard(Path(tmp_path) / scene.file)
        for axis in range(2):
            sign = np.ones(3)
            sign[axis] = -1
            assert "shading" in found(normals_of(shard, shard.normals * sign)), (scene.material, axis)
