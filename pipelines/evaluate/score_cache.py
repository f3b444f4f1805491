"""Scores kept on disk as they are found, so that a stopped evaluation goes on where it was."""

import json
from pathlib import Path
from typing import Any

from render.shared.errors import InputError
from render.shared.files import read_whole_lines


class ScoreCache:
    """Results by key in a file of JSON lines, appended to one by one.

    A line torn by a crash is skipped, and its result found again.

    Args:
        path: The file; it appears with its first line.
        identity: What the results depend on besides their key (settings, hash of the data, weights). Lines written
            under another identity are ignored.

    Raises:
        InputError: the file cannot be read or written.
    """

    def __init__(self, path: Path, identity: str) -> None:
        self.path, self.identity = path, identity
        self._found: dict[tuple[str, ...], Any] = {}
        for row in read_whole_lines(path):
            if isinstance(row, dict) and row.get("identity") == identity and {"key", "value"} <= row.keys():
                self._found[tuple(row["key"])] = row["value"]

    def __contains__(self, key: tuple[str, ...]) -> bool:
        return key in self._found

    def __getitem__(self, key: tuple[str, ...]) -> Any:
        return self._found[key]

    def get(self, key: tuple[str, ...]) -> Any:
        """Return the result of a key, or None."""
        return self._found.get(key)

    def add(self, key: tuple[str, ...], value: Any) -> None:
        """Keep a result, in memory and at the end of the file."""
        self._found[key] = value
        row = {"identity": self.identity, "key": list(key), "value": value}
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a", encoding="utf-8") as handle:
                handle.write("\n" * self._torn() + json.dumps(row) + "\n")
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written ({error.strerror or error})") from error

    def _torn(self) -> bool:
        """Return whether the file ends within a line."""
        if not self.path.is_file() or self.path.stat().st_size == 0:
            return False
        with self.path.open("rb") as handle:
            handle.seek(-1, 2)
            return handle.read(1) != b"\n"
