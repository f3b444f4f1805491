"""The plain factorisation: what the methods that resolve the bas-relief ambiguity are measured against."""

import numpy as np
from scipy import optimize

from sdps.classical.common.factorisation import Factors
from sdps.classical.common.front_end import Front, conclude, prepare
from sdps.classical.common.gbr import Gbr
from sdps.core.estimate import Estimate


def factorisation(images: np.ndarray, mask: np.ndarray, *, front: Front = "low-rank") -> Estimate:
    """Stop at integrability and take the bas-relief transformation of equal light intensities.

    The plain rival of the methods that resolve the ambiguity: of all members of the group, the one under which the
    intensities of the lights vary least (Hayakawa 1994, sec. 4, restricted to the group). That is right where lights
    are equally strong.

    Args:
        images, mask, front: As for `prepare`.

    Raises:
        InputError: degenerate input; see `prepare`.
    """
    prepared = prepare(images, mask, front=front)
    return conclude(prepared, equal_intensity(prepared.factors))


def equal_intensity(factors: Factors) -> Gbr:
    """Return the transformation under which all lights are as equally strong as can be.

    The spread of log |G^-1 s| is minimised from several depth scales; lambda stays within [1/8, 8].
    """

    def measure_spread(parameters: np.ndarray) -> np.ndarray:  # (L,)
        gbr = Gbr(parameters[0], parameters[1], float(np.exp(parameters[2])))
        strength = np.log(np.maximum(np.linalg.norm(gbr.lights(factors.lights), axis=0), 1e-12))
        return strength - strength.mean()

    limit = np.array([8.0, 8.0, np.log(8.0)])
    starts = [np.array([0.0, 0.0, start]) for start in (-0.7, 0.0, 0.7)]
    found = [optimize.least_squares(measure_spread, start, bounds=(-limit, limit)) for start in starts]
    mu, nu, depth = min(found, key=lambda item: item.cost).x
    return Gbr(float(mu), float(nu), float(np.exp(depth)))
