"""`sdps fit-material`: a table of a known material gives that material back, and mistakes end in one line."""

import numpy as np
import pytest
from merl_support import hemisphere, of_library, values
from PIL import Image

from pipelines.cli import main
from pipelines.rendering import fit_material
from render.materials import library, merl, model


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a table of `red-plastic` that misses what real tables miss: directions close to grazing."""
    folder = tmp_path_factory.mktemp("fit")
    holes = values("red-plastic").copy()
    for row in range(90):
        wi, wo = merl.centres(row)
        grazing = np.minimum(wi[:, 2], wo[:, 2]) < np.cos(np.radians(80))
        holes[:, row].reshape(3, -1)[:, grazing] = -1
    merl.write(folder / "plastic.binary", holes)
    return folder


def fails(capsys: pytest.CaptureFixture, *argv: str) -> str:
    """Run the command, expect exit code 2 and one line on standard error, and return it."""
    assert main(["fit-material", *argv]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("sdps: ")
    return line


def test_a_table_of_a_library_material_gives_that_material_back(capsys, folder, tmp_path):
    assert main(["fit-material", str(folder / "plastic.binary"), "--out", str(tmp_path), "--name", "2024"]) == 0
    text = capsys.readouterr().out
    assert "of the entries were measured" in text and "terms" in text and str(tmp_path / "2024.yaml") in text
    material = library.load(tmp_path / "2024.yaml")  # a name that YAML would read as a number
    assert (material.name, material.category) == ("2024", "measured")
    assert "plastic.binary (SHA-256 " in material.source and "terms" not in material.source and material.terms
    assert 0 < material.fit_error < 0.005
    assert f"error {material.fit_error:.1%}" in text
    wi, wo = hemisphere(4000, 1), hemisphere(4000, 2)
    measured = np.minimum(wi[:, 2], wo[:, 2]) > np.cos(np.radians(75))
    expected = of_library("red-plastic")(wi, wo)
    error = np.abs(model.evaluate(material, wi, wo) - expected)[measured] / expected[measured]
    assert np.median(error) < 0.01 and np.percentile(error, 95) < 0.1
    assert model.directional_albedo(material, np.linspace(0.05, 1, 10)).max() <= 1
    with Image.open(tmp_path / "2024.png") as picture:
        assert picture.size == (1040, 960) and np.asarray(picture.convert("L")).std() > 30


def test_the_picture_shows_table_fit_and_difference(folder):
    table, own = library.load(folder / "plastic.binary"), library.load("red-plastic")
    measured, fitted, difference = fit_material.sphere_images(table, own)
    assert measured.shape == (5, 160, 160, 3) and measured.dtype == np.uint8
    np.testing.assert_allclose(measured[0, 60:100, 60:100], fitted[0, 60:100, 60:100], atol=2)
    assert (measured[:, 0, 0] == 255).all()  # outside
    assert measured[0, 80, 80, 0] > measured[0, 80, 80, 2] + 20  # red
    assert difference[0, 60:100, 60:100].max() < 40
    *_, other = fit_material.sphere_images(table, library.load("green-plastic"))
    assert other[0, 60:100, 60:100].mean() > 100


def test_mistakes_end_in_one_line(capsys, folder, tmp_path):
    table, out = str(folder / "plastic.binary"), str(tmp_path / "out")
    assert "no such file" in fails(capsys, "absent.binary", "--out", out)
    assert "ending in .binary" in fails(capsys, "chrome", "--out", out)
    assert "letters" in fails(capsys, table, "--out", out, "--name", "../up")
    assert "--nam2" in fails(capsys, table, "--nam2", "x")
    (tmp_path / "cut.binary").write_bytes((folder / "plastic.binary").read_bytes()[:1000])
    assert "cut.binary: size" in fails(capsys, str(tmp_path / "cut.binary"), "--out", out)
    merl.write(tmp_path / "black.binary", np.zeros((3, *merl.SHAPE)))
    line = fails(capsys, str(tmp_path / "black.binary"), "--out", out)
    assert "black.binary: material 'black'" in line and "nothing to fit" in line
    assert not (tmp_path / "out").exists()
    (tmp_path / "file").write_text("")
    assert "cannot be written" in fails(capsys, table, "--out", str(tmp_path / "file" / "x"))
