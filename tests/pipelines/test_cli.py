"""The command line: unknown words, help, and what is missing."""

import re

from command_line import fails

from pipelines.cli import COMMANDS, Group, main
from pipelines.shared import scenes
from pipelines.shared.flags import split_list
from sdps.methods import pretrained


def test_unknown_command_and_flag(capsys):
    assert "did you mean 'train'" in fails(capsys, "trian")
    assert "--presett" in fails(capsys, "train", "--presett", "demo")


def test_help_lists_every_command_but_earlier_names(capsys):
    assert main([]) == 0
    listed = set(re.findall(r"^    ([a-z][a-z-]+)", capsys.readouterr().out, re.MULTILINE))
    assert listed == {name for name, command in COMMANDS.items() if isinstance(command, Group) or not command.hidden}


def test_train_and_evaluate_without_data_or_weights_say_what_to_run(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(pretrained, "list_shipped", list)  # as if none travelled with the package
    assert "sdps render-data" in fails(capsys, "train", "--preset", "smoke", "--out", str(tmp_path / "none"))
    asked = (
        "evaluate",
        "merltest",
        "--preset",
        "smoke",
        "--out",
        str(tmp_path / "none"),
        "--set",
        "test.shipped=[all]",
    )
    assert "sdps train" in fails(capsys, *asked)
    assert not (tmp_path / "none" / "merltest").exists()


def test_data_commands_name_the_folder_that_was_meant(capsys, tmp_path):
    assert main(["data"]) == 0
    assert "validate" in capsys.readouterr().out
    assert "did you mean 'status'" in fails(capsys, "data", "stauts")
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "manifest.jsonl").write_text("")
    for command in ("status", "validate", "preview", "card"):
        assert f"name its data folder, {tmp_path / 'data'}" in fails(capsys, "data", command, str(tmp_path))
        assert "no manifest.jsonl there" in fails(capsys, "data", command, str(tmp_path / "none"))
    line = fails(capsys, "render-data", "--preset", "smoke", "--out", str(tmp_path / "data"))
    assert "--out names the folder above" in line and not (tmp_path / "data" / "data").exists()


def test_materials_and_shapes_list_what_there_is(capsys):
    assert main(["materials"]) == 0
    assert "100 materials" in (listing := capsys.readouterr().out) and "gold-metallic-paint" in listing
    assert main(["materials", "--category", "phenolic"]) == 0
    assert capsys.readouterr().out.count("fit error") == 12
    assert "did you mean 'plastic'" in fails(capsys, "materials", "--category", "plastik")
    assert main(["shapes"]) == 0
    assert "sculpture:<seed>" in capsys.readouterr().out


def test_list_flags_take_commas_and_repetition():
    assert split_list(["a,b", "c", " d ,"]) == ["a", "b", "c", "d"]
    assert scenes.slug("lambertian:0.8/0.3/0.1") == "lambertian-0.8-0.3-0.1"
    assert scenes.slug("some/folder/my steel.yaml") == "my-steel"
