"""Errors a user can cause, told in one line.

`InputError` is the only exception the command line turns into a message and exit code 2; anything
else is a defect and keeps its traceback.
"""

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """A mistake in a file, flag or name. The message is one line: what is wrong, where, and the remedy."""


def unknown(kind: str, name: str, known: Iterable[str], remedy: str = "") -> InputError:
    """Build the error for a name that is not in `known`, with the nearest names and an optional remedy."""
    known = list(known)
    near = difflib.get_close_matches(name.lower(), known, n=2, cutoff=0.5)
    hint = f"; known: {', '.join(known)}" if len(known) <= 12 else ""
    if near:
        hint = f"; did you mean {' or '.join(map(repr, near))}?"
    return InputError(f"unknown {kind} {name!r}{hint}{'; ' + remedy if remedy else ''}")
