"""Refusals with a status of their own, and sizes as text."""

import errno

from render.shared.errors import InputError

GONE = "that was removed; load it again"
"""Message for a set of photographs that no longer exists."""
_FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))


class Refused(InputError):
    """A refusal that is not the user's mistake; mistakes are plain `InputError`, status 400.

    Args:
        message: One line.
        status: Of the answer.
    """

    def __init__(self, message: object, status: int) -> None:
        super().__init__(message)
        self.status = status


def explain_full_disk(name: str, error: OSError) -> Refused | None:
    """Return the refusal if the disk is full, None for other errors."""
    if error.errno not in _FULL:
        return None
    return Refused(f"{name}: the server's disk is full; free some space and try again", 507)


def format_size(size: int) -> str:
    """Return a number of bytes as text."""
    if size < 2**20:
        return f"{size / 2**10:.0f} KiB"
    return f"{size / 2**20:.0f} MiB" if size < 2**30 else f"{size / 2**30:.1f} GiB"
