"""Processes that divide the work take all of it, each scene once; what is no part is one line."""

import argparse

import pytest

from lab.shared.scene_parts import Part, add_part


def read(*arguments: str) -> Part:
    parser = argparse.ArgumentParser()
    add_part(parser)
    return parser.parse_args(arguments).part


def test_parts_are_all_of_the_work() -> None:
    items = list("abcdefg")
    assert read().take(items) == items
    parts = [read("--part", f"{number}/3").take(items) for number in range(3)]
    assert parts[1] == ["b", "e"] and sorted(item for part in parts for item in part) == items


@pytest.mark.parametrize("text", ["2", "3/3", "-1/2", "a/b", "0/0"])
def test_what_is_no_part_is_refused(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        read(f"--part={text}")
    assert stopped.value.code == 2 and "must be K/N" in capsys.readouterr().err
