"""Shipping weights, and writing down what they do."""

import json
from pathlib import Path

import pytest
import torch

from lab.commands import main
from lab.releases import shipped_results
from lab.releases.ship import ship
from render.shared.config import to_plain
from render.shared.errors import InputError
from sdps.methods import pretrained
from sdps.models.checkpoint import TrainedModel, load_weights, save_weights
from sdps.models.registry import create
from sdps.training.training_config import LightingTraining


def finished_run(out: Path, name: str = "lcnet") -> Path:
    metadata = {"config": to_plain(LightingTraining(steps=4)), "data": "0" * 64, "step": 4, "metrics": {}}
    path = out / "models" / name / f"{name}.safetensors"
    path.parent.mkdir(parents=True)
    save_weights(path, TrainedModel(name, create(name), {}, metadata))
    (path.parent / "metrics.jsonl").write_text('{"step": 4, "loss": 1.0}\n')
    return path


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that stands in for the package's own."""
    folder = tmp_path / "shipped"
    folder.mkdir()
    monkeypatch.setattr(pretrained, "shipped_folder", lambda: folder)
    return folder


def test_shipped_weights_are_halves_with_card_and_curve(tmp_path: Path, kept: Path) -> None:
    file = finished_run(tmp_path / "run")
    assert main(["ship", "--preset", "ship", "--out", str(tmp_path / "run"), "--models", "lcnet"]) == 0
    assert sorted(path.name for path in kept.iterdir()) == ["lcnet.jsonl", "lcnet.md", "lcnet.safetensors"]
    assert (kept / "lcnet.safetensors").stat().st_size < 0.51 * file.stat().st_size
    before, after = (
        load_weights(file).network.state_dict(),
        load_weights(kept / "lcnet.safetensors").network.state_dict(),
    )
    assert all(torch.equal(after[name], value.half().float()) for name, value in before.items())
    card = (kept / "lcnet.md").read_text()
    assert "8.8 MB as float16" in card and "4,409,692" in card and "license_name: research-use" in card
    written = {path: path.read_bytes() for path in kept.iterdir()}
    ship(["lcnet"], tmp_path / "run", kept)
    assert all(path.read_bytes() == data for path, data in written.items())  # git sees nothing new
    assert (
        pretrained.list_shipped() == ["lcnet"]
        and pretrained.locate("lcnet", tmp_path / "nothing") == kept / "lcnet.safetensors"
    )


def test_nothing_is_shipped_unless_all_runs_are_finished(tmp_path: Path, kept: Path) -> None:
    finished_run(tmp_path / "run")
    with pytest.raises(InputError, match="finish the run with `sdps train --models nenet"):
        ship(["lcnet", "nenet"], tmp_path / "run", kept)
    assert not list(kept.iterdir())


def evaluation(out: Path, used: Path) -> None:
    """Write what eval-merltest and eval-diligent write, in small."""
    rows = [["B1", "LCNet + NENet (shipped)", "3.10 (2.71)"], ["B2", "LCNet + PS-FCN", "not trained (3.19)"],
            ["-", "constant predictor", "45.05"]]  # fmt: skip
    lights = [["A0", "LCNet", "not trained (3.47)"], ["A1", "LCNet_reg", "not trained (4.10)"]]
    table = {"header": ["row", "model", "sphere"], "rows": rows}
    merltest = {
        "config": {"spp": 64, "repeats": 5}, "networks": "Networks: bfloat16.",
        "scenes": [{"shape": "sphere", "material": name} for name in ("chrome", "nylon")],
        "tables": {"Table A": {**table, "rows": lights}, "Table B, normal estimation (MAE)": table},
        "weights": {"lcnet": str(used)},
    }  # fmt: skip
    real = [["sdps (shipped)", "ours", "2.90", "-", "2.90", "-"], ["SDPS-Net", "SDPS-Net, CVPR 2019", "2.77", "8.06",
            "2.77", "9.51"], ["WT13", "SDPS-Net, CVPR 2019", "4.39", "36.55", "4.39", "23.93"]]  # fmt: skip
    header = ["method", "source", "ball", "cat", "this object", "all 10"]
    diligent = {"protocol": {"bits": 8}, "objects": {"ball": {}}, "weights": {},
                "tables": {"DiLiGenT (c), normals": {"header": header, "rows": real}}}  # fmt: skip
    for name, values in (("eval", merltest), ("diligent", diligent)):
        (out / name).mkdir(parents=True)
        (out / name / "results.json").write_text(json.dumps(values))


def test_results_go_beside_the_weights_and_into_a_page(tmp_path: Path, kept: Path) -> None:
    save_weights(kept / "lcnet.safetensors", load_weights(finished_run(tmp_path / "run")), half=True)
    evaluation(tmp_path / "out", kept / "lcnet.safetensors")
    page = tmp_path / "results.md"
    page.write_text(f"before\n{shipped_results.BEGIN}\nold\n{shipped_results.END}\nafter\n")
    command = ["shipped-results", "--out", str(tmp_path / "out"), "--page", str(page)]
    assert main(command) == 0
    text = (kept / "RESULTS.md").read_text()
    assert "2 scenes (sphere; 2 materials), 64 samples a pixel, 5 draws of light intensities" in text
    assert "| B1 | LCNet + NENet (shipped) | 3.10 (2.71) |" in text and "constant predictor" in text
    assert "not trained" not in text and "LCNet_reg" not in text
    assert "| A0 | LCNet | (3.47) |" in text
    assert "| method | source | ball |" in text and "| SDPS-Net | SDPS-Net, CVPR 2019 | 2.77 |" in text
    assert "WT13" not in text and "8 bits, ball" in text
    assert "`lcnet.safetensors` " in text
    first = page.read_text()
    assert first.startswith("before\n") and first.endswith("after\n") and "old" not in first
    assert text.partition("\n\n")[2] in first
    assert main(command) == 0 and page.read_text() == first  # again, and nothing piles up


def test_results_of_other_weights_and_pages_without_marks_are_refused(
    tmp_path: Path, kept: Path, capsys: pytest.CaptureFixture
) -> None:
    own = finished_run(tmp_path / "run")
    evaluation(tmp_path / "out", own)
    assert main(["shipped-results", "--out", str(tmp_path / "out")]) == 2
    assert "evaluated with the shipped weights" in capsys.readouterr().err
    save_weights(kept / "lcnet.safetensors", load_weights(own), half=True)
    evaluation(tmp_path / "again", kept / "lcnet.safetensors")
    page = tmp_path / "page.md"
    page.write_text("no marks")
    assert main(["shipped-results", "--out", str(tmp_path / "again"), "--page", str(page)]) == 2
    assert "has no marks" in capsys.readouterr().err
    assert page.read_text() == "no marks" and not (kept / "RESULTS.md").exists()
    assert main(["shipped-results", "--out", str(tmp_path / "none")]) == 2
    assert "run `make shipped-results`" in capsys.readouterr().err
