"""Every learned model by name. Adding one is a network, its class in `NETWORKS`, and an entry in assets/models.yaml.

A model is a network with fixed options and a way to train it. Several models share one network: NENet, PS-FCN and NENet
on the lights of LCNet_reg differ in their training only. The recipes are the paper's; presets override them.
"""

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from typing import Any, Literal

from torch import nn

from render.shared.config import read_yaml
from render.shared.errors import InputError, unknown
from sdps.models.cnnps import CNNPS
from sdps.models.frames import FrameNet
from sdps.models.lcnet import LCNet
from sdps.models.lighting_variants import LCNetReg, LCNetSoft
from sdps.models.lightset import LightSetNet
from sdps.models.nenet import NENet
from sdps.models.upsfcn import UPSFCN, UPSFCNLight

Role = Literal["lighting", "normals", "pixels"]
TRUE_LIGHTS = "true"


@dataclass(frozen=True, kw_only=True)
class ModelEntry:
    """A model.

    Attributes:
        role: `lighting` finds lights from images; `normals` gives normal maps; `pixels` gives normals pixel by pixel.
        build: The network's class.
        options: Options of the network that make this model.
        parameters: Trainable scalars with default classes.
        summary: One line.
        paper: Row of the paper's tables, if any.
        lights: Lighting model whose lights it is trained on, `true`, or empty for models that see none.
        any_light: Trained on any light that differs between the images; lights are where it comes from on average.
        recipe: Training settings where they differ from the role's, as published.
        reconstruction: What the paper leaves open and is decided here.
    """

    role: Role
    build: type[nn.Module]
    parameters: int
    summary: str
    options: Mapping[str, Any] = field(default_factory=dict)
    paper: str = ""
    lights: str = ""
    any_light: bool = False
    recipe: Mapping[str, Any] = field(default_factory=dict)
    reconstruction: str = ""


@dataclass(frozen=True)
class Combination:
    """Models that work together.

    Attributes:
        lighting: Lighting model.
        normals: Normal model.
        summary: One line.
        paper: Row of the paper's table, if any.
        light_views: Test-time augmentation of lights: turned views averaged over; None for what the caller wants.
        normal_views: The same for normals.
    """

    lighting: str
    normals: str
    summary: str = ""
    paper: str = ""
    light_views: int | None = None
    normal_views: int | None = None

    def members(self) -> tuple[str, ...]:
        """Return the names of the models."""
        return self.lighting, self.normals

    def parameters(self) -> int:
        """Return the trainable scalars of all of them."""
        return sum(MODELS[name].parameters for name in self.members())


def _entries() -> tuple[dict[str, ModelEntry], dict[str, Combination]]:
    """Return what assets/models.yaml lists."""
    listed = read_yaml(str(resources.files("assets") / "models.yaml"))
    models = {
        name: ModelEntry(build=NETWORKS[values.pop("network")], **values) for name, values in listed["models"].items()
    }
    return models, {name: Combination(**values) for name, values in listed["combinations"].items()}


NETWORKS: dict[str, type[nn.Module]] = {
    kind.__name__: kind
    for kind in (LCNet, LCNetReg, LCNetSoft, LightSetNet, NENet, FrameNet, UPSFCN, UPSFCNLight, CNNPS)
}
MODELS, COMBINATIONS = _entries()


def entry(name: str) -> ModelEntry:
    """Return a model's entry.

    Raises:
        InputError: unknown name, with the nearest known one.
    """
    if name not in MODELS:
        raise unknown("model", name, MODELS)
    return MODELS[name]


def create(name: str, **options: Any) -> nn.Module:
    """Build the network of model `name` with freshly drawn weights (from torch's global generator).

    Raises:
        InputError: unknown name or option, with the nearest known one.
    """
    model = entry(name)
    known = network_options(name)
    for option in options:
        if option not in known:
            raise unknown(f"option of model {name!r}:", option, known)
    try:
        return model.build(**{**model.options, **options})
    except (TypeError, RuntimeError) as error:
        raise InputError(f"model {name!r}: options {options} do not build it ({error})") from error


def network_options(name: str) -> set[str]:
    """Return the names of the options the network of a model takes."""
    return set(inspect.signature(entry(name).build).parameters)
