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
        about: Who wants it, and what is written: two parts of one line, with a colon between them.
        write: The function that writes it.
        from_pictures: It is made of the photographs, where these are at hand.
    """

    about: str
    write: Writer
    from_pictures: bool = False


EXPORTS: dict[str, Export] = {
    **{f"normals-{name}": Export(f"{wanted.who}: normals as 16-bit PNG and EXR", partial(write_normals, name))
       for name, wanted in CONVENTIONS.items()},
    "height": Export("inspection, displacement: height as 32- and 16-bit TIFF, in mm where known", write_heights),
    "gradients": Export("inspection: slopes dz/dx and dz/dy as TIFF", write_gradients),
    "curvature": Export("inspection: mean and Gaussian curvature as TIFF", write_curvatures),
    "materials": Export("Blender: base colour, roughness and metallic as PNG (if refined)", write_materials),
    "gltf": Export("viewers, game engines: mesh with its materials as .glb (if refined)", write_gltf),
    "ptm": Export("RTIViewer: relightable .ptm (LRGB)", partial(write_relightable, "ptm"), from_pictures=True),
    "rti": Export("RTIViewer: relightable .rti (HSH)", partial(write_relightable, "rti"), from_pictures=True),
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
