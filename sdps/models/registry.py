"""Networks by name. Adding one is a file here and a line in `MODELS`."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import nn

from render.errors import InputError, unknown
from sdps.models.lcnet import LCNet
from sdps.models.nenet import NENet


@dataclass(frozen=True)
class ModelEntry:
    """A network's constructor, what it is in one line, and its parameter count with default options."""

    build: Callable[..., nn.Module]
    summary: str
    parameters: int


MODELS = {
    "lcnet": ModelEntry(LCNet, "Lighting Calibration Network: classes of light direction and intensity", 4_409_692),
    "nenet": ModelEntry(NENet, "Normal Estimation Network: normals from images and their lights", 2_210_048),
}


def create(name: str, **options: Any) -> nn.Module:
    """Build the network `name` with freshly drawn weights (from torch's global generator).

    Raises:
        InputError: unknown name or option, with the nearest known one.
    """
    if name not in MODELS:
        raise unknown("model", name, MODELS)
    known = inspect.signature(MODELS[name].build).parameters
    for option in options:
        if option not in known:
            raise unknown(f"option of model {name!r}:", option, known)
    try:
        return MODELS[name].build(**options)
    except (TypeError, RuntimeError) as error:
        raise InputError(f"model {name!r}: options {options} do not build it ({error})") from error
