"""Why a network errs on a real object: its reflectance, or how dark its photographs are?

    python -m lab.studies.dark_study DiLiGenT/pmsData --objects pot2 cow [--normals frames.safetensors]

Renders the object from its true normals and the reflectance that its photographs show, the median radiance over
(n.h, n.l), without shadows, relief or noise. The same pictures are then rounded to the photographs' 8 bits, and the
photographs are blurred by a pixel. Prints mean degrees of normals under true lights.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter
from scipy.stats import binned_statistic_2d

from pipelines.evaluate.benchmarks.diligent import DiligentConfig, diligent_objects
from pipelines.shared.text_tables import render_text
from render.shared.errors import unknown
from render.shared.imaging.vectors import unit
from sdps.core.metrics import angle_degrees
from sdps.inference.inference_config import InferenceConfig
from sdps.methods.parse import parse
from sdps.methods.pretrained import finder
from sdps.methods.runner import Runner

_BINS, _SMOOTH, _LEAST = (40, 20), 0.7, 1e-3
_HEAD = ("object", "photographs", "rendered", "rounded to 8 bits", "photographs, blurred")


def render_measured(images: np.ndarray, normals: np.ndarray, lights: np.ndarray) -> np.ndarray:
    """Return radiance (L, P, 3) of pixels as their object's median reflectance has it.

    Args:
        images: (L, P, 3) radiance of the photographs, under lights of equal intensity.
        normals: (P, 3) true ones.
        lights: (L, 3) unit.
    """
    half = unit(lights + np.array([0.0, 0.0, 1.0]))
    angles, cosines = np.arccos((half @ normals.T).clip(-1.0, 1.0)), (lights @ normals.T).clip(0.0, 1.0)  # (L, P)
    rendered = np.zeros(images.shape, np.float32)
    for channel in range(3):
        values = images[..., channel]
        table, across, along, _ = binned_statistic_2d(
            angles.ravel(), cosines.ravel(), values.ravel(), "median", _BINS, [[0.0, 1.2], [0.0, 1.0]]
        )
        known = np.isfinite(table)
        weight = gaussian_filter(known.astype(float), _SMOOTH).clip(min=_LEAST)
        table = gaussian_filter(np.where(known, table, 0.0), _SMOOTH) / weight
        centres = [(edges[1:] + edges[:-1]) / 2 for edges in (across, along)]
        look_up = RegularGridInterpolator(centres, table, bounds_error=False, fill_value=None)
        rendered[..., channel] = look_up(np.stack([angles, cosines], axis=-1)).clip(min=0.0) * (cosines > 0.0)
    return rendered


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--objects", nargs="+", default=["pot2", "cow"])
    parser.add_argument("--normals", default="frames")
    parser.add_argument("--every", type=int, default=2, help="take every N-th photograph")
    args = parser.parse_args(arguments)
    objects = {item.name: item for item in diligent_objects(args.data, DiligentConfig(bits=8))}
    find = finder(None)
    runner = Runner(parse(f"true+{args.normals}", find), find, InferenceConfig(normal_views=1))
    lines = []
    for name in args.objects:
        if name not in objects:
            raise unknown("object", name, objects)
        item = objects[name]
        assert item.normals is not None and item.intensities is not None
        lights, gains = item.true_directions[:: args.every], item.intensities[:: args.every][:, None, None, :]
        inside = item.mask[None, ..., None]
        photographs = np.asarray(item.load()[:], np.float32)[:: args.every] / gains * inside
        rendered = np.zeros_like(photographs)
        rendered[:, item.mask] = render_measured(photographs[:, item.mask], item.normals[item.mask], lights)
        weight = gaussian_filter(item.mask.astype(np.float32), 1.0).clip(min=_LEAST)[None, ..., None]
        shown = (photographs, rendered, np.round(rendered * gains * 255) / 255 / gains,
                 gaussian_filter(photographs, (0, 1, 1, 0)) / weight * inside)  # fmt: skip
        errors = []
        for images in shown:
            images = (images / images.max()).astype(np.float32)
            found = runner.estimate(images, item.mask, lights, np.ones(len(lights), np.float32)).normals
            errors.append(float(angle_degrees(found[item.mask], item.normals[item.mask]).mean()))
        lines.append([name, *(f"{error:.2f}" for error in errors)])
    sys.stdout.write(render_text("Normals under true lights, degrees", _HEAD, lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
