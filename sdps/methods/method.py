"""A method as data: which networks or classical method give lights and normals, and what that is called."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sdps.classical import registry as classical
from sdps.core.lighting import ReadOut
from sdps.methods import pretrained
from sdps.models.registry import COMBINATIONS, TRUE_LIGHTS

NONE = ""
CONSTANT = "constant"
"""A predictor that sees nothing: what knowing nothing scores."""
CLASSICAL = (*classical.METHODS, CONSTANT)
REFINE, FUSE = "refine", "fuse"
"""Last part of an expression: refine what the parts before it find, or join that with what the network says then."""
AFTER = (REFINE, FUSE)
VIEWS = ("light_views", "normal_views")


@dataclass(frozen=True, kw_only=True)
class Method:
    """A way from images to lights or normals.

    Attributes:
        name: Label of its row.
        lighting: A lighting model (run or file), `true` for lights that are given, or empty for none.
        normals: A normal model, a classical method, or empty for lighting alone.
        intensities: `true` where only the intensities are given, else empty.
        read_out: How light classes become lights; None for the configuration's.
        light_views: Test-time augmentation of lights: turned views averaged over where the configuration does not say;
            None for one.
        normal_views: The same for normals.
        refined: Refine what it finds by inverse rendering (`sdps.refinement`).
        fused: Then ask its network again and join both answers (`sdps.methods.fusion`).
        paper: Row of the paper's table.
    """

    name: str
    lighting: str = NONE
    normals: str = NONE
    intensities: str = NONE
    read_out: ReadOut | None = None
    light_views: int | None = None
    normal_views: int | None = None
    refined: bool = False
    fused: bool = False
    paper: str = ""

    def models(self) -> set[str]:
        """Return the runs whose weights it needs."""
        return {self.lighting, self.normals} - {NONE, TRUE_LIGHTS, *CLASSICAL}


def label(lighting: str, normals: str, *, combination: str = NONE) -> str:
    """Name what parts make together, by the combination's name and its parts where it has one."""
    suffix = " (shipped)" if any(part.startswith(pretrained.SHIPPED) for part in (lighting, normals)) else ""
    lighting, normals = (part.removeprefix(pretrained.SHIPPED) for part in (lighting, normals))
    if lighting == TRUE_LIGHTS:
        text = f"{normals}, true lights"
    else:
        text = " + ".join(part for part in (lighting, normals) if part)
    return (f"{combination} ({text})" if combination else text) + suffix


def join(lighting: str, normals: str, *, paper: str = "", intensities: str = NONE, combination: str = NONE) -> Method:
    """Return the method of parts that go together, with its label; asked for as a combination, with its views."""
    pair = COMBINATIONS[combination] if combination else None
    views: dict[str, Any] = {field: getattr(pair, field, None) for field in VIEWS}
    named = combination if any(views.values()) else NONE  # others are their parts, and called so
    name = label(stem(lighting), stem(normals), combination=named)
    return Method(
        name=name + (", true intensities" if intensities else ""),
        lighting=lighting,
        normals=normals,
        intensities=intensities,
        paper=paper,
        **views,
    )


def stem(name: str) -> str:
    """Return what a run or weights file is called."""
    return Path(name).stem if name.endswith(".safetensors") else name
