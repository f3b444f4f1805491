"""One random generator per (root seed, scene, stage), so that adding a stage never shifts another; and what is chosen
without chance.
"""

import hashlib
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

T = TypeVar("T")


def _word(key: int | str) -> int:
    if isinstance(key, int):
        return key
    return int.from_bytes(hashlib.sha256(key.encode()).digest()[:8], "little")


def generator(root: int, *keys: int | str) -> np.random.Generator:
    """Return the generator of the stage named by `keys` under the root seed `root` (0 is a seed like any other).

    Args:
        root: Non-negative root seed.
        keys: What the stream is for, e.g. `("blobby", 17, "lights")`; strings are hashed with SHA-256,
            so the stream is the same on every machine and in every process. Their number counts too, since
            `SeedSequence` takes missing words for zeros.
    """
    return np.random.default_rng(np.random.SeedSequence([root, len(keys), *(_word(key) for key in keys)]))


def derive_seed(root: int, *keys: int | str) -> int:
    """Return a 31-bit seed of its own for the stage named by `keys`."""
    return int(generator(root, *keys).integers(2**31))


def spread_evenly(items: Sequence[T], count: int) -> list[T]:
    """Return up to `count` items, spread evenly over a sequence from its first to its last."""
    places = np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)
    return [items[place] for place in places]
