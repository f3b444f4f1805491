"""Configuration, seeds, light sets and the plan: strict, reproducible, and stable when something is added."""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from render.materials import surfaces
from render.planning import light_sets, plan_counts
from render.planning.framing import measure
from render.planning.plan import DataConfig, is_validation, material_pool, plan
from render.records.manifest import SceneSpec, View, read_manifest, write_manifest
from render.shapes import load as load_shape
from render.shared import config, seeds
from render.shared.errors import InputError, unknown

STREAM = 1681681659  # frozen: another value would mean that every plan changes
SMALL = DataConfig(families={"blobby": 4}, views=2, materials_per_view=2, light_count=5, validation=0.25)


def by_id(scenes: list[SceneSpec]) -> dict[str, SceneSpec]:
    return {scene.id: scene for scene in scenes}


def test_same_configuration_same_plan():
    assert plan(SMALL) == plan(SMALL)
    assert plan(SMALL) != plan(replace(SMALL, seed=1))
    assert len(by_id(plan(SMALL))) == 4 * 2 * 2


@pytest.mark.parametrize(
    "change",
    [{"families": {"sculpture": 2, "blobby": 4}}, {"families": {"blobby": 7}}, {"views": 3}, {"validation": 0.0}],
)
def test_adding_scenes_leaves_the_others_alone(change):
    before, after = by_id(plan(SMALL)), by_id(plan(replace(SMALL, **change)))
    for name, scene in before.items():
        changed = {"split": "train"} if "validation" in change else {}
        assert after[name] == replace(scene, **changed)


def test_mixed_cameras_and_lights_take_every_kind():
    config = replace(SMALL, families={"blobby": 40}, views=1, camera="mixed", lights="mixed", light_count=32)
    scenes = by_id(plan(config)).values()
    distances = [scene.view.camera_distance for scene in scenes]
    assert 0.3 < np.mean([distance is not None for distance in distances]) < 0.7
    assert all(4.0 <= distance <= 10.0 for distance in distances if distance is not None)
    furthest = np.degrees([np.arccos(scene.light_directions()[:, 2].min()) for scene in scenes])
    assert 0.15 < (furthest < 46).mean() < 0.6 and (furthest > 70).any()  # narrow grids, and wide ones
    plain = by_id(plan(replace(config, camera="orthographic")))
    for scene in scenes:
        assert replace(scene.view, camera_distance=None) == plain[scene.id].view


def test_near_lights_and_perspective_leave_all_else_alone():
    before = by_id(plan(SMALL))
    config = replace(SMALL, near_lights=0.5, near_light_distance=(2.0, 5.0), camera="perspective")
    after = by_id(plan(config))
    for name, scene in before.items():
        plain = replace(after[name], light_distances=(), view=replace(after[name].view, camera_distance=None))
        assert plain == scene
        assert 4 <= after[name].view.camera_distance <= 10
        distances = after[name].light_distances
        assert len(distances) in (0, SMALL.light_count) and all(2 <= distance <= 5 for distance in distances)
    near = {scene.shape + str(scene.view): bool(scene.light_distances) for scene in after.values()}
    assert len(near) == 8 and 0 < sum(near.values()) < 8  # by view
    assert all(scene.light_distances for scene in plan(replace(config, near_lights=1.0)))
    framed = plan(replace(config, min_foreground={"blobby": 0.05}))
    assert [scene.view.camera_distance for scene in framed] == [scene.view.camera_distance for scene in plan(config)]


def test_lights_of_a_view_stand_about_equally_far_and_no_camera_stands_in_the_object():
    config = replace(
        SMALL, families={"blobby": 40}, views=1, near_lights=1.0, near_light_distance=(2.5, float("inf")),
        near_light_spread=0.2, camera="perspective", camera_distance=(1.3, float("inf")),
    )  # fmt: skip
    scenes = by_id(plan(config)).values()
    logs = np.log([scene.light_distances for scene in scenes])  # (scenes, L)
    assert 2.5 <= np.exp(logs.min()) < 3.5 and np.exp(logs.max()) > 20
    assert logs.std(axis=1).min() < 0.05 and 0.1 < logs.std(axis=1).max() < 0.35
    assert np.abs(np.median(logs, axis=1) - np.log(5.0)).mean() < 1.2  # half of them nearer than twice 2.5
    nearest = np.array([scene.view.camera_distance / scene.view.scale for scene in scenes])
    assert nearest.min() >= 1.49 and nearest.max() > 8 and (nearest < 2.5).mean() > 0.15


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"near_lights": 1.5}, "near_lights must be in"),
        ({"near_lights": 0.5, "near_light_distance": (1.1, 3.0)}, "near_light_distance must be above the radius"),
        ({"near_light_distance": (3.0, 2.0)}, "near_light_distance must be two rising"),
        ({"camera": "perspektive"}, "perspective"),
        ({"near_light_spread": -0.1}, "near_light_spread must be in"),
        ({"camera": "perspective", "camera_distance": (0.0, 3.0)}, "camera_distance must be two rising"),
        ({"camera": "perspective", "tiles": 2, "upright_scale": (1.0, 1.5)}, "camera: orthographic"),
    ],
)
def test_impossible_distances_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        replace(SMALL, **change)


def test_a_prefix_changes_names_and_nothing_else():
    plain, named = plan(SMALL), plan(replace(SMALL, prefix="a-"))
    assert [replace(scene, id=f"a-{scene.id}") for scene in plain] == named
    with pytest.raises(InputError, match="cannot name a file"):
        replace(SMALL, prefix="../")


def test_another_material_per_view_keeps_the_first_ones():
    before, after = by_id(plan(SMALL)), by_id(plan(replace(SMALL, materials_per_view=4)))
    assert all(after[name] == scene for name, scene in before.items())


def test_scenes_of_a_view_stand_together_and_share_all_but_the_material():
    scenes = plan(SMALL)
    for first, second in zip(scenes[::2], scenes[1::2], strict=True):
        assert replace(second, id=first.id, material=first.material) == first
        assert first.material != second.material
    assert len({scene.seed for scene in scenes}) == 8 and len({scene.lights for scene in scenes}) == 8


def test_validation_shapes_are_unseen_in_training():
    scenes = plan(replace(SMALL, families={"blobby": 10, "sculpture": 3}, validation=0.05))
    shapes = {split: {scene.shape for scene in scenes if scene.split == split} for split in ("train", "val")}
    assert not shapes["train"] & shapes["val"]
    assert sorted(shape.split(":")[0] for shape in shapes["val"]) == ["blobby", "sculpture"]
    assert {scene.split for scene in plan(replace(SMALL, validation=0))} == {"train"}


@pytest.mark.parametrize(("share", "count"), [(0.05, 1), (0.05, 40), (0.07, 100), (0.29, 200), (0.5, 3), (0.01, 1098)])
def test_the_share_held_out_is_exact_at_every_count(share, count):
    held_out = [number for number in range(count) if is_validation(number, share)]
    assert len(held_out) == int(np.ceil(round(share * count, 9))) and held_out[0] == 0


def test_spatially_varying_scenes_change_nothing_else():
    config = replace(SMALL, families={"blobby": 60}, materials=("fabric", "metal"))
    plain = plan(config)
    mixed = plan(replace(config, spatially_varying=0.25))
    more = plan(replace(config, spatially_varying=0.5, mixture=(2, 3)))
    chosen = [number for number, scene in enumerate(mixed) if scene.material != plain[number].material]
    assert 0.15 < len(chosen) / len(plain) < 0.35
    assert [replace(scene, material="") for scene in mixed] == [replace(scene, material="") for scene in plain]
    pool = set(material_pool(config.materials))
    for number in chosen:
        _, names = surfaces.split_name(mixed[number].material)
        assert len(names) in (2, 3) and len(set(names)) == len(names) and set(names) <= pool
        assert names[0] == plain[number].material and more[number].material == mixed[number].material
    assert len({mixed[number].material.split(":")[0] for number in chosen}) == 5
    only = plan(replace(config, spatially_varying=1.0, patterns=("noise",), mixture=(3, 3)))
    assert all(scene.material.startswith("noise:") and scene.material.count("+") == 2 for scene in only)


FRAMED = DataConfig(
    families={"sculpture": 1}, views=4, materials_per_view=1, light_count=1, tiles=4, upright_scale=(0.8, 1.0),
    min_foreground={"sculpture": 0.5}, min_normal_spread={"sculpture": 10.0},
)  # fmt: skip


def test_tiles_show_as_much_as_asked():
    scenes = plan(FRAMED)
    assert len(scenes) == 4
    mesh = load_shape(scenes[0].shape)
    for scene in scenes:
        framing = measure(mesh, scene.view)
        assert framing.foreground[0, 0] > 0.45 and framing.spread[0, 0] > 8  # at twice the resolution
        assert 3.2 - 1e-6 <= scene.view.scale <= 4 + 1e-6


def test_a_shape_that_cannot_be_framed_is_replaced_and_at_last_refused(monkeypatch):
    tried = []
    monkeypatch.setattr("render.planning.plan.SHAPES_TRIED", 2)
    monkeypatch.setattr("render.shapes.load", lambda name: tried.append(name) or load_shape(name))
    small = replace(SMALL, families={"blobby": 1}, views=1, scale=(0.5, 0.5), min_foreground={"blobby": 0.9})
    with pytest.raises(InputError, match=r"lower min_foreground\.blobby"):
        plan(small)
    assert len(set(tried)) == 2


def test_poses_are_rotations_within_their_ranges():
    scenes = plan(replace(SMALL, families={"blobby": 20, "sculpture": 20}, materials_per_view=1))
    for scene in scenes:
        matrix = scene.view.matrix()
        assert abs(np.linalg.det(matrix) - 1) < 1e-6
        low, high = SMALL.upright_scale if scene.shape.startswith("sculpture") else SMALL.scale
        assert low - 1e-6 <= scene.view.scale <= high + 1e-6
        if scene.shape.startswith("sculpture"):
            assert matrix[1, 1] > 0.5  # up stays up


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"views": 0}, "views"),
        ({"size": 30}, "size must be a multiple of 4"),
        ({"seed": -1}, "seed"),
        ({"validation": 0.9}, "validation"),
        ({"bounces": -1}, "bounces"),
        ({"lights": "hemispere"}, "did you mean 'hemisphere'"),
        ({"scale": (1.0, 0.5)}, "scale"),
        ({"families": {}}, "families"),
        ({"spatially_varying": 1.5}, "spatially_varying"),
        ({"patterns": ("stripe",)}, "did you mean 'stripes'"),
        ({"patterns": ()}, "patterns"),
        ({"mixture": (1, 2)}, "mixture"),
        ({"tiles": 0}, "tiles"),
        ({"tiles": 8}, "tiles x upright_scale"),
        ({"min_foreground": {"bloby": 0.5}}, "did you mean 'blobby'"),
        ({"min_foreground": {"blobby": 1.5}}, r"min_foreground\.blobby"),
        ({"min_normal_spread": {"blobby": -1}}, r"min_normal_spread\.blobby"),
    ],
)
def test_configuration_is_checked(change, message):
    with pytest.raises(InputError, match=message):
        replace(SMALL, **change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"families": {"bloby": 1}}, "did you mean 'blobby'"),
        ({"families": {"sphere": 1}}, "unknown shape family"),
        ({"families": {"blobby": 0}}, "no scene"),
        ({"materials": ("crome",)}, "did you mean 'chrome"),
        ({"materials": ("chrome",)}, "materials_per_view is 2"),
        ({"materials": ("chrome", "nylon"), "spatially_varying": 0.1}, "mixture is 3"),
        ({"materials": ("all", "noise:1:chrome+nylon"), "spatially_varying": 0.1}, "cannot be mixed"),
    ],
)
def test_plan_refuses(change, message):
    with pytest.raises(InputError, match=message):
        plan(replace(SMALL, **change))


def test_material_pool_expands_categories_once():
    assert len(material_pool(("all",))) == 100
    pool = material_pool(("fabric", "chrome", "lambertian:0.5", "chrome"))
    assert pool.count("chrome") == 1 and "lambertian:0.5" in pool and "pink-fabric" in pool


def test_manifest_round_trip_and_refusals(tmp_path: Path):
    scenes = plan(SMALL)
    write_manifest(tmp_path, scenes)
    assert read_manifest(tmp_path) == scenes
    assert {scene.split for scene in read_manifest(tmp_path, "val")} == {"val"}
    with pytest.raises(InputError, match="no scene of split 'test'"):
        read_manifest(tmp_path, "test")
    with pytest.raises(InputError, match="no manifest"):
        read_manifest(tmp_path / "elsewhere")
    path = tmp_path / "manifest.jsonl"
    path.write_text(path.read_text().replace('"spp"', '"sp"', 1))
    with pytest.raises(InputError, match=r"line 1\.sp'; did you mean"):
        read_manifest(tmp_path)
    path.write_text('{"id": \n')
    with pytest.raises(InputError, match="line 1 is not JSON"):
        read_manifest(tmp_path)


def test_view_refuses_what_is_no_rotation():
    with pytest.raises(InputError, match=r"view\.rotation"):
        View(rotation=(2.0, 0, 0, 0, 1, 0, 0, 0, 1))
    with pytest.raises(InputError, match=r"view\.rotation"):
        View(rotation=(1.0, 0, 0))
    with pytest.raises(InputError, match=r"view\.scale"):
        View(scale=0)


# --- lights ---


def test_distributions_are_as_their_names_say():
    def many(name: str) -> np.ndarray:
        return light_sets.draw(name, 40_000, seeds.generator(0, name))

    for name in light_sets.DISTRIBUTIONS:
        vectors = many(name)
        np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-9)
        assert (vectors[:, 2] > 0).all()
    vectors = many("azimuth-elevation")
    azimuth = np.degrees(np.arctan2(vectors[:, 0], vectors[:, 2]))
    elevation = np.degrees(np.arcsin(vectors[:, 1]))
    for angle in (azimuth, elevation):
        counts, _ = np.histogram(angle, bins=8, range=(-88, 88))
        assert np.abs(counts / 5000 - 1).max() < 0.06
    low = np.cos(np.radians(88))
    assert abs(many("hemisphere")[:, 2].mean() - (1 + low) / 2) < 0.005
    disc = many("near-uniform")
    assert abs((disc[:, :2] ** 2).sum(1).mean() - 0.5) < 0.005 and np.abs(disc[:, :2].mean(0)).max() < 0.01
    assert many("biased")[:, 1].min() > -0.1 and many("biased")[:, 1].max() > 0.9


@pytest.mark.parametrize(("name", "count", "angle"), [("merltest", 100, 42.195), ("diligent", 96, 26.651)])
def test_fixed_sets(name, count, angle):
    vectors = light_sets.load(name)
    assert vectors.shape == (count, 3) and (vectors[:, 2] > 0).all()
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-6)
    assert len(np.unique(vectors.round(6), axis=0)) == count
    assert np.degrees(np.arccos(vectors[:, 2])).mean() == pytest.approx(angle, abs=0.001)  # to the camera's axis
    assert name in light_sets.names()


def test_user_sets(tmp_path: Path):
    text = tmp_path / "mine.txt"
    text.write_text("0 0 2\n\n1, 0, 1\n")
    np.testing.assert_allclose(light_sets.load(str(text)), [[0, 0, 1], [0.5**0.5, 0, 0.5**0.5]])
    document = tmp_path / "mine.yaml"
    document.write_text("directions:\n- [0, 3, 4]\n")
    np.testing.assert_allclose(light_sets.load(str(document)), [[0, 0.6, 0.8]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 0 1\n1 0 -0.2\n", "light 2 is below the horizon"),
        ("1 0 0\n", "light 1 is below the horizon"),
        ("0 0 1\n1 2\n", "light 2: expected three numbers"),
        ("0 0 nan\n", "light 1: expected three numbers"),
        ("x y z\n", "light 1: expected three numbers"),
        ("\n", "expected a list"),
    ],
)
def test_bad_user_sets_name_the_light(tmp_path: Path, text, message):
    path = tmp_path / "mine.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        light_sets.load(str(path))


def test_unknown_sets_suggest_the_nearest():
    with pytest.raises(InputError, match="did you mean 'merltest'"):
        light_sets.load("merl-test")
    with pytest.raises(InputError, match="did you mean 'biased'"):
        light_sets.draw("biassed", 3, seeds.generator(0))
    with pytest.raises(InputError, match="did you mean 'biased:64'"):
        light_sets.load("biassed")


def test_drawn_sets_are_fixed_by_name_and_count():
    drawn = light_sets.load("biased:40")
    assert drawn.shape == (40, 3) and drawn[:, 1].min() > light_sets.BIASED_MIN_Y
    np.testing.assert_array_equal(drawn, light_sets.load("biased:40"))
    with pytest.raises(InputError, match="number of lights"):
        light_sets.load("biased:none")


# --- seeds, configuration ---


def test_streams_are_independent_and_stable():
    def first(*key) -> int:
        return int(seeds.generator(*key).integers(2**62))

    assert first(0, "a") == first(0, "a")
    keys = [(0,), (1,), (0, "a"), (0, "b"), (0, "a", 1), (0, "a", 2), (0, "a", "1"), (1, "a", 1), (0, 0, "a")]
    assert len({first(*key) for key in keys}) == len(keys)
    assert 0 <= seeds.derive_seed(0, "blobby", 3) < 2**31
    assert seeds.derive_seed(0, "blobby", 3) == STREAM


@dataclass(frozen=True, kw_only=True)
class Inner:
    rate: float = 0.1
    kind: Literal["adam", "sgd"] = "adam"

    def __post_init__(self) -> None:
        if self.rate <= 0:
            raise ValueError("rate must be positive")


@dataclass(frozen=True, kw_only=True)
class Outer:
    name: str
    inner: Inner = Inner()
    steps: int | None = None
    sizes: tuple[int, ...] = ()
    pair: tuple[float, float] = (0.0, 1.0)
    counts: dict[str, int] | None = None
    flag: bool = False


def test_build_converts_what_yaml_gives():
    built = config.build(
        Outer,
        {"name": 7, "inner": {"rate": "1e-3", "kind": "sgd"}, "steps": "1e3", "sizes": [1, 2], "pair": [0, 2],
         "counts": {"a": 1}, "flag": True},
    )  # fmt: skip
    assert built == Outer(
        name="7", inner=Inner(rate=0.001, kind="sgd"), steps=1000, sizes=(1, 2), pair=(0.0, 2.0), counts={"a": 1},
        flag=True,
    )  # fmt: skip
    assert config.build(Outer, config.to_plain(built)) == built
    assert config.build(Outer, {"name": "x", "steps": None}).steps is None


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"name": "x", "inner": {"rat": 1}}, "unknown key 'inner.rat'; did you mean 'inner.rate'"),
        ({"inner": {}}, "missing key 'name'"),
        ({"name": "x", "inner": {"rate": "fast"}}, "inner.rate: expected float, got 'fast'"),
        ({"name": "x", "inner": {"rate": -1}}, "inner.rate must be positive"),
        ({"name": "x", "inner": {"kind": "adm"}}, "did you mean 'adam'"),
        ({"name": "x", "inner": 3}, "inner: expected a section"),
        ({"name": "x", "steps": 1.5}, "steps: expected int"),
        ({"name": "x", "steps": True}, "steps: expected int"),
        ({"name": "x", "pair": [1]}, "pair: expected 2 values"),
        ({"name": "x", "sizes": ["a"]}, "sizes: expected int"),
        ({"name": "x", "counts": [1]}, "counts: expected a mapping"),
        ({"name": "x", "flag": "yes"}, "flag: expected bool"),
    ],
)
def test_build_refuses_and_names_the_field(values, message):
    with pytest.raises(InputError) as caught:
        config.build(Outer, values)
    assert message in str(caught.value)


def test_read_yaml_names_file_and_line(tmp_path: Path):
    path = tmp_path / "a.yaml"
    with pytest.raises(InputError, match=r"a\.yaml: no such file"):
        config.read_yaml(path)
    path.write_text("a: 1\nb: [1\n")
    with pytest.raises(InputError, match=r"a\.yaml: line 3 is not valid YAML"):
        config.read_yaml(path)
    path.write_text("- 1\n")
    with pytest.raises(InputError, match="expected a mapping"):
        config.read_yaml(path)


def test_unknown_lists_a_few_names_when_none_is_near():
    assert "known: a, b" in str(unknown("thing", "zzz", ["a", "b"]))


def test_weights_decide_how_often_materials_are_drawn() -> None:
    pool = {"materials": ("chrome", "nickel", "blue-fabric", "pink-fabric", "teflon")}
    config = DataConfig(families={"blobby": 200}, materials_per_view=1, views=2, validation=0.0, **pool)
    weighted = replace(config, material_weights={"metal": 4.0, "nickel": 0.0, "fabric": 0.5})
    counts = Counter(scene.material for scene in plan(weighted))
    assert "nickel" not in counts
    shares = {name: count / 400 for name, count in counts.items()}
    assert shares["chrome"] == pytest.approx(4 / 6, abs=0.08)
    assert shares["teflon"] == pytest.approx(1 / 6, abs=0.06)
    plain = plan(replace(config, material_weights={}))
    assert [scene.material for scene in plan(config)] == [scene.material for scene in plain]
    with pytest.raises(InputError, match=r"material_weights: 'fabrics'.*did you mean 'fabric'"):
        plan(replace(config, material_weights={"fabrics": 2.0}))
    with pytest.raises(InputError, match="leave 1 materials, 2 are drawn at once"):
        plan(replace(config, materials_per_view=2, materials=("chrome", "nickel"), material_weights={"nickel": 0.0}))


def test_held_out_materials_are_seen_in_validation_only() -> None:
    unseen = set(material_pool(("held-out",)))
    assert len(unseen) == 16 and unseen.isdisjoint(material_pool(("all",)))
    config = DataConfig(families={"blobby": 10}, validation=0.2, spatially_varying=0.5)
    before = {scene.id: scene for scene in plan(config)}
    for scene in plan(replace(config, validation_materials=("held-out",))):
        if scene.split == "val" and scene.id.endswith("-m1"):
            assert scene.material in unseen
        else:
            assert scene == before[scene.id]


def test_procedural_materials_are_drawn_again_for_every_scene():
    config = DataConfig(families={"blobby": 12}, materials=("procedural",), spatially_varying=0.5, validation=0)
    names = [scene.material for scene in plan(config)]
    assert all(name.startswith("procedural:") for name in names)
    assert len(set(names)) == len(names) and len({name.split(":")[1] for name in names}) >= 6
    assert [scene.material for scene in plan(config)] == names
    for name in names:
        surfaces.load(name)


def test_procedural_materials_among_others_are_weighed_and_stay_unmixed():
    pool = ("metal", "procedural:wood", "lambertian:0.5")
    config = DataConfig(families={"blobby": 40}, materials=pool, material_weights={"procedural": 20}, validation=0,
                        spatially_varying=0.8)  # fmt: skip
    names = [scene.material for scene in plan(config)]
    textured = [name for name in names if "procedural" in name]
    assert len(textured) > 60 and all(name.startswith("procedural:wood:") for name in textured)
    counted = plan_counts.count_plan(plan(config))
    assert counted.categories["procedural-wood"] == len(textured)
    assert counted.materials["procedural:wood"] == len(textured)
