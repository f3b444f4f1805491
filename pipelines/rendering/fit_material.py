"""`sdps fit-material`: from a measured table to a material file of the built-in model."""

import argparse
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipelines.shared import pictures
from pipelines.shared.charts import new_figure
from render.materials import merl, model
from render.materials.fit import fitting, spheres
from render.materials.merl import MerlTable
from render.materials.model import Material
from render.records.shards import file_hash
from render.shared.errors import InputError
from render.shared.files import atomic_path, write_text

TERMS = (
    "those of the data it was fitted to; tables of the MERL BRDF database: research use, "
    "cite Matusik et al., A Data-Driven Reflectance Model, SIGGRAPH 2003"
)
_LIGHTS = ((0, 0), (30, 135), (50, 30), (70, 160), (85, 60))  # degrees: from the viewing axis, about it
_SLICES = (2, 30, 60)  # degrees of theta_d
_TILE, _GAIN = 160, 5
_COLOURS = ("tab:red", "tab:green", "tab:blue")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps fit-material`."""
    parser.add_argument("file", metavar="FILE.binary", help="table of the MERL BRDF database, or of its format")
    parser.add_argument("--out", default=".", help="folder for <name>.yaml and <name>.png (default: this one)")
    parser.add_argument("--name", help="name of the material (default: that of the file)")


def main(args: argparse.Namespace) -> int:
    """Fit the built-in model to the table, write the material and a picture to judge it by.

    Raises:
        InputError: not a MERL table, one with nothing to fit, a name that is not a file name, or a folder that cannot
            be written.
    """
    path = Path(args.file)
    if path.suffix.lower() != merl.SUFFIX:
        raise InputError(f"{path}: expected a MERL table, a file ending in {merl.SUFFIX}")
    name = path.stem if args.name is None else args.name
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name):
        raise InputError(f"--name {name!r}: use letters, digits, dots, hyphens and underscores")
    table = merl.read(path)
    sys.stdout.write(f"{path}: {table.valid.mean():.0%} of the entries were measured; fitting\n")
    material = fit(table, name)
    out = Path(args.out)
    write_text(out / f"{name}.yaml", fitting.to_yaml(material))
    with atomic_path(out / f"{name}.png") as temporary:
        comparison(table, material).savefig(temporary)
    sys.stdout.write(
        f"error {material.fit_error:.1%} (relative RMS of a sphere under 20 lights)\n"
        f"wrote {out / name}.yaml, to be used wherever a material is named, and {out / name}.png\n"
        "the terms of the data hold for the fit too: keep them in the file's `terms`\n"
    )
    return 0


def fit(table: MerlTable, name: str) -> Material:
    """Fit the built-in model to the measured entries of a table that was read from a file.

    Raises:
        InputError: the table is black.
    """
    source = f"fit to {Path(table.path).name} (SHA-256 {file_hash(Path(table.path))})"
    try:
        return fitting.Fitter().fit(name, merl.as_brdf(table), family="measured", source=source, terms=TERMS)
    except InputError as error:
        raise InputError(f"{table.path}: {error}") from error


def comparison(table: MerlTable, material: Material) -> Figure:
    """Draw spheres of table and fit side by side under five lights, their difference, and slices through both."""
    figure = new_figure(10.4, 9.6)
    figure.suptitle(f"{material.name}: error {material.fit_error:.1%}", fontsize=11)
    parts: Any = figure.subfigures(2, 1, height_ratios=(2, 1.1))
    upper, lower = parts
    rows, captions = sphere_images(table, material), ("measured", "fitted", f"difference x {_GAIN}")
    for axes, images, caption in zip(upper.subplots(3, len(_LIGHTS)), rows, captions, strict=True):
        for axis, image, light in zip(axes, images, _LIGHTS, strict=True):
            axis.imshow(image)
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
            if images is rows[0]:
                axis.set_title(f"light {light[0]}° off the view", fontsize=8)
        axes[0].set_ylabel(caption, fontsize=9)
    for axis, theta_d in zip(lower.subplots(1, len(_SLICES), sharey=True), _SLICES, strict=True):
        _plot_slice(axis, table, material, theta_d)
    return figure


def sphere_images(table: MerlTable, material: Material) -> list[np.ndarray]:
    """Return display images (lights, H, W, 3) uint8 of the table, the fit and their difference, under one exposure."""
    mask, normals = spheres.sphere_normals(_TILE)
    linear = np.zeros((2, len(_LIGHTS), _TILE, _TILE, 3))
    for number, (angle, azimuth) in enumerate(np.radians(_LIGHTS)):
        light = np.array([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)])
        wi, wo = spheres.shading_frame(normals, light)
        for image, brdf in zip(linear, (merl.evaluate(table, wi, wo), model.evaluate(material, wi, wo)), strict=True):
            image[number][mask] = np.pi * brdf * np.maximum(wi[:, 2:], 0)
    exposure = pictures.auto_exposure(linear[0], mask)
    shown = [pictures.tone_map(image, exposure) for image in (*linear, _GAIN * np.abs(linear[1] - linear[0]))]
    for image in shown:
        image[:, ~mask] = 255
    return shown


def _plot_slice(axis: Axes, table: MerlTable, material: Material, theta_d: float) -> None:
    """Plot log BRDF over theta_h at one theta_d and phi_d = 90 degrees: table solid, gaps unmeasured; fit dashed."""
    theta_h = np.linspace(0, np.sqrt(89), 400) ** 2
    wi, wo = merl.directions(np.radians(theta_h), np.radians(theta_d), np.asarray(np.pi / 2))
    data, fitted = merl.as_brdf(table)(wi, wo), model.evaluate(material, wi, wo)
    for channel, colour in enumerate(_COLOURS):
        axis.plot(theta_h, np.where(data[:, channel] > 0, data[:, channel], np.nan), color=colour, lw=1.4, alpha=0.6)
        axis.plot(theta_h, fitted[:, channel], color=colour, lw=0.9, ls="--")
    axis.set_xscale("function", functions=(lambda x: np.sqrt(np.maximum(x, 0)), np.square))
    axis.set(yscale="log", xticks=[0, 1, 5, 15, 30, 60, 90], xlabel="theta_h in degrees")
    axis.set_title(f"BRDF in 1/sr at theta_d = {theta_d}° (dashed: fitted)", fontsize=8)
    axis.tick_params(labelsize=8)
    axis.grid(alpha=0.3)
