"""The command line as tests call it."""

import re

import pytest

from pipelines.cli import main

TINY = [word for item in ("size=32", "spp=2", "bounces=0") for word in ("--set", f"test.{item}")]
"""Overrides that make test scenes small."""


def fails(capsys: pytest.CaptureFixture, *argv: str) -> str:
    """Run a command, expect exit code 2 and one line on standard error, and return that line."""
    assert main(argv) == 2
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if line and not re.search(r"\d+%\|", line)]
    assert len(lines) == 1 and lines[0].startswith("sdps: "), captured.err
    return lines[0]
