"""`--help` of every command: flags in groups, defaults shown once, an example that parses at the end; earlier names."""

import shlex

import pytest

from pipelines import cli
from pipelines.cli import COMMANDS, Command, Group, build_parser, main

PATHS = [
    (path, command)
    for name, entry in COMMANDS.items()
    for path, command in (
        [((name, child), command) for child, command in entry.commands.items()]
        if isinstance(entry, Group)
        else [((name,), entry)]
    )
]


@pytest.mark.parametrize(("path", "command"), PATHS, ids=[" ".join(path) for path, _ in PATHS])
def test_help_ends_with_an_example_that_parses(path: tuple[str, ...], command: Command, capsys) -> None:
    with pytest.raises(SystemExit):
        main([*path, "--help"])
    text = capsys.readouterr().out
    lines = command.example.splitlines()
    assert text.rstrip().endswith(lines[-1]) and "SUPPRESS" not in text and "(default: None)" not in text
    for line in lines:
        words = shlex.split(line)
        assert words[0] == "sdps" and (command.hidden or tuple(words[1 : 1 + len(path)]) == path)
        build_parser([word for word in words[1:] if not word.startswith("-")]).parse_args(words[1:])


def test_flags_stand_in_groups_and_show_their_defaults(capsys) -> None:
    with pytest.raises(SystemExit):
        main(["regenerate", "--help"])
    text = capsys.readouterr().out
    headings = [line[:-1] for line in text.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert headings == ["options", *(name for name in cli.GROUPS if name != "how it is solved"), "example"]
    assert text.count("(default: small)") == 1


@pytest.mark.parametrize(
    ("former", "words"), [("materials", ["--category", "metal"]), ("shapes", []), ("models", ["--role", "normals"])]
)
def test_lists_have_one_command_and_keep_their_earlier_names(former: str, words: list[str], capsys) -> None:
    assert main(["list", former, *words]) == 0
    listed = capsys.readouterr().out
    assert main([former, *words]) == 0
    assert capsys.readouterr().out == listed
    assert main([]) == 0
    assert f"\n    {former} " not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("kind", "names"), [("light-sets", ("merltest", "grid:<count>")), ("presets", ("demo", "ship"))]
)
def test_light_sets_and_presets_are_listed(kind: str, names: tuple[str, ...], capsys) -> None:
    assert main(["list", kind]) == 0
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert set(names) <= set(listed)


@pytest.mark.parametrize("command", ["regenerate", "demo"])
def test_a_light_set_may_be_named_by_the_flag_s_earlier_name(command: str) -> None:
    parser = build_parser([command])
    assert parser.parse_args([command, "--lights", "diligent"]) == parser.parse_args(
        [command, "--light-set", "diligent"]
    )
