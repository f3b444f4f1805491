"""Search of the three numbers of a bas-relief transformation for the minimum of an energy of any shape."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy import optimize

from render.shared.progress import progress_bar
from sdps.classical.common.gbr import Gbr

_SPAN = np.array([4.0, 4.0, np.log(4.0)])
"""Half the box of mu, nu and log lambda, that of Alldrin, Mallick & Kriegman (CVPR 2007)."""


_NODES = (7, 7, 5)
"""Grid size along mu, nu and log lambda."""

_REFINED = 5
"""How many of the best nodes are refined."""


def minimise_over_bas_reliefs(energy: Callable[[Gbr], float], starts: Sequence[Gbr]) -> tuple[Gbr, float]:
    """Search boxes of depth scales of one sign from coarse to fine, then polish by Nelder-Mead.

    A box spans four times its start's depth scale in mu and nu, and from a quarter to four times it in lambda; a second
    grid covers the quarter of it around the start more finely. The best nodes of all are refined apart from each other,
    since the energies here have more than one valley.

    Args:
        energy: To minimise; anything not finite counts as infinite.
        starts: Centres of boxes, also candidates themselves.

    Returns:
        The best transformation and its energy.
    """

    def value(gbr: Gbr) -> float:
        result = energy(gbr)
        return result if np.isfinite(result) else np.inf

    axes = [np.linspace(-span, span, count) for span, count in zip(_SPAN, _NODES, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    offsets = np.concatenate([np.zeros((1, 3)), 0.25 * grid, grid])
    candidates = [_offset_start(start, offset) for start in starts for offset in offsets]
    coarse = [value(gbr) for gbr in progress_bar(candidates, desc="bas-relief grid", unit="candidate")]
    first = np.argsort(coarse, kind="stable")[:_REFINED]
    best, lowest = candidates[first[0]], coarse[first[0]]
    simplex = np.vstack([np.zeros(3), np.diag(_SPAN / 8.0)])
    options: Any = {"initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-7, "maxfev": 250}
    for index in progress_bar(first, desc="bas-relief polish", unit="start"):
        centre = candidates[index]

        def near(offset: np.ndarray, at: Gbr = centre) -> float:
            return value(_offset_start(at, offset))

        found = optimize.minimize(near, np.zeros(3), method="Nelder-Mead", options=options)
        if found.fun < lowest:
            best, lowest = _offset_start(centre, found.x), float(found.fun)
    return best, lowest


def _offset_start(start: Gbr, offset: np.ndarray) -> Gbr:
    """Return the start followed by an offset (mu, nu, log lambda); its slants are in units of the depth scale."""
    return start.then(Gbr(float(offset[0]), float(offset[1]), float(np.exp(np.clip(offset[2], -4.0, 4.0)))))
