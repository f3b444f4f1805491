"""The family `meshes`: files of the user's own, split by file, tied to their content, skipped when unusable."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from render import shapes
from render.planning import plan_counts
from render.planning.mesh_family import MeshFamily, mesh_files
from render.planning.plan import DataConfig, plan
from render.planning.provenance import UNSTATED, mesh_terms
from render.records.manifest import SceneSpec, read_manifest
from render.running.scene_rendering import render_scenes
from render.shared.config import build, to_plain
from render.shared.errors import InputError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder of ten boxes, all different, in two formats and two folders."""
    (tmp_path / "scans" / "more").mkdir(parents=True)
    for number in range(10):
        box = trimesh.creation.box((1.0, 2.0 + number, 0.5))
        box.export(tmp_path / "scans" / ("more" if number % 2 else ".") / f"box{number}.{('obj', 'ply')[number // 5]}")
    return tmp_path / "scans"


def config(folder: Path, count: int, **changes) -> DataConfig:
    given = {"path": (str(folder),)} | changes.pop("meshes", {})
    return DataConfig(
        families={"meshes": count}, meshes=MeshFamily(**given), views=1, materials_per_view=1, light_count=2, size=16,
        **({"validation": 0.2, "spp": 2, "bounces": 0, "materials": ("lambertian:0.5",)} | changes),
    )  # fmt: skip


def file_of(scene: SceneSpec) -> str:
    return Path(scene.shape.split(":", 3)[3]).name


def splits(scenes: list[SceneSpec]) -> dict[str, str]:
    found: dict[str, str] = {}
    for scene in scenes:
        assert found.setdefault(file_of(scene), scene.split) == scene.split, "a file in two splits"
    return found


def test_files_come_once_in_a_seeded_order_and_then_again(folder):
    scenes = plan(config(folder, 25))
    names = [file_of(scene) for scene in scenes]
    assert len(set(names[:10])) == 10 and names[10:20] == names[:10] and names[20:] == names[:5]
    assert len({scene.view for scene in scenes}) == 25
    assert names != [file_of(scene) for scene in plan(config(folder, 25, seed=1))]
    assert names[:10] != sorted(names[:10])


def test_the_split_is_by_file_and_stays_when_a_count_rises(folder):
    all_of_them = splits(plan(config(folder, 25)))
    assert sorted(all_of_them.values()) == ["train"] * 8 + ["val"] * 2
    before = plan(config(folder, 4))
    assert splits(before).items() <= all_of_them.items()
    assert before == plan(config(folder, 25))[:4]


def test_unusable_files_and_copies_are_skipped_with_their_reasons(folder, caplog):
    before = [scene.shape for scene in plan(config(folder, 10))]
    shutil.copy(folder / "box0.obj", folder / "again.obj")
    (folder / "broken.ply").write_text("nonsense")
    (folder / "points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    (folder / "skin.mtl").write_text("newmtl skin\n")
    (folder / "._box0.obj").write_bytes(b"\0")
    caplog.clear()
    assert {scene.shape.split(":")[2] for scene in plan(config(folder, 20))} == {name.split(":")[2] for name in before}
    lines = sorted(record.getMessage() for record in caplog.records if record.name == "render.planning.mesh_family")
    assert len(lines) == 3 and not any("\n" in line for line in lines)
    assert any("a copy of" in line for line in lines)
    assert any("broken.ply: damaged or not a mesh" in line for line in lines) and any(
        "points.obj" in line for line in lines
    )


def test_no_usable_file_is_one_line(folder, tmp_path):
    with pytest.raises(InputError, match=r"no such file or folder \(looked for at "):
        plan(config(tmp_path / "scanz", 1))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no mesh file"):
        plan(config(tmp_path / "empty", 1))
    (tmp_path / "empty" / "broken.ply").write_text("nonsense")
    with pytest.raises(InputError, match=r"none of 1 mesh files can be used; the first one: .*broken.ply: damaged"):
        plan(config(tmp_path / "empty", 1))


def test_files_are_listed_once(folder):
    listed = mesh_files(MeshFamily(path=(str(folder), str(folder / "box0.obj"), str(folder / "more"))))
    assert len(listed) == 10


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"families": {"meshes": 2}}, "belong together"),
        ({"meshes": {"path": "scans"}}, "belong together"),
        ({"families": {"meshes": 2}, "meshes": {"path": "scans", "upp": "z"}}, r"did you mean 'meshes\.up'"),
        ({"families": {"meshes": 2}, "meshes": {"up": "z"}}, "missing key 'path'"),
        ({"families": {"meshes": 2}, "meshes": {"path": "scans", "up": "Y"}}, "did you mean 'y'"),
        ({"families": {"meshes": 2}, "meshes": {"path": []}}, "at least one"),
    ],
)
def test_configuration_is_checked(values, message):
    with pytest.raises(InputError, match=message):
        build(DataConfig, values)


def test_configuration_survives_its_file(folder):
    assert build(DataConfig, to_plain(config(folder, 3))) == config(folder, 3)


@pytest.mark.parametrize(("up", "axis"), [("x", 0), ("y", 1), ("z", 2)])
def test_up_becomes_y(tmp_path, up, axis):
    # A cone's tip shows which end is up.
    cone = trimesh.creation.cone(radius=0.3, height=2.0)  # along z
    path = tmp_path / "cone.ply"
    turned = np.roll(cone.vertices, axis - 2, axis=1)  # cyclic, so that nothing is mirrored
    trimesh.Trimesh(turned, cone.faces, process=False).export(path)
    assert np.ptp(trimesh.load(path).vertices, axis=0).argmax() == axis
    (scene,) = plan(config(path, 1, meshes={"up": up}))
    mesh = shapes.load(scene.shape)
    tip = mesh.vertices[np.abs(mesh.vertices[:, 1] - mesh.vertices[:, 1].mean()).argmax()]
    assert tip[1] > 0.9 and np.abs(tip[[0, 2]]).max() < 0.1
    assert (mesh.normals * mesh.vertices).sum(1).mean() > 0


def test_standing_meshes_get_the_poses_of_standing_shapes(folder):
    def tilts(upright):
        scenes = plan(config(folder, 60, meshes={"upright": upright}))
        return np.array([scene.view.matrix()[1, 1] for scene in scenes])

    assert tilts(True).min() > 0.5 and tilts(False).min() < -0.5
    tiled = plan(config(folder, 3, tiles=2, upright_scale=(0.8, 1.0)))
    assert all(scene.view.scale >= 1.6 for scene in tiled)


def test_a_mesh_that_cannot_be_framed_is_named(folder):
    with pytest.raises(InputError, match=r"meshes 0: .*box\d.* has a view without a fitting pose"):
        plan(config(folder, 1, min_foreground={"meshes": 0.9}))


def test_a_changed_or_moved_file_is_refused(folder, tmp_path):
    path = folder / "box0.obj"
    (scene,) = plan(config(path, 1))
    path.write_text(path.read_text() + "# touched\n")
    with pytest.raises(
        InputError, match=r"box0.obj: changed since the plan was made \(SHA-256 \w{12}, planned \w{12}\)"
    ):
        render_scenes([scene], tmp_path / "data")
    path.rename(tmp_path / "away.obj")
    with pytest.raises(InputError, match=r"box0.obj: no such mesh file; the plan expects it at /.*box0.obj"):
        render_scenes([scene], tmp_path / "data")
    with pytest.raises(InputError, match="expected meshes:<axis>"):
        shapes.load("meshes:y")
    with pytest.raises(InputError, match="unknown axis"):
        shapes.load(scene.shape.replace(":y:", ":w:"))


def test_counted_as_one_family_with_its_terms(folder):
    counts = plan_counts.count_plan(plan(config(folder, 3)))
    assert counts.families == {"meshes": 3} and counts.shapes == 3
    assert mesh_terms(counts) == {"meshes": UNSTATED} and mesh_terms(counts, "CC0") == {"meshes": "CC0"}


def test_two_files_rendered_from_a_preset(tmp_path, monkeypatch):
    from pipelines import cli

    monkeypatch.chdir(tmp_path)
    Path("scans").mkdir()
    for number, corner in enumerate((1, 2)):
        Path(f"scans/{number}.obj").write_text(
            f"v 0 0 0\nv {corner} 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
        )
    Path("own.yaml").write_text(
        "name: own\ndescription: two\ndata: {families: {meshes: 2}, meshes: {path: scans, licence: CC0}, views: 1,\n"
        "  materials_per_view: 1, materials: [lambertian:0.5], light_count: 2, size: 16, spp: 2, bounces: 0}\n"
    )
    assert cli.main(["data", "plan", "--preset", "own.yaml", "--out", "out", "--no-sample"]) == 0
    scenes = read_manifest("out/data")
    assert sorted(file_of(scene) for scene in scenes) == ["0.obj", "1.obj"]
    assert sorted(scene.split for scene in scenes) == ["train", "val"]
    assert render_scenes(scenes, "out/data") == 2
    assert cli.main(["data", "card", "out/data"]) == 0
    assert "| meshes | CC0 |" in Path("out/data/DATASET_CARD.md").read_text()
