"""Pictures of an evaluated object: its input, its true normals, and what methods estimated."""

from collections.abc import Sequence

import numpy as np

from pipelines.evaluate.evaluation import Found, TestObject
from pipelines.evaluate.report.sections import Tile
from pipelines.shared import pictures
from render.shared.seeds import spread_evenly
from sdps.core.metrics import normal_error_map

ERROR_LIMIT = 45.0
_SHOWN_HEIGHT = 240
_LIT_CANDIDATES = 12


def tiles(item: TestObject, found: Found, shown: Sequence[str], truth: str = "true normals") -> list[Tile]:
    """Return pictures of an object: input, true normals, each method's normals, errors and lights.

    Args:
        item: The object.
        found: Results, with the normal maps of the methods shown.
        shown: Methods.
        truth: What the object's normals are called.
    """
    mask = item.mask
    brightest = _brightest(item)
    exposure = pictures.auto_exposure(brightest[None], mask)
    result = [Tile("input", _fit(pictures.tone_map(brightest, exposure)), "beside")]
    if item.normals is not None:
        result.append(Tile(truth, _fit(pictures.normal_map(item.normals, mask)), "truth"))
    for name in shown:
        if item.name not in found.get(name, {}):
            continue
        one = found[name][item.name]
        normals = one.normals()
        if normals is not None:
            result.append(Tile(f"normals, {name}", _fit(pictures.normal_map(normals, mask)), "normals"))
            if item.normals is not None:
                errors = normal_error_map(normals, item.normals, mask)
                text = f"{name}: error {np.nanmean(errors):.1f}°"
                result.append(Tile(text, _fit(pictures.error_map(errors, ERROR_LIMIT)), "beside"))
        if "direction_mae" in one.scores:
            gains = one.intensities if len(one.intensities) else np.ones(len(one.light_directions))
            text = f"{name}: lights, {one.scores['direction_mae']:.1f}° (lines: to the true ones)"
            result.append(Tile(text, pictures.light_plot(one.light_directions, gains, item.light_directions)))
    return result


def _brightest(item: TestObject) -> np.ndarray:  # (H, W, 3)
    """Return the brightest of some images spread over all."""
    images = item.load()
    candidates = [images[k : k + 1][0] for k in spread_evenly(range(len(images)), _LIT_CANDIDATES)]
    return max(candidates, key=lambda image: float(image[item.mask].mean()))


def _fit(picture: np.ndarray) -> np.ndarray:
    return pictures.scale_to_height(picture, _SHOWN_HEIGHT) if picture.shape[0] > _SHOWN_HEIGHT else picture
