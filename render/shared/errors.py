"""Errors a user can cause, each one line.

`InputError` is the only exception the command line turns into a message and exit code 2; anything
else is a defect and keeps its traceback.
"""

import difflib
import re
from collections.abc import Iterable, Sequence

_BREAKS = re.compile(r"\s*[\n\v\f\r\x1c-\x1e\x85\u2028\u2029]\s*")
_ADDRESSES = re.compile(r"\s*<[^<>]*\b(?:at )?0x[0-9a-fA-F]{4,}[^<>]*>")
_LONGEST = 1000


class InputError(ValueError):
    """A mistake in a file, flag or name. The message is one line: what is wrong, where, and the remedy.

    It may quote names and values from files. So line breaks in it become blanks, other control characters, which a
    terminal would obey, are spelled out, objects that a library's message shows by their address in memory
    (`<_io.BytesIO object at 0x7f...>`) are dropped, and of more than 1,000 characters the middle is left out.
    """

    def __init__(self, message: object) -> None:
        text = str(message)
        if len(text) > 100 * _LONGEST:
            text = f"{text[:_LONGEST]}{text[-_LONGEST:]}"
        text = _ADDRESSES.sub("", _BREAKS.sub(" ", text))
        text = "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)
        if len(text) > _LONGEST:
            text = f"{text[: _LONGEST // 2]} [...] {text[-_LONGEST // 2 :]}"
        super().__init__(text)


def unknown(kind: str, name: str, known: Iterable[str], remedy: str = "") -> InputError:
    """Build the error for a name that is not in `known`, with the nearest names and an optional remedy."""
    known = list(known)
    near = difflib.get_close_matches(name.lower(), known, n=2, cutoff=0.5)
    hint = f"; known: {', '.join(known)}" if len(known) <= 12 else ""
    if near:
        hint = f"; did you mean {' or '.join(map(repr, near))}?"
    return InputError(f"unknown {kind} {name!r}{hint}{'; ' + remedy if remedy else ''}")


def list_names(names: Sequence[str], most: int = 10) -> str:
    """Write names one after another; of many the first, and how many more there are."""
    if len(names) <= most + 1:
        return ", ".join(names)
    return f"{', '.join(names[:most])} and {len(names) - most} more"
