"""What users rely on stays: every command, flag, default and preset key of `support/interface.json`.

A flag or key may be added; `python tests/test_interface.py` then writes the file again. Taking one away, or changing a
default, breaks somebody's script: say so in the CHANGELOG.
"""

import argparse
import dataclasses
import json
from pathlib import Path

import pytest

from lab.commands import COMMANDS as IN_LAB
from pipelines import cli
from pipelines.shared import presets
from sdps.training import training_config

EARLIER = {
    "materials": "list materials",
    "shapes": "list shapes",
    "models": "list models",
    "eval-merltest": "evaluate merltest",
    "eval-diligent": "evaluate diligent",
    "eval-lights --dataset gourd-apple": "evaluate gourd-apple",
    "eval-lights --dataset light-stage": "evaluate light-stage",
    "eval-classical": "evaluate classical",
    "eval-photos": "evaluate uw",
    "report": "evaluate report",
    "regenerate --lights": "regenerate --light-set",
    "demo --lights": "demo --light-set",
    "evaluate merltest --lights": "evaluate merltest --lighting",
}
"""Earlier names of commands and flags, which go on working and are not listed in any help, and what they are now."""

IN_CLONES = {name: f"python -m lab {name}" for name in cli.IN_LAB}
"""Commands that left the installed package."""

GONE = {
    "curves": "learning curves are in every run's folder",
    "eval-merltest --second": "the second lighting pass lost, and had no weights",
    "eval-diligent --cluster": "a cluster renders; it no longer evaluates",
    "eval-lights --cluster": "a cluster renders; it no longer evaluates",
    "eval-diligent --cluster-config": "a cluster renders; it no longer evaluates",
    "eval-lights --cluster-config": "a cluster renders; it no longer evaluates",
    "noise --cluster": "a cluster renders; it no longer measures noise",
    "noise --cluster-config": "a cluster renders; it no longer measures noise",
}
"""What was taken away, and why: the preset section `joint` and the keys of what lost as well."""

FILE = Path(__file__).parent / "support" / "interface.json"


def choices(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Return the parsers of a parser's commands."""
    return next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction)).choices


def flags(parser: argparse.ArgumentParser) -> dict[str, str]:
    """Return {flags, or name of a position: default} of a command."""
    actions = [action for action in parser._actions if not isinstance(action, argparse._HelpAction)]
    return {" ".join(action.option_strings) or action.dest: repr(action.default) for action in actions}


def commands(there: cli.Commands = cli.COMMANDS) -> dict[str, dict[str, str]]:
    found = {}
    for name, command in there.items():
        words = [[name, child] for child in command.commands] if isinstance(command, cli.Group) else [[name]]
        for path in words:
            parser = cli.build_parser(path, there)
            for word in path:
                parser = choices(parser)[word]
            found[" ".join(path)] = flags(parser)
    return found


def keys() -> dict[str, dict[str, str]]:
    """Return {section: {key: default}} of presets and of the training runs in them."""
    preset = presets.load("demo")
    sections = {"preset": type(preset), "data": type(preset.data), "test": type(preset.test)}
    sections["stream"] = type(preset.stream)
    for name in ("LightingTraining", "NormalTraining", "PixelTraining"):
        sections[name] = getattr(training_config, name)
    return {name: _fields(kind) for name, kind in sections.items()}


def _fields(kind: type) -> dict[str, str]:
    return {
        item.name: "made" if item.default is dataclasses.MISSING else repr(item.default)
        for item in dataclasses.fields(kind)
    }


@pytest.mark.parametrize("kind", ["commands", "lab", "keys"])
def test_nothing_that_users_rely_on_is_gone(kind: str) -> None:
    promised = json.loads(FILE.read_text(encoding="utf-8"))[kind]
    there = {"commands": commands, "lab": lambda: commands(IN_LAB), "keys": keys}[kind]()
    for place, names in promised.items():
        assert place in there
        for name, default in names.items():
            assert there[place].get(name) == default, f"{place}: {name}"


def split(text: str) -> tuple[list[str], str]:
    """Return the words of a command, and the flag after them."""
    words = text.split()
    places = [number for number, word in enumerate(words) if word.startswith("-")]
    return (words[: places[0]], words[places[0]]) if places else (words, "")


def options(words: list[str]) -> dict[str, argparse.Action]:
    """Return the flags of a command by each of their spellings."""
    parser = cli.build_parser(words)
    for word in words:
        parser = choices(parser)[word]
    return {name: action for action in parser._actions for name in action.option_strings}


@pytest.mark.parametrize(("earlier", "now"), EARLIER.items())
def test_earlier_names_work_and_are_not_listed(earlier: str, now: str) -> None:
    (old_words, old_flag), (new_words, new_flag) = split(earlier), split(now)
    old, new = options(old_words), options(new_words)
    if old_words == new_words:
        assert old[old_flag].dest == new[new_flag].dest and old[old_flag].help == argparse.SUPPRESS
    else:
        assert cli.COMMANDS[old_words[0]].hidden and set(new) <= set(old)


@pytest.mark.parametrize("gone", [*GONE, *IN_CLONES])
def test_what_is_gone_is_said_to_be_gone(gone: str) -> None:
    words, flag = split(gone)
    there = commands(IN_LAB) if flag and words[0] in IN_LAB else commands()
    assert " ".join(words) not in there or not any(flag in name.split() for name in there[" ".join(words)])


if __name__ == "__main__":
    there = {"commands": commands(), "lab": commands(IN_LAB), "keys": keys()}
    FILE.write_text(json.dumps(there, indent=1, sort_keys=True) + "\n", encoding="utf-8")
