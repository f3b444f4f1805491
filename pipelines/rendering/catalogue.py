"""`sdps list`: materials and shapes, also as a contact sheet, models, light sets and presets."""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pipelines.shared import pictures, presets
from pipelines.shared.flags import split_list
from pipelines.shared.text_tables import render_text
from render.materials import library, surfaces
from render.materials.model import Material
from render.materials.textures import textured
from render.materials.textures.textured import Textured
from render.planning import light_sets
from render.planning.plan import material_pool
from render.records.manifest import View
from render.shared.errors import InputError, unknown
from render.shared.files import atomic_path

_LIGHTS = np.array([[-0.45, 0.55, 0.70]])
_ROW = 8  # textured materials in a row of the sheet
_SHOWN = 2  # seed of the procedural materials on the sheet
_SHAPES = ("sphere", "bunny", *(f"{family}:{seed}" for family in ("blobby", "sculpture") for seed in range(15)))
_BLOB, _BLOB_VIEW = "blobby:4", View(scale=1.15)
_TURNED = View(rotation=(0.9063, 0.0, 0.4226, 0.0746, 0.9843, -0.1600, -0.4160, 0.1765, 0.8921), scale=0.98)


def add_material_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps list materials`."""
    parser.add_argument("--category", default=None, help="only this category; procedural: one of each kind")
    parser.add_argument("--materials", action="append", help="only these names and files; commas or repeat")
    parser.add_argument("--out", default=None, help="also render a contact sheet of spheres, <out>/materials.png")


def add_shape_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps list shapes`."""
    parser.add_argument("--out", default=None, help="also render a contact sheet, <out>/shapes.png")


def add_model_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps list models`."""
    parser.add_argument("--role", choices=("lighting", "normals", "pixels"), default=None,
                        help="only the models of this role")  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print JSON")


def add_no_arguments(_: argparse.ArgumentParser) -> None:
    """Declare nothing: the list has no flags."""


def light_sets_main(_: argparse.Namespace) -> int:
    """List the fixed light sets, and the distributions that a number of lights is drawn from."""
    for name in light_sets.names():
        sys.stdout.write(f"{name:<22} fixed, {len(light_sets.load(name))} lights\n")
    for name, draw in light_sets.DISTRIBUTIONS.items():
        sys.stdout.write(f"{name + ':<count>':<22} {(draw.__doc__ or '').splitlines()[0]}\n")
    sys.stdout.write(f"{'<file>':<22} a YAML file with `directions`, or three numbers a line\n")
    return 0


def presets_main(_: argparse.Namespace) -> int:
    """List the presets."""
    for name in presets.names():
        sys.stdout.write(f"{name:<12} {presets.load(name).description}\n")
    return 0


def models_main(args: argparse.Namespace) -> int:
    """List the learned models, with parameter counts, roles and what they are trained on."""
    from sdps.methods.pretrained import count_shipped
    from sdps.models.registry import COMBINATIONS, MODELS

    models = {name: item for name, item in MODELS.items() if args.role in (None, item.role)}
    if args.json:
        listed = [
            {"name": name, "role": item.role, "parameters": item.parameters, "shipped_parameters": count_shipped(name),
             "paper": item.paper, "lights": item.lights, "summary": item.summary,
             "reconstruction": item.reconstruction, "recipe": dict(item.recipe)}
            for name, item in models.items()
        ]  # fmt: skip
        sys.stdout.write(json.dumps(listed, indent=2) + "\n")
        return 0
    rows = [
        [name, f"{item.parameters:,}", _count_shipped(name), item.role, item.paper or "-", item.lights or "-",
         item.summary]
        for name, item in models.items()
    ]  # fmt: skip
    header = ["model", "parameters", "as shipped", "role", "paper", "trained on lights of", "what it is"]
    sys.stdout.write(render_text("Models", header, rows, left={0, 3, 4, 5, 6}))
    if args.role is None:
        rows = [
            [name, f"{pair.parameters():,}", _count_shipped(*pair.members()), " + ".join(pair.members()),
             pair.paper or "-", pair.summary]
            for name, pair in COMBINATIONS.items()
        ]  # fmt: skip
        header = ["combination", "parameters", "as shipped", "models", "paper", "what it is"]
        sys.stdout.write("\n" + render_text("Combinations", header, rows, left={0, 3, 4, 5}))
        sys.stdout.write("\nAny lighting model works with any normal model: --lighting NAME --normals NAME.\n")
    return 0


def _count_shipped(*names: str) -> str:
    """Return how many parameters the shipped weights of models have together, or a dash."""
    from sdps.methods.pretrained import count_shipped

    counts = [count_shipped(name) for name in names]
    return "-" if None in counts else f"{sum(filter(None, counts)):,}"


def materials_main(args: argparse.Namespace) -> int:
    """List the chosen materials: category and error of the fit, or that they are measured or vary."""
    chosen = _choose_materials(args.category, args.materials)
    for name in chosen:
        sys.stdout.write(f"{name:<28} {_about(surfaces.load(name))}\n")
    sys.stdout.write(
        f"{len(chosen)} materials; also lambertian:<albedo>, lambertian:<r>/<g>/<b>, procedural:<kind>:<seed>, "
        f"folders of maps, and files: {library.FILES}\n"
    )
    if args.out:
        _save(_material_sheet(chosen), Path(args.out) / "materials.png")
    return 0


def _about(surface: surfaces.Surface) -> str:
    """Describe a material by its category and what it is, or a spatially varying surface by its pattern."""
    if surface.pattern:
        return f"{surface.pattern.kind:<16} {surface.pattern.count} materials"
    (material,) = surface.components
    if isinstance(material, Textured):
        return f"{material.category:<16} {textured.KINDS.get(material.kind, 'maps')}"
    error = f"fit error {100 * material.fit_error:5.1f} %" if isinstance(material, Material) else "table"
    return f"{material.category:<16} {error}"


def _choose_materials(category: str | None, wanted: list[str] | None) -> list[str]:
    """Return the built-in materials, of one category if given, or the `wanted` names, categories and files."""
    if wanted:
        if category is not None:
            raise InputError("--category and --materials: give one of them; --materials takes categories too")
        return _one_of_each(split_list(wanted))
    if category is None:
        return library.names()
    if category == textured.PROCEDURAL:
        return _one_of_each([textured.PROCEDURAL])
    if category not in library.categories():
        raise unknown("category", category, [*library.categories(), textured.PROCEDURAL])
    return list(library.categories()[category])


def _one_of_each(wanted: list[str]) -> list[str]:
    """Expand categories; of a kind of procedural material one is shown."""
    return [f"{name}:{_SHOWN}" if textured.is_open(name) else name for name in material_pool(tuple(wanted))]


def shapes_main(args: argparse.Namespace) -> int:
    """List the shape families."""
    from render.shapes import families

    for name, about in families().items():
        sys.stdout.write(f"{name:<18} {about}\n")
    sys.stdout.write(f"{'<file>':<18} any mesh trimesh reads: .obj .ply .stl .glb .off ...\n")
    if args.out:
        _save(_shape_sheet(), Path(args.out) / "shapes.png")
    return 0


def _material_sheet(names: list[str]) -> pictures.Image.Image:
    """Render a sphere of each material, and a blob of each textured one, exposed alike but for the nearly black."""
    rough = [name for name in names if surfaces.load(name).textured]
    plain = [name for name in names if name not in rough]
    tiles = []
    for first in range(0, len(rough), _ROW):
        part = rough[first : first + _ROW]
        for shape, view in (("sphere", View(scale=0.95)), (_BLOB, _BLOB_VIEW)):
            for name in part:
                (image,) = _render_materials(shape, [name], view, size=160, spp=128, bounces=2)
                tiles.append((_label(name), pictures.tone_map(image, 1.2)))
    for first in range(0, len(plain), 16):
        part = plain[first : first + 16]
        shown = _render_materials("sphere", part, View(scale=0.95), size=120, spp=64, bounces=0)
        tiles += [(_label(name), pictures.tone_map(image, 1.2)) for name, image in zip(part, shown, strict=True)]
    return pictures.contact_sheet(tiles, columns=min(_ROW, len(rough)) if rough else min(10, len(tiles)))


def _label(name: str) -> str:
    """Name a material in at most 21 letters, a file without its folders."""
    short = name.removeprefix(f"{textured.PROCEDURAL}:")
    return "+".join(part.rsplit("/", 1)[-1] for part in short.split("+"))[:21]


def _shape_sheet() -> pictures.Image.Image:
    """Render one view of each shape in white under one light."""
    tiles = []
    for name in _SHAPES:
        view = View(scale=0.98) if name == "bunny" else _TURNED
        (image,) = _render_materials(name, ["lambertian:0.8"], view, size=160, spp=256, bounces=2)
        tiles.append((name, pictures.tone_map(image)))
    return pictures.contact_sheet(tiles, columns=8)


def _render_materials(
    shape: str, materials: list[str], view: View, *, size: int, spp: int, bounces: int
) -> Iterator[np.ndarray]:
    """Yield an image (H, W, 3) of a shape in each material under one light."""
    from render.kernel import many_lights, scene
    from render.materials.kernels.packed import pack
    from render.shapes import load

    built = scene.build(load(shape))
    surfaces = pack(materials, built.mesh)
    _, images = many_lights.render(built, view, surfaces, _LIGHTS, size=size, spp=spp, bounces=bounces, seed=0)
    return (stack[0] for _, stack in images)


def _save(sheet: pictures.Image.Image, path: Path) -> None:
    with atomic_path(path) as temporary:
        sheet.save(temporary)
    sys.stdout.write(f"wrote {path}\n")
