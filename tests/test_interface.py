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


if __name__ == "__main__":
    there = {"commands": commands(), "lab": commands(IN_LAB), "keys": keys()}
    FILE.write_text(json.dumps(there, indent=1, sort_keys=True) + "\n", encoding="utf-8")
