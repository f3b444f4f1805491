"""Axes that a file of lights may have, and their names."""

import numpy as np

from render.shared.errors import InputError, unknown

FLAGS = {"y-up": (1, 1, 1), "y-down": (1, -1, 1), "x-left": (-1, 1, 1), "z-away": (1, 1, -1)}
"""Axes of a lights file that point another way than ours, and the signs that turn them."""

SWAPPED = "xy-swapped"
"""The file's first number is y and its second x, as of pictures turned by a quarter; the other flags name our axes."""


def frame_matrix(frame: str) -> np.ndarray:
    """Return the (3, 3) matrix that turns vectors of a frame into ours: x right, y up, z to the camera.

    Args:
        frame: y-up, y-down, x-left, z-away, xy-swapped; several joined by commas.

    Raises:
        InputError: an unknown flag, or y-up with y-down.
    """
    flags = {flag.strip().lower() for flag in str(frame).split(",") if flag.strip()}
    for flag in sorted(flags):
        if flag not in (*FLAGS, SWAPPED):
            raise unknown("frame", flag, (*FLAGS, SWAPPED))
    if {"y-up", "y-down"} <= flags:
        raise InputError(f"frame {frame!r} says both y-up and y-down; keep one")
    signs = np.prod([FLAGS[flag] for flag in flags - {SWAPPED}] or [(1, 1, 1)], axis=0)
    return np.diag(signs).astype(float) @ (np.eye(3)[[1, 0, 2]] if SWAPPED in flags else np.eye(3))


def frame_name(matrix: np.ndarray) -> str:
    """Return the flags of a matrix of `frame_matrix`, or of products of such."""
    x, y, z = matrix.sum(axis=1)
    flags = [flag for flag, sign in (("x-left", x), ("y-down", y), ("z-away", z)) if sign < 0]
    return ",".join([*flags, *([SWAPPED] if matrix[0, 0] == 0 else [])]) or "y-up"
