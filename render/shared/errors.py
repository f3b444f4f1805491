"""Errors a user can cause, told in one line.

`InputError` is the only exception the command line turns into a message and exit code 2; anything
else is a defect and keeps its traceback.
"""

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """A mistake in a file, flag or name. The message is one line: what is wrong, where, and the remedy."""


def suggest(name: str, known: Iterable[str]) -> str:
    """Return `"; did you mean 'x'?"` for the nearest of `known`, or an empty string when none is near."""
    near = difflib.get_close_matches(name.lower(), list(known), n=2, cutoff=0.5)
    return f"; did you mean {' or '.join(repr(match) for match in near)}?" if near else ""


def unknown(kind: str, name: str, known: Iterable[str], remedy: str = "") -> InputError:
    """Build the error for a name that is not in `known`, with the nearest names and an optional remedy."""
    known = list(known)
    hint = suggest(name, known)
    if not hint and len(known) <= 12:
        hint = f"; known: {', '.join(known)}"
    return InputError(f"unknown {kind} {name!r}{hint}{'; ' + remedy if remedy else ''}")
