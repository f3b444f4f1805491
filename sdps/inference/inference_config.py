"""How trained networks are used: one set of options with one set of defaults, for every command and Python call."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

from render.shared.errors import InputError
from sdps.core.lighting import ReadOut
from sdps.core.precision import Precision, check_precision
from sdps.models.lcnet import INPUT_SIZE

VIEWS = (1, 2, 4, 8)
"""Numbers of turned and mirrored views that are a group each (`sdps.core.symmetry`)."""

Margin = int | Literal["auto"] | None
_BOX_MARGIN = 15
"""Pixels kept around an object, as the published results on photographs do (SDPS-Net's preparation of DiLiGenT)."""


@dataclass(frozen=True, kw_only=True)
class InferenceConfig:
    """How networks are used.

    Attributes:
        read_out: How light classes become lights: `expectation` (soft-argmax), `centre` (argmax, the paper's) or `peak`
            (parabolic).
        precision: Arithmetic of the networks: `auto` (what is faster on this machine), `float32` or `bfloat16`.
        margin: Pixels kept around the mask's bounding box; null keeps the whole frame. `auto`: frames of 128x128, as
            training renders them, are kept whole, others cut with 15 pixels of margin. A box is brought to the lighting
            networks' 128x128, and the lights they find depend on its size.
        stray_light: Take off what the images show where the object is in shadow (`sdps.inference.stray_light`).
        rotations: Rotations about the view axis that pixel networks average over.
        light_views: Test-time augmentation: lights are the mean over so many turned and mirrored views of the object,
            1, 2, 4 or 8; null for what the method says, which is 1 but for `sdps-frames` and `sdps-plus`.
        normal_views: The same for normals; every view costs as much again, but for `frames`.

    Raises:
        InputError: an option out of range.
    """

    read_out: ReadOut = "expectation"
    precision: Precision = "auto"
    margin: Margin = "auto"
    stray_light: bool = True
    rotations: int = 10
    light_views: int | None = None
    normal_views: int | None = None

    def __post_init__(self) -> None:
        check_precision(self.precision)
        if not (self.margin in ("auto", None) or (isinstance(self.margin, int) and self.margin >= 0)):
            raise InputError(f"margin must be at least 0 pixels, auto, or null for the whole frame, got {self.margin}")
        if self.rotations < 1:
            raise InputError(f"rotations must be at least 1, got {self.rotations}")
        for name in ("light_views", "normal_views"):
            if getattr(self, name) not in (None, *VIEWS):
                raise InputError(f"{name} must be 1, 2, 4 or 8, got {getattr(self, name)}")

    def margin_of(self, shape: tuple[int, int]) -> int | None:
        """Return the margin of images of a size (H, W); None for the whole frame."""
        if self.margin == "auto":
            return None if shape == (INPUT_SIZE, INPUT_SIZE) else _BOX_MARGIN
        return self.margin

    def options(self) -> dict[str, Any]:
        """Return the options by name, those of this class alone."""
        return {field.name: getattr(self, field.name) for field in fields(InferenceConfig)}


def inference_config(settings: Any) -> InferenceConfig:
    """Return how networks are used, from what parsed flags or a preset's section say of it by the same names."""
    values = settings if isinstance(settings, Mapping) else vars(settings)
    names = {field.name for field in fields(InferenceConfig)}
    return InferenceConfig(**{name: value for name, value in values.items() if name in names})
