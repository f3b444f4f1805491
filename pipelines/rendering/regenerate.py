"""`sdps regenerate`: test scenes of chosen shapes, materials and lights."""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

from pipelines.rendering import photographs
from pipelines.rendering.render_data import render_planned
from pipelines.shared import presets, scenes
from pipelines.shared.cluster import cluster_config
from pipelines.shared.flags import split_list
from render.records.manifest import SceneSpec
from render.shared.errors import InputError
from render.shared.imaging.sensor import SensorModel
from render.shared.progress import progress_bar


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps regenerate`; what they leave open comes from the preset's `test` section."""
    parser.add_argument("--shapes", action="append", help="sphere, bunny, blobby:7, a mesh file, ...; commas or repeat")
    parser.add_argument("--materials", action="append", help="names, categories, all, lambertian:0.5, .yaml, .binary "
                        "and .bsdf files, mixtures such as stripes:7:chrome+blue-fabric, procedural:wood:7, "
                        "folders of maps")  # fmt: skip
    parser.add_argument("--light-set", action="append", metavar="NAME|FILE",
                        help="merltest, diligent, grid:96, hand-held:40, ..., or a file of directions")  # fmt: skip
    parser.add_argument("--lights", dest="light_set", action="append", help=argparse.SUPPRESS)  # its earlier name
    parser.add_argument("--camera-distance", type=float, default=None, metavar="D", help="perspective camera at D half "
                        "image widths from the object's centre (default: orthographic)")  # fmt: skip
    parser.add_argument("--light-distance", type=float, default=None, metavar="D", help="near lights at D half image "
                        "widths from the object's centre (default: distant lights)")  # fmt: skip
    parser.add_argument("--mitsuba", action="store_true",
                        help="also save each scene for stock Mitsuba, in <out>/mitsuba/<id>")  # fmt: skip
    parser.add_argument("--photographs", action="store_true", help="also save each scene as the pictures of a camera "
                        "drawn for it (test.sensor), in <out>/photographs/<id>")  # fmt: skip
    cluster_config.add_arguments(parser)
    presets.add_common_arguments(parser)


def main(args: argparse.Namespace) -> int:
    """Render the scenes and a contact sheet of them."""
    preset, _ = presets.from_arguments(args)
    light_sets = split_list(args.light_set) or [preset.test.lights]
    if len(light_sets) != 1:
        raise InputError(f"--light-set: name one light set per run, got {', '.join(light_sets)}")
    test = replace(
        preset.test,
        shapes=tuple(split_list(args.shapes)) or preset.test.shapes,
        materials=tuple(split_list(args.materials)) or preset.test.materials,
        lights=light_sets[0],
        camera_distance=preset.test.camera_distance if args.camera_distance is None else args.camera_distance,
        light_distance=preset.test.light_distance if args.light_distance is None else args.light_distance,
    )
    wanted = scenes.test_scenes(test)
    folder = Path(args.out or "out/regenerated")
    rendered = render_planned(wanted, folder, replace(preset, test=test), cluster_config.from_arguments(args))
    sys.stdout.write(
        f"{folder}: {len(wanted)} scenes x {len(wanted[0].lights)} lights; {rendered} rendered now; see preview.png\n"
    )
    if args.mitsuba:
        save_for_mitsuba(wanted, folder / "mitsuba")
        sys.stdout.write(f"{folder / 'mitsuba'}: {len(wanted)} scenes for stock Mitsuba; each README.txt says how\n")
    if args.photographs:
        photographs.save_photographs(wanted, folder, folder / "photographs", test.sensor or SensorModel(), test.seed)
        sys.stdout.write(
            f"{folder / 'photographs'}: {len(wanted)} scenes as photographs; camera.json says which camera\n"
        )
    return 0


def save_for_mitsuba(scenes: Sequence[SceneSpec], folder: Path) -> None:
    """Save each scene in `<folder>/<id>` as files that Mitsuba renders without this project.

    Raises:
        InputError: a folder that holds other files, or cannot be written.
    """
    from render.publishing import mitsuba_scene
    from render.shapes import load

    with progress_bar(total=len(scenes), unit="scene", desc="save") as bar:
        for shape, group in groupby(scenes, key=lambda scene: scene.shape):
            mesh = load(shape)
            for scene in group:
                mitsuba_scene.save(folder / scene.id, scene, mesh)
                bar.update()
