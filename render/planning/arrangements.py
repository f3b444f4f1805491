"""Arrangements of lights as people and benchmarks build them, each a random member of its kind.

Every function draws a set: where the bulbs of a rig hang, or how a hand moved. All return unit vectors (count, 3)
float64 from the surface to the light, camera frame (x right, y up, z to the camera), z > 0. The same generator gives
the same set. Angles are degrees from the viewing axis.
"""

import numpy as np

from render.shared.imaging.vectors import unit

GRID_EDGE = (35.0, 45.0)  # of the outermost bulb; DiLiGenT's lights (Shi et al., PAMI 2019) all lie within 45 degrees
RING_ANGLES = (15.0, 75.0)
DOME_EDGE = (60.0, 85.0)
HAND_EDGE = 80.0
_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))


def grid(count: int, rng: np.random.Generator) -> np.ndarray:  # (count, 3)
    """Draw a narrow grid of bulbs on a flat board behind the camera, as of DiLiGenT's rig.

    The board's rows and columns are evenly spaced in its plane, 1 to 2 times as many columns as rows; it is a little
    turned, and every bulb hangs a little off its place. The outermost bulb is 35 to 45 degrees from the axis. Where
    rows and columns make more places than bulbs, those left free are drawn at random.
    """
    aspect = rng.uniform(1.0, 2.0)
    rows = max(1, round(np.sqrt(count / aspect)))
    columns = -(-count // rows)
    x, y = np.meshgrid(np.linspace(-1, 1, columns) if columns > 1 else [0.0], np.linspace(-1, 1, rows)[::-1])
    board = np.stack([x.ravel() * max(columns - 1, 1) / max(rows - 1, 1), y.ravel()], axis=1)  # square meshes
    board = board[np.sort(rng.permutation(len(board))[:count])]
    board += rng.normal(0.0, 0.05 * 2 / max(rows - 1, 1), board.shape)
    turn = np.radians(rng.uniform(-10.0, 10.0))
    board = board @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    furthest = max(np.linalg.norm(board, axis=1).max(), 1e-9)
    board *= np.tan(np.radians(rng.uniform(*GRID_EDGE))) / furthest
    return unit(np.concatenate([board, np.ones((count, 1))], axis=1))


def rings(count: int, rng: np.random.Generator) -> np.ndarray:  # (count, 3)
    """Draw one to three rings around the camera, 15 to 75 degrees from its axis, evenly occupied in proportion to size.

    As ring lights and microscope illuminators, or a lamp carried around the object at fixed heights.
    """
    number = min(int(rng.integers(1, 4)), count)
    angles = np.sort(rng.uniform(*RING_ANGLES, number))
    share = np.sin(np.radians(angles))
    ends = np.rint(np.cumsum(share) / share.sum() * count).astype(int)
    sizes = np.diff(ends, prepend=0)
    vectors = []
    for angle, size in zip(angles, sizes, strict=True):
        turn = rng.uniform(0.0, 2.0 * np.pi) + 2.0 * np.pi * np.arange(size) / max(size, 1)
        vectors.append(_from_angles(np.full(size, np.radians(angle)), turn))
    return np.concatenate(vectors)


def dome(count: int, rng: np.random.Generator) -> np.ndarray:  # (count, 3)
    """Draw a dome of bulbs evenly spread in solid angle, out to 60 to 85 degrees, turned at random, a little uneven."""
    edge = np.cos(np.radians(rng.uniform(*DOME_EDGE)))
    z = 1.0 - (1.0 - edge) * (np.arange(count) + 0.5) / count
    turn = rng.uniform(0.0, 2.0 * np.pi) + _GOLDEN * np.arange(count)
    spacing = np.sqrt(2.0 * np.pi * (1.0 - edge) / count)
    vectors = _from_angles(np.arccos(z), turn) + rng.normal(0.0, 0.05 * spacing, (count, 3))
    return _above(unit(vectors))


def hand_held(count: int, rng: np.random.Generator) -> np.ndarray:  # (count, 3)
    """Draw a smooth path of a lamp in a hand, seen at equal times, within 80 degrees of the viewing axis.

    The lamp circles the axis one to three times, one way or the other, while its distance to it and its speed waver: on
    each is a random series of three slow waves.
    """
    time = np.linspace(0.0, 1.0, count)
    waves = np.arange(1, 4)

    def waver() -> np.ndarray:  # (count,), about -1 to 1
        strength, phase = rng.normal(0.0, 1.0 / waves), rng.uniform(0.0, 2.0 * np.pi, 3)
        return np.sin(2.0 * np.pi * time[:, None] * waves + phase) @ strength / np.sqrt((1.0 / waves**2).sum() / 2) / 2

    circles = rng.uniform(1.0, 3.0) * rng.choice([-1.0, 1.0])
    turn = rng.uniform(0.0, 2.0 * np.pi) + 2.0 * np.pi * circles * time + 0.6 * waver()
    middle, reach = rng.uniform(35.0, 55.0), rng.uniform(10.0, 25.0)
    angle = np.clip(np.abs(middle + reach * waver()), 0.0, HAND_EDGE)
    return _from_angles(np.radians(angle), turn)


def stage(count: int, rng: np.random.Generator) -> np.ndarray:  # (count, 3)
    """Draw a light stage: evenly spread over the whole upper hemisphere, each light for 2 pi / count steradians.

    A spiral of equal steps in z and golden angles (Vogel 1979; Swinbank & Purser 2006), turned at random. Light mixed
    from it after rendering (`render.shared.imaging.mixing`) wants 128 to 512.
    """
    z = 1.0 - (np.arange(count) + 0.5) / count
    return _from_angles(np.arccos(z), rng.uniform(0.0, 2.0 * np.pi) + _GOLDEN * np.arange(count))


def _from_angles(angle: np.ndarray, turn: np.ndarray) -> np.ndarray:  # (N, 3)
    """Return vectors at an angle from the viewing axis and turned about it from +x to +y, radians."""
    return np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=1)


def _above(vectors: np.ndarray) -> np.ndarray:
    """Keep vectors a degree above the horizon."""
    vectors[:, 2] = np.maximum(vectors[:, 2], np.sin(np.radians(1.0)))
    return unit(vectors)
