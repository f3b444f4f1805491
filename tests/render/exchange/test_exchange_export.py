"""Exported trees: what the loaders of each layout get from them, names, exposure and resuming.

The readers here follow the description of each loader (docs/reference/formats.md), not the package's own.
"""

import errno
import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from exchange_support import LIGHTS, SCENES, SIZE
from PIL import Image
from scipy.io import loadmat

from render.exchange.export import ExportOptions, export
from render.exchange.layouts import LAYOUTS, layout_base
from render.exchange.layouts.layout_base import image_names, legal_name, unique_names
from render.exchange.tree_check import check_tree
from render.records.manifest import SceneSpec, View, read_manifest
from render.records.shards import read_shard
from render.shared.errors import InputError
from render.shared.tables import natural_key


def shard(data: Path, name: str):
    scene = next(scene for scene in read_manifest(data) if scene.id == name)
    return read_shard(data / scene.file, scene)


def record(tree: Path) -> dict:
    return json.loads((tree / "export.json").read_text())


def lines(path: Path) -> list[str]:
    return [line for line in path.read_text().split("\n") if line]


def naturally(names: list[str]) -> list[str]:
    return sorted(names, key=lambda name: [int(p) if p.isdigit() else p for p in re.split(r"(\d+)", name)])


def psfcn_sample(root: Path, entry: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Read a sample as PS-FCN's training code does: images, normals, mask, lights."""
    shape, material = entry.split("/")
    folder = root / "Images" / shape / material
    rows = naturally(lines(folder / f"{shape}_{material}.txt"))
    table = np.genfromtxt(rows, dtype="str", delimiter=" ")
    images = np.stack([np.asarray(Image.open(folder / name), np.float32) / 255.0 for name in table[:, 0]])
    lights = table[:, 1:4].astype(np.float32)
    normals = np.asarray(Image.open(root / "Images" / shape / f"{shape}_normal.png"), np.float32) / 255.0 * 2 - 1
    mask = (normals**2).sum(-1) > 0.01
    normals = normals * mask[..., None]
    return images, normals / (np.linalg.norm(normals, axis=-1, keepdims=True) + 1e-10), mask, lights


def angles(first: np.ndarray, second: np.ndarray, mask: np.ndarray) -> np.ndarray:
    cosine = (first.astype(np.float64) * second)[mask].sum(-1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def test_psfcn_loader_gets_images_normals_and_lights(trees, data):
    root = trees["psfcn"]
    assert lines(root / "train_mtrl.txt") == [
        "blobby-00001-v0/blue-fabric", "blobby-00001-v0/stripes-7-chrome-blue-fabric",
    ]  # fmt: skip
    assert lines(root / "val_mtrl.txt") == ["blobby-00001-v1/lambertian-0-5"]
    assert lines(root / "test_mtrl.txt") == ["Sphere-2-obj/gold-paint"]
    entries = [line for split in ("train", "val", "test") for line in lines(root / f"{split}_mtrl.txt")]
    for entry, (name, *_) in zip(entries, SCENES, strict=True):
        source = shard(data, name)
        images, normals, mask, lights = psfcn_sample(root, entry)
        assert images.shape == (LIGHTS, SIZE, SIZE, 3)
        np.testing.assert_allclose(images, np.minimum(source.images.astype(np.float32), 1), atol=0.5 / 255 + 1e-6)
        np.testing.assert_array_equal(mask, source.mask)
        np.testing.assert_allclose(lights, source.light_directions, atol=1e-7)
        assert angles(normals, source.normals, mask).max() < 0.4
    folder = root / "Images" / "blobby-00001-v0"
    assert sorted(path.name for path in folder.iterdir()) == [
        "blobby-00001-v0_normal.png", "blue-fabric", "stripes-7-chrome-blue-fabric",
    ]  # fmt: skip


def test_custom_loader(trees, data):
    root = trees["custom"]
    assert lines(root / "objects.txt") == [name for name, *_ in SCENES]
    for name in lines(root / "objects.txt"):
        source, facts = shard(data, name), record(root)["scenes"][name]
        files = naturally(lines(root / name / "names.txt"))
        images = np.stack([np.asarray(Image.open(root / name / file), np.float32) / 255.0 for file in files])
        expected = np.minimum(source.images.astype(np.float32) * facts["exposure"], 1)
        np.testing.assert_allclose(images, expected, atol=0.5 / 255 + 1e-6)
        np.testing.assert_array_equal(np.asarray(Image.open(root / name / "mask.png")) / 255.0, source.mask)
        directions = np.genfromtxt(root / name / "light_directions.txt")
        np.testing.assert_allclose(directions, source.light_directions, atol=1e-7)
        np.testing.assert_array_equal(np.genfromtxt(root / name / "light_intensities.txt"), np.ones((LIGHTS, 3)))
        normals = np.asarray(Image.open(root / name / "normal.png"), np.float32) / 255.0 * 2 - 1
        assert np.abs(normals - source.normals)[source.mask].max() <= 1 / 255 + 1e-6


def test_diligent_loader_with_random_intensities(data, tmp_path):
    options = ExportOptions(layout="diligent", intensities="seed")
    export(data, tmp_path, options, read_manifest(data))
    root = tmp_path / "pmsData"
    names = lines(root / "names.txt")
    assert names == [f"{number:03d}.png" for number in range(1, LIGHTS + 1)]
    drawn = {}
    for object_name, (name, *_) in zip(lines(root / "objects.txt"), SCENES, strict=True):
        assert object_name == f"{name}PNG" and lines(root / object_name / "filenames.txt") == names
        source, exposure = shard(data, name), record(tmp_path)["scenes"][name]["exposure"]
        intensities = np.genfromtxt(root / object_name / "light_intensities.txt")
        assert intensities.shape == (LIGHTS, 3) and intensities.min() >= 0.2 and intensities.max() < 2.0
        drawn[name] = intensities
        for file, image, intensity in zip(names, source.images.astype(np.float32), intensities, strict=True):
            pixels = cv2.imread(str(root / object_name / file), cv2.IMREAD_UNCHANGED)[..., ::-1]
            assert pixels.dtype == np.uint16
            np.testing.assert_allclose(pixels / 65535.0, np.minimum(image * intensity * exposure, 1), atol=1e-5)
        normals = loadmat(root / object_name / "Normal_gt.mat")["Normal_gt"]
        np.testing.assert_array_equal(normals.astype(np.float32), source.normals)
        numbers = np.array((root / object_name / "normal.txt").read_text().split("\n"), np.float32)
        np.testing.assert_allclose(numbers.reshape(SIZE, SIZE, 3), normals, atol=1e-6)
        assert np.asarray(Image.open(root / object_name / "mask.png")).max() == 255
    assert not np.array_equal(drawn[SCENES[0][0]], drawn[SCENES[1][0]])  # one view, but lit differently
    assert check_tree(tmp_path, "diligent", shards=data).violations == []


def test_unips_loader(trees, data):
    for name, *_ in SCENES:
        folder = trees["unips"] / f"{name}.data"
        source, facts = shard(data, name), json.loads((folder / "scene.json").read_text())
        # Images are found by the letter L and sorted as plain text; depth follows from the file.
        files = sorted(path for path in folder.glob("L*") if path.suffix != ".txt")
        images = np.stack([cv2.imread(str(path), cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH) for path in files])
        assert images.dtype == np.uint16
        expected = np.minimum(source.images.astype(np.float32) * facts["exposure"], 1)
        np.testing.assert_allclose(images[..., ::-1] / 65535.0, expected, atol=1e-5)
        coded = cv2.imread(str(folder / "Normal_gt.png"), cv2.IMREAD_UNCHANGED)[..., ::-1] / 255.0 * 2 - 1
        length = np.linalg.norm(coded, axis=-1)
        np.testing.assert_array_equal(np.abs(1 - length) < 0.5, source.mask)
        np.testing.assert_array_equal(cv2.imread(str(folder / "mask.png"), cv2.IMREAD_UNCHANGED) > 0, source.mask)
        np.testing.assert_allclose(facts["light_directions"], source.light_directions, atol=1e-7)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_exported_trees_keep_every_rule(trees, data, layout):
    report = check_tree(trees[layout], layout, shards=data)
    assert report.violations == [] and report.samples == len(SCENES) and report.lights == (LIGHTS, LIGHTS)
    assert [line for line in report.warnings if "128x128" in line] == report.warnings  # the trees of tests are small
    assert len(report.warnings) == (layout == "psfcn")
    kept = record(trees[layout])
    assert kept["layout"] == layout and set(kept["versions"]) == {"sdps", "numpy", "opencv"}
    assert set(kept["scenes"]) == {name for name, *_ in SCENES}
    for scene in kept["scenes"].values():
        assert (trees[layout] / scene["folder"] / "scene.json").is_file() and len(scene["sha256"]) == 64


def test_exposure(data, tmp_path):
    scenes = read_manifest(data)
    report = export(data, tmp_path / "fixed", ExportOptions(layout="custom", exposure=2.0), scenes)
    gold = report.scenes["sphere-gold"]
    source = shard(data, "sphere-gold")
    assert gold["exposure"] == 2.0
    assert gold["clipped"] == pytest.approx((source.images[:, source.mask] > 0.5 + 0.25 / 255).mean(), abs=1e-6)
    assert report.worst("clipped")[1:] == (gold["clipped"], "sphere-gold")
    dim = export(data, tmp_path / "dim", ExportOptions(layout="custom", exposure=0.01), scenes).scenes["sphere-gold"]
    lit = source.images[:, source.mask].astype(np.float32)
    assert dim["black"] == pytest.approx((lit[lit > 0] * 0.01 < 0.5 / 255).mean(), abs=1e-3) and dim["black"] > 0.05
    for bits, share in ((8, 0.01), (16, 0.001)):
        options = ExportOptions(layout="custom", exposure="auto", bits=bits)
        for scene in export(data, tmp_path / f"auto{bits}", options, scenes).scenes.values():
            assert scene["clipped"] <= share + 1e-4
    image = cv2.imread(str(tmp_path / "auto16" / "sphere-gold" / "000.png"), cv2.IMREAD_UNCHANGED)
    assert image.dtype == np.uint16 and image.max() > 60000


def test_export_goes_on_where_it_stopped_and_ends_the_same(data, trees, tmp_path, monkeypatch):
    scenes = read_manifest(data)
    options = ExportOptions(layout="psfcn")
    real, calls = layout_base.write_png, []

    def failing(path, pixels):
        calls.append(path)
        if len(calls) == 9:
            Path(path).write_bytes(b"half")
            raise OSError(errno.ENOSPC, "No space left on device")
        real(path, pixels)

    monkeypatch.setattr(layout_base, "write_png", failing)
    with pytest.raises(InputError, match=r"cannot be written \(No space left on device\); free space") as caught:
        export(data, tmp_path / "tree", options, scenes)
    assert "\n" not in str(caught.value)
    left = [path for path in (tmp_path / "tree").rglob("*") if ".tmp" in path.name]
    assert left == [] and not (tmp_path / "tree" / "train_mtrl.txt").exists()
    monkeypatch.setattr(layout_base, "write_png", real)
    report = export(data, tmp_path / "tree", options, scenes[:2])
    assert (report.written, report.kept) == (1, 1)
    report = export(data, tmp_path / "tree", options, scenes)  # the rest, later
    assert (report.written, report.kept) == (2, 2)
    whole = {
        path.relative_to(trees["psfcn"]): path.read_bytes() for path in trees["psfcn"].rglob("*") if path.is_file()
    }
    for path, content in whole.items():
        assert (tmp_path / "tree" / path).read_bytes() == content, path


def test_foreign_and_differing_trees_are_refused(data, tmp_path):
    scenes = read_manifest(data)
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.tex").touch()
    with pytest.raises(InputError, match=r"foreign: has files but no export\.json.*choose another --out"):
        export(data, tmp_path / "foreign", ExportOptions(layout="unips"), scenes)
    export(data, tmp_path / "tree", ExportOptions(layout="unips"), scenes[:1])
    with pytest.raises(InputError, match=r"export\.json: bits was 16, now it is 8; choose another --out"):
        export(data, tmp_path / "tree", ExportOptions(layout="unips", bits=8), scenes[:1])
    with pytest.raises(InputError, match="layout was 'unips', now it is 'custom'"):
        export(data, tmp_path / "tree", ExportOptions(layout="custom", bits=16), scenes[:1])


def test_other_numbers_of_lights_do_not_fit_one_diligent_root(data, tmp_path):
    folder = tmp_path / "data"
    shutil.copytree(data, folder)
    scenes = read_manifest(folder)
    short = SceneSpec(**{**vars(scenes[0]), "lights": scenes[0].lights[:3], "id": "short"})
    from render.records.manifest import write_manifest

    write_manifest(folder, [*scenes, short])
    shutil.copy(folder / scenes[0].file, folder / short.file)
    with pytest.raises(InputError, match=r"from 3 to 5 lights, but a DiLiGenT root has one names\.txt"):
        export(folder, tmp_path / "out", ExportOptions(layout="diligent"), [*scenes, short])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"layout": "diligant"}, "unknown layout 'diligant'; did you mean 'diligent'"),
        ({"layout": "psfcn", "bits": 16}, "bits must be 8 for layout psfcn, got 16"),
        ({"layout": "psfcn", "intensities": "seed"}, "no file for intensities"),
        ({"layout": "unips", "exposure": 0.0}, "exposure must be a positive number"),
        ({"layout": "unips", "exposure": "bright"}, "exposure must be a positive number or 'auto'"),
        ({"layout": "unips", "intensities": "unite"}, "did you mean 'unit'"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(InputError, match=message):
        ExportOptions(**options)


def test_names_are_legal_and_unique():
    assert legal_name("stripes:7:/data/merl/chrome.binary+fits/blue fabric.yaml") == "stripes-7-chrome-blue-fabric"
    assert legal_name("lambertian:0.5") == "lambertian-0-5" and legal_name("#/石") == "unnamed"
    assert legal_name(r"C:\x\gold.bsdf") == "C-gold" and len(legal_name("a" * 300)) <= 80
    assert unique_names(["a", "b", "A", "a-1"]) == ["a-2", "b", "A-3", "a-1"]
    assert unique_names(["x"]) == ["x"]
    assert [natural_key(name) for name in image_names(1001)] == sorted(natural_key(n) for n in image_names(1001))
    names = ["a", "9.png", "010.png", "1" * 5000, "²"]
    assert sorted(reversed(names), key=natural_key) == [*names[1:4], *names[:1], *names[4:]]
    assert image_names(1001) == sorted(image_names(1001))


def test_two_files_of_one_name_in_one_view_stay_apart():
    common = {"seed": 0, "split": "train", "shape": "sphere", "view": View(), "lights": ((0.0, 0.0, 1.0),), "size": 8,
              "spp": 1, "bounces": 0}  # fmt: skip
    scenes = [SceneSpec(id=f"s-{k}", material=f"{folder}/gold.yaml", **common) for k, folder in enumerate("ab")]
    assert list(LAYOUTS["psfcn"].name_folders(scenes).values()) == ["Images/sphere/gold-1", "Images/sphere/gold-2"]
