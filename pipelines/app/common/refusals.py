"""What the server refuses with a status of its own, and sizes in words."""

import errno

from render.shared.errors import InputError

GONE = "that has been removed; load it again"
"""Of a set of photographs that is not there any more."""
_FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))


class Refused(InputError):
    """A refusal that is not the visitor's mistake; those are plain `InputError`, and 400.

    Args:
        message: One line.
        status: Of the answer.
    """

    def __init__(self, message: object, status: int) -> None:
        super().__init__(message)
        self.status = status


def explain_full_disk(name: str, error: OSError) -> Refused | None:
    """Return the refusal where the disk has no room for an upload, None for other errors."""
    if error.errno not in _FULL:
        return None
    return Refused(f"{name}: the disk of the server is full; free space on it and try again", 507)


def format_size(size: int) -> str:
    """Return a number of bytes in words."""
    if size < 2**20:
        return f"{size / 2**10:.0f} KiB"
    return f"{size / 2**20:.0f} MiB" if size < 2**30 else f"{size / 2**30:.1f} GiB"
