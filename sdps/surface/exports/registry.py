"""What a result can be exported as: one line each, and the function that writes it."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from render.shared.errors import InputError, unknown
from sdps.surface.exports.gloss_exports import write_gltf, write_materials, write_relightable
from sdps.surface.exports.height_maps import write_curvatures, write_gradients, write_heights
from sdps.surface.exports.light_exports import write_diligent, write_lp
from sdps.surface.exports.normal_maps import CONVENTIONS, write_normals
from sdps.surface.exports.reconstruction_folders import write_bini, write_rnb
from sdps.surface.exports.saved_result import SavedResult
from sdps.surface.exports.sfm_data import write_meshroom

Writer = Callable[[SavedResult, Path], list[Path]]
"""Writes files into a folder, which exists, and returns them. An `InputError` says what the result lacks for it."""


@dataclass(frozen=True)
class Export:
    """A form that some program wants.

    Attributes:
        about: Who wants it, and what is written, in one line.
        write: The function that writes it.
    """

    about: str
    write: Writer


EXPORTS: dict[str, Export] = {
    **{f"normals-{name}": Export(f"normals for {wanted.who}: PNG of 16 bits, EXR", partial(write_normals, name))
       for name, wanted in CONVENTIONS.items()},
    "height": Export("inspection, displacement: height as float and 16-bit TIFF, mm where known", write_heights),
    "gradients": Export("inspection: slopes dz/dx and dz/dy as TIFF", write_gradients),
    "curvature": Export("inspection: mean and Gaussian curvature as TIFF", write_curvatures),
    "materials": Export("Blender, universal PS: base colour, roughness, metallic (if refined)", write_materials),
    "gltf": Export("viewers, engines: mesh with these maps as .glb (if refined)", write_gltf),
    "ptm": Export("heritage viewers: relightable .ptm (LRGB)", partial(write_relightable, "ptm")),
    "rti": Export("heritage viewers: relightable .rti (HSH)", partial(write_relightable, "rti")),
    "lp": Export("RTIBuilder, RelightLab, Meshroom: light directions as .lp", write_lp),
    "diligent": Export("MATLAB scripts: lights as DiLiGenT's text files", write_diligent),
    "bini": Export("BiNI: normal_map.png, mask.png, K.txt", write_bini),
    "rnb": Export("RNb-NeuS, SuperNormal: one view with cameras.npz", write_rnb),
    "meshroom": Export("Meshroom: normalMaps.sfm with its maps, mask and lights", write_meshroom),
}  # fmt: skip
"""By name; each is written into a folder of that name."""


def split_names(text: str) -> tuple[str, ...]:
    """Return the exports of a flag, joined by commas, each one time.

    Raises:
        InputError: an unknown one, with the nearest, or none.
    """
    names = tuple(dict.fromkeys(name.strip().lower() for name in text.split(",") if name.strip()))
    if not names:
        raise InputError(f"name at least one export: {', '.join(EXPORTS)}")
    for name in names:
        if name not in EXPORTS:
            raise unknown("export", name, EXPORTS)
    return names


def write_exports(result: SavedResult, names: Iterable[str], out: Path) -> list[Path]:
    """Write exports, each into a folder of its name below `out`.

    Raises:
        InputError: an export needs what the result lacks, or a disk that refuses the files.
    """
    made: list[Path] = []
    for name in names:
        folder = out / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
            made += EXPORTS[name].write(result, folder)
        except OSError as error:
            raise InputError(
                f"{folder}: cannot be written ({error.strerror or error}); choose another --out"
            ) from error
    return made
