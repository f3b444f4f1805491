"""What a method returns, learned or classical, and what it is worth."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class Estimate:
    """Normals and lights of one set of images, from a network or a classical method alike.

    Attributes:
        normals: (H, W, 3) float32, unit in the camera frame, zero outside the mask; (0, 0, 3) of methods that give
            lights alone.
        light_directions: (L, 3) float32, unit, from the surface to the light; (0, 3) where none were given or found.
        intensities: (L,) float32, relative: known up to one common scale; (0,) where there are none.
        diagnostics: What else the method can say (maps, class probabilities, seconds), by name.
    """

    normals: np.ndarray
    light_directions: np.ndarray
    intensities: np.ndarray
    diagnostics: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Score:
    """A number with its definition.

    Attributes:
        name: Short name, e.g. `normal_mae`.
        value: The number.
        unit: `deg`, or empty for a ratio.
        definition: One sentence that says exactly what was averaged over what.
    """

    name: str
    value: float
    unit: str
    definition: str
