"""Pictures of an evaluated object: its input, its true normals, and what methods made of them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipelines.evaluate.evaluation import Result, TestObject
from pipelines.shared import pictures
from sdps.core.metrics import normal_error_map

ERROR_LIMIT = 45.0
_SHOWN_HEIGHT = 240
_LIT_CANDIDATES = 12

Found = dict[str, dict[str, Result]]
"""Results by method, then object."""


def tiles(item: TestObject, found: Found, shown: Sequence[str]) -> list[tuple[str, Any]]:
    """Return (caption, picture) of an object: input, true normals, each method's normals, errors and lights."""
    mask = item.mask
    brightest = _brightest(item)
    exposure = pictures.auto_exposure(brightest[None], mask)
    result: list[tuple[str, Any]] = [("input", _fit(pictures.tone_map(brightest, exposure)))]
    if item.normals is not None:
        result.append(("true normals", _fit(pictures.normal_map(item.normals, mask))))
    for name in shown:
        if item.name not in found.get(name, {}):
            continue
        one = found[name][item.name]
        normals = one.normals()
        if normals is not None:
            result.append((f"normals, {name}", _fit(pictures.normal_map(normals, mask))))
            if item.normals is not None:
                errors = normal_error_map(normals, item.normals, mask)
                text = f"{name}: error {np.nanmean(errors):.1f}°"
                result.append((text, _fit(pictures.error_map(errors, ERROR_LIMIT))))
        if "direction_mae" in one.scores:
            text = f"{name}: lights, {one.scores['direction_mae']:.1f}° (circles: true)"
            result.append((text, pictures.light_plot(item.true_directions, one.light_directions)))
    return result


def _brightest(item: TestObject) -> np.ndarray:  # (H, W, 3)
    """Return the brightest of some images spread over all."""
    images = item.load()
    places = np.unique(np.linspace(0, len(images) - 1, _LIT_CANDIDATES).round().astype(int))
    candidates = [images[place : place + 1][0] for place in places]
    return max(candidates, key=lambda image: float(image[item.mask].mean()))


def _fit(picture: np.ndarray) -> np.ndarray:
    return pictures.fitted(picture, _SHOWN_HEIGHT) if picture.shape[0] > _SHOWN_HEIGHT else picture
