"""What the lists of models and materials say, and the file names made of material names."""

import json

import numpy as np
import pytest
import textures_support

from pipelines.cli import main
from pipelines.shared.scenes import slug
from render.materials import merl
from render.materials.textures.textured import KINDS
from sdps.methods import pretrained
from sdps.models.blocks import parameter_count
from sdps.models.checkpoint import load_weights


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "my chrome.binary"
    merl.write(path, np.ones((3, *merl.SHAPE)))
    return str(path)


def test_the_list_takes_names_categories_and_files(capsys, table):
    assert main(["materials", "--materials", f"chrome,{table}", "--materials", "plastic"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("chrome ") and "fit error" in lines[0]
    assert lines[1].split(table)[1].split() == ["measured", "table"]
    assert lines[-1].startswith("11 materials") and ".binary (MERL)" in lines[-1] and ".bsdf (RGL)" in lines[-1]


def test_the_list_has_one_procedural_material_of_each_kind(capsys, tmp_path):
    textures_support.write_maps(tmp_path)
    assert main(["materials", "--category", "procedural"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[1] for line in lines[:-1]] == list(KINDS)
    assert main(["materials", "--materials", f"{tmp_path},procedural:wood:3:chrome+nylon"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split(str(tmp_path))[1].split() == ["texture-maps", "maps"]
    assert lines[1].split("nylon")[1].split() == ["procedural-wood", "2", "materials"]


def test_the_list_of_models_counts_shipped_weights_which_may_be_larger(capsys):
    """`sdps-frames` was listed as 5.4 M parameters, those of the models' defaults, and answers with 9.2 M."""
    assert main(["list", "models", "--json"]) == 0
    counts = {item["name"]: item["shipped_parameters"] for item in json.loads(capsys.readouterr().out)}
    for name in ("lcnet", "frames"):
        assert counts[name] == parameter_count(load_weights(pretrained.locate(name)).network)
    assert counts["nenet-reg"] is None
    assert main(["list", "models"]) == 0
    rows = {line.split()[0]: line.split()[1:3] for line in capsys.readouterr().out.splitlines() if line}
    assert rows["sdps-frames"] == ["5,392,616", f"{counts['lightset'] + counts['frames']:,}"]
    assert rows["sdps-reg"][1] == "-"


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--materials", "chrom"], "did you mean 'chrome'"),
        (["--materials", "absent.binary"], "no such file"),
        (["--materials", "procedural:wod:3"], "did you mean 'wood'"),
        (["--materials", "maps:2:absent"], "no such folder of maps"),
        (["--materials", "chrome", "--category", "metal"], "--materials takes categories too"),
    ],
)
def test_mistakes_end_in_one_line(capsys, flags, message):
    assert main(["materials", *flags]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_file_names_of_materials_are_plain_and_differ():
    names = {
        "chrome": "chrome",
        "some/folder/chrome.binary": "chrome.binary",
        "my file.bsdf": "my-file.bsdf",
        "a/b/fit.yaml": "fit",
        "lambertian:0.8/0.3/0.1": "lambertian-0.8-0.3-0.1",
        "stripes:7:chrome+blue-fabric": "stripes-7-chrome--blue-fabric",
        "noise:0:a/chrome.binary+lambertian:0.5/0.2/0.1+fit.yaml": "noise-0-chrome.binary--lambertian-0.5-0.2-0.1--fit",
        "my_mesh+2.obj": "my-mesh-2.obj",
        "procedural:wood:7": "procedural-wood-7",
        "procedural:wood:7:chrome+a/fit.yaml": "procedural-wood-7-chrome--fit",
        "maps:2.5:/a/b/Bricks_012": "maps-2.5-Bricks-012",
    }
    assert {name: slug(name) for name in names} == names
    varying = [f"{pattern}:{seed}:chrome+{other}" for pattern in ("parts", "noise") for seed in (0, 10)
               for other in ("brass", "brass+nylon", "x.binary", "x.bsdf")]  # fmt: skip
    assert len({slug(name) for name in varying}) == len(varying)
