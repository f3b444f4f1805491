"""The checks of a tree: each thing that its loaders would miss or misread is named in one line."""

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from exchange_support import LIGHTS, SIZE
from scipy.io import savemat

from render.exchange.layouts.layout_base import image_names
from render.exchange.tree_check import check_tree
from render.shared.errors import InputError

Damage = Callable[[Path], object]


@pytest.fixture
def tree(trees, tmp_path) -> Path:
    shutil.copytree(trees["psfcn"], tmp_path / "tree")
    return tmp_path / "tree"


SAMPLE = "Images/blobby-00001-v0/blue-fabric"
LIST = f"{SAMPLE}/blobby-00001-v0_blue-fabric.txt"
NORMALS = "Images/blobby-00001-v0/blobby-00001-v0_normal.png"


def replace(path: str, old: str, new: str):
    def change(root: Path) -> None:
        text = (root / path).read_text()
        assert old in text
        (root / path).write_text(text.replace(old, new, 1))

    return change


def repaint(path: str, edit, flags: int = cv2.IMREAD_UNCHANGED):
    return lambda root: cv2.imwrite(str(root / path), edit(cv2.imread(str(root / path), flags)))


def flip_lights(root: Path) -> None:
    rows = [line.split(" ") for line in (root / LIST).read_text().splitlines()]
    (root / LIST).write_text("".join(f"{a} {x} {-float(y)} {z}\n" for a, x, y, z in rows))


def background(value: int):
    def edit(pixels: np.ndarray) -> np.ndarray:
        pixels[0, 0] = value
        return pixels

    return edit


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (replace(LIST, "000.png ", "000#.png "), "has a '#', which loaders take for a comment"),
        (replace(LIST, "000.png ", "000.png  "), "with single spaces"),
        (replace(LIST, "000.png ", "000.png\t"), "with single spaces"),
        (replace(LIST, "\n", " 1.0\n"), "lines have from 4 to 5 fields"),
        (replace(LIST, "000.png", "001.png"), "an image is listed twice"),
        (replace(LIST, "000.png 0.", "000.png 3."), "light 1 has length"),
        (replace(LIST, "000.png 0.", "000.png x."), "are not numbers"),
        (replace(LIST, "000.png", "missing.png"), "missing.png: no such picture"),
        (replace("train_mtrl.txt", "/blue", "/deep/blue"), "with exactly one '/'"),
        (replace("train_mtrl.txt", "/blue", "/b#ue"), "has a '#'"),
        (replace("val_mtrl.txt", "v1/lambertian-0-5", "v0/blue-fabric"), "keep it in one list"),
        (lambda root: (root / "val_mtrl.txt").unlink(), "val_mtrl.txt: missing; training opens both lists"),
        (repaint(f"{SAMPLE}/001.png", lambda p: p, cv2.IMREAD_GRAYSCALE), "1 channel"),
        (repaint(f"{SAMPLE}/001.png", lambda p: p[:-1]), "one size"),
        (repaint(f"{SAMPLE}/001.png", lambda p: p.astype(np.uint16) * 257), "16 bits, the others 8"),
        (lambda root: os.truncate(root / SAMPLE / "002.png", 90), "damaged"),
        (repaint(NORMALS, background(0)), "background pixels are not 127 or 128"),
        (repaint(NORMALS, lambda p: (p // 2) + 64), "are not unit normals"),
        (repaint(NORMALS, lambda p: 255 - p), "normals point into the object|the mask differs"),
        (flip_lights, "lights fit the shading better with y negated"),
        (lambda root: [cv2.imwrite(str(path), np.zeros((SIZE, SIZE, 3), np.uint8)) for path in
                       (root / SAMPLE).glob("*.png")], "all images are black"),
    ],
)  # fmt: skip
def test_the_checker_names_what_is_broken(tree, damage, message, capfd):
    damage(tree)
    report = check_tree(tree, "psfcn")
    assert report.violations and any(re.search(message, line) for line in report.violations), report.violations
    assert all("\n" not in line and line.startswith(str(tree)) for line in report.violations)
    assert "libpng" not in capfd.readouterr().err


def test_the_checker_compares_with_the_shards(tree, data):
    coded = cv2.imread(str(tree / NORMALS), cv2.IMREAD_UNCHANGED)
    rows, columns = np.nonzero((coded != 128).any(-1))
    coded[rows[0], columns[0]] = 128
    cv2.imwrite(str(tree / NORMALS), coded)
    assert check_tree(tree, "psfcn").violations == []
    assert len(check_tree(tree, "psfcn", shards=data).violations) == 2  # both materials of the view
    assert "mask differs" in check_tree(tree, "psfcn", shards=data).violations[0]


OBJECT = "pmsData/sphere-goldPNG"


def write(path: str, text: str) -> Damage:
    return lambda root: (root / path).write_text(text)


def remove(path: str) -> Damage:
    return lambda root: (root / path).unlink()


@pytest.mark.parametrize(
    ("layout", "damage", "message"),
    [
        ("custom", write("sphere-gold/light_intensities.txt", "1\n" * LIGHTS), r"1 column\(s\) where 3 are needed"),
        ("custom", write("sphere-gold/light_intensities.txt", "1 1 1\n"), rf"1 rows for {LIGHTS} images"),
        ("custom", write("sphere-gold/light_intensities.txt", "1 1 1\n" * 4 + "1 0 1\n"), "line 5 is not positive"),
        ("custom", write("sphere-gold/names.txt", "".join(f"{name}\n" for name in reversed(image_names(LIGHTS)))),
         "not in natural order"),
        ("custom", repaint("sphere-gold/mask.png", lambda p: p | 255), r"normal\.png: \d+ pixels of mask\.png have no"),
        ("custom", remove("objects.txt"), r"objects\.txt: no such file"),
        ("diligent", remove("pmsData/names.txt"), r"names\.txt: missing; SDPS-Net lists objects and images by it"),
        ("diligent", write("pmsData/names.txt", "a.png\n"), r"filenames\.txt: differs from .*names\.txt"),
        ("diligent", write(f"{OBJECT}/normal.txt", "0\n" * SIZE * SIZE * 3), r"normal\.txt: differs"),
        ("diligent", write(f"{OBJECT}/normal.txt", "up"), r"normal\.txt: differs from Normal_gt\.mat"),
        ("diligent", lambda root: savemat(root / OBJECT / "Normal_gt.mat", {"N": 0}), "no variable Normal_gt"),
        ("unips", remove("sphere-gold.data/L001.png"), r"L\*\.png do not match the lights of scene\.json"),
        ("unips", repaint("sphere-gold.data/mask.png", lambda p: p * 0), r"mask\.png: the mask is empty"),
        ("unips", repaint("sphere-gold.data/Normal_gt.png", lambda p: p[1:]), r"mask\.png: is 24x24, Normal_gt"),
    ],
)  # fmt: skip
def test_rules_of_the_other_layouts(trees, tmp_path, layout, damage, message):
    shutil.copytree(trees[layout], tmp_path / "tree")
    damage(tmp_path / "tree")
    violations = check_tree(tmp_path / "tree", layout).violations
    assert any(re.search(message, line) for line in violations), violations
    assert all("\n" not in line and line.startswith(str(tmp_path)) for line in violations)


def test_custom_folders_need_no_lights_and_no_normals(trees, tmp_path):
    shutil.copytree(trees["custom"], tmp_path / "tree")
    for name in ("light_directions.txt", "light_intensities.txt", "normal.png"):
        (tmp_path / "tree" / "sphere-gold" / name).unlink()
    assert check_tree(tmp_path / "tree", "custom").violations == []


def test_a_limit_reads_few_pictures_but_every_list(tree):
    (tree / SAMPLE / "001.png").write_text("hello")
    assert len(check_tree(tree, "psfcn", limit=4).violations) == 1
    (tree / LIST).write_text("hello")
    assert LIST in check_tree(tree, "psfcn", limit=1).violations[0]
    with pytest.raises(InputError, match="limit must be at least 1, got 0"):
        check_tree(tree, "psfcn", limit=0)


def test_mistakes(tree):
    with pytest.raises(InputError, match="unknown layout 'psfnc'; did you mean 'psfcn'"):
        check_tree(tree, "psfnc")
    with pytest.raises(InputError, match="absent: no such folder; give the root of a psfcn tree"):
        check_tree(tree / "absent", "psfcn")
    assert "no train_mtrl.txt" in check_tree(tree / "Images", "psfcn").violations[0]
