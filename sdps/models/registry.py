"""Every learned model by name. Adding one is a network and a line in `MODELS`.

A model is a network with fixed options and a way to train it. Several models share one network: NENet, PS-FCN and NENet
on the lights of LCNet_reg differ in their training only. The recipes are the paper's; presets override them.
"""

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from torch import nn

from render.shared.errors import InputError, unknown
from sdps.models.cnnps import CNNPS
from sdps.models.lcnet import LCNet
from sdps.models.lighting_variants import LCNetReg, LCNetSecond, LCNetSoft
from sdps.models.nenet import NENet
from sdps.models.upsfcn import UPSFCN, UPSFCNLight

Role = Literal["lighting", "second", "normals", "pixels"]
TRUE_LIGHTS = "true"


@dataclass(frozen=True, kw_only=True)
class ModelEntry:
    """A model.

    Attributes:
        role: `lighting` tells lights from images; `second` does so from images and a first estimate; `normals` gives
            normal maps; `pixels` gives normals pixel by pixel.
        build: The network's class.
        options: Options of the network that make this model.
        parameters: Trainable scalars with default classes.
        summary: One line.
        paper: Row of the paper's tables, if any.
        lights: Lighting model whose lights it is trained on, `true`, or empty for models that see none.
        normals: Normal model whose normals it is trained on (`second` only).
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
    normals: str = ""
    recipe: Mapping[str, Any] = field(default_factory=dict)
    reconstruction: str = ""


# Chen et al., ECCV 2018, and its code (spec of the schedules: A.8): 32 x 32 crops, learning rate 1e-3.
_PSFCN = {
    "epochs": 30.0, "batch_scenes": 32, "learning_rate": 1e-3, "halve_after": (5.0, 10.0, 15.0, 20.0, 25.0), "crop": 32,
}  # fmt: skip
_UPSFCN = {**_PSFCN}

MODELS: dict[str, ModelEntry] = {
    "lcnet": ModelEntry(
        role="lighting", build=LCNet, parameters=4_409_692, paper="A0",
        summary="LCNet, Lighting Calibration Network: classes of light direction and intensity",
    ),
    "lcnet-reg": ModelEntry(
        role="lighting", build=LCNetReg, parameters=4_387_524, paper="A1",
        summary="LCNet_reg: regresses directions and intensities", reconstruction="heads and loss",
    ),
    "lcnet-nomask": ModelEntry(
        role="lighting", build=LCNet, options={"use_mask": False}, parameters=4_409_116, paper="A2",
        summary="LCNet without the object mask",
    ),
    "lcnet-local": ModelEntry(
        role="lighting", build=LCNet, options={"use_global": False}, parameters=3_819_868, paper="A3",
        summary="LCNet_local: every image on its own",
    ),
    "lcnet-soft": ModelEntry(
        role="lighting", build=LCNetSoft, parameters=4_409_692,
        summary="LCNet trained for the expectation over its classes (soft-argmax)", reconstruction="loss",
    ),
    "lcnet-second": ModelEntry(
        role="second", build=LCNetSecond, parameters=1_584_988, lights="lcnet-soft", normals="nenet-plus",
        summary="second lighting pass that sees estimated normals and shading (GCNet's idea)",
        reconstruction="layers and loss",
    ),
    "nenet": ModelEntry(
        role="normals", build=NENet, parameters=2_210_048, paper="B1", lights="lcnet",
        summary="NENet, Normal Estimation Network, trained on LCNet's lights",
    ),
    "nenet-reg": ModelEntry(
        role="normals", build=NENet, parameters=2_210_048, paper="B3", lights="lcnet-reg",
        summary="NENet trained on LCNet_reg's lights",
    ),
    "nenet-norm": ModelEntry(
        role="normals", build=NENet, options={"per_pixel": True}, parameters=2_210_048, lights="lcnet",
        summary="NENet on images divided by each pixel's norm over the lights",
    ),
    "nenet-plus": ModelEntry(
        role="normals", build=NENet, parameters=2_210_048, lights="lcnet-soft",
        summary="NENet trained on lcnet-soft's lights",
    ),
    "psfcn": ModelEntry(
        role="normals", build=NENet, parameters=2_210_048, paper="B0", lights=TRUE_LIGHTS, recipe=_PSFCN,
        summary="PS-FCN, trained on true lights",
    ),
    "psfcn-norm": ModelEntry(
        role="normals", build=NENet, options={"per_pixel": True}, parameters=2_210_048, lights=TRUE_LIGHTS,
        recipe=_PSFCN, summary="PS-FCN (Norm.), Chen et al., TPAMI 2020",
    ),
    "upsfcn": ModelEntry(
        role="normals", build=UPSFCN, parameters=2_208_320, paper="B9", recipe=_UPSFCN,
        summary="UPS-FCN retrained with random intensities: no lights at all",
    ),
    "upsfcn-light": ModelEntry(
        role="normals", build=UPSFCNLight, parameters=5_804_124, paper="B8", recipe={**_UPSFCN, "crop": 0},
        summary="UPS-FCN with lighting as an additional task", reconstruction="layers and the tasks' weights",
    ),
    "upsfcn-wide": ModelEntry(
        role="normals", build=UPSFCN, options={"width": 1.7}, parameters=6_386_644, paper="B7", recipe=_UPSFCN,
        summary="UPS-FCN, wider", reconstruction="widths",
    ),
    "upsfcn-deep": ModelEntry(
        role="normals", build=UPSFCN, options={"deep": True}, parameters=6_043_968, paper="B6", recipe=_UPSFCN,
        summary="UPS-FCN, deeper", reconstruction="where the layers are added",
    ),
    "upsfcn-deep-mask": ModelEntry(
        role="normals", build=UPSFCN, options={"deep": True, "use_mask": True}, parameters=6_044_544, paper="B5",
        recipe=_UPSFCN, summary="UPS-FCN, deeper, sees the mask", reconstruction="where the layers are added",
    ),
    "cnnps": ModelEntry(
        role="pixels", build=CNNPS, parameters=2_654_051, paper="IS18", lights=TRUE_LIGHTS,
        summary="CNN-PS (Ikehata, ECCV 2018): observation maps, pixel by pixel",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Combination:
    """Models that work together.

    Attributes:
        lighting: Lighting model.
        normals: Normal model.
        second: Second lighting pass, or empty.
        summary: One line.
        paper: Row of the paper's table, if any.
        light_views: Test-time augmentation of lights: turned views averaged over; None for what the caller wants.
        normal_views: The same for normals.
    """

    lighting: str
    normals: str
    second: str = ""
    summary: str = ""
    paper: str = ""
    light_views: int | None = None
    normal_views: int | None = None

    def members(self) -> tuple[str, ...]:
        """Return the names of the models."""
        return tuple(name for name in (self.lighting, self.normals, self.second) if name)

    def parameters(self) -> int:
        """Return the trainable scalars of all of them."""
        return sum(MODELS[name].parameters for name in self.members())


COMBINATIONS = {
    "sdps": Combination("lcnet", "nenet", summary="SDPS-Net", paper="B1"),
    "sdps-reg": Combination("lcnet-reg", "nenet-reg", summary="SDPS-Net with regressed lights", paper="B3"),
    "sdps-plus": Combination(
        "lcnet-soft", "nenet-plus", summary="soft-argmax lights; lights averaged over eight views, normals over four",
        light_views=8, normal_views=4,
    ),
    "sdps-second": Combination(
        "lcnet-soft", "nenet-plus", "lcnet-second", "soft-argmax lights and a second lighting pass"
    ),
}  # fmt: skip


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
    """Return the names of the options the network of a model takes, those of its base classes included."""
    names: set[str] = set()
    for kind in entry(name).build.__mro__:
        if "__init__" in vars(kind):
            parameters = inspect.signature(vars(kind)["__init__"]).parameters.values()
            names |= {parameter.name for parameter in parameters if parameter.kind is parameter.KEYWORD_ONLY}
            if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
                break
    return names
