"""`sdps render-data`: plan the training scenes of a preset and render them into shards."""

import argparse
import sys
from pathlib import Path

from pipelines import pictures, presets
from render.errors import InputError
from render.files import atomic_path
from render.manifest import MANIFEST, SceneSpec, read_manifest, write_manifest


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps render-data`."""
    presets.add_common_arguments(parser)


def main(args: argparse.Namespace) -> int:
    """Plan, render what is missing, and say where it went."""
    preset, out = presets.from_arguments(args)
    from render.plan import plan

    folder = out / "data"
    scenes = plan(preset.data)
    rendered = render_planned(scenes, folder, preset)
    images = len(scenes) * preset.data.light_count
    sys.stdout.write(f"{folder}: {len(scenes)} scenes, {images:,} images; {rendered} rendered now; see preview.png\n")
    return 0


def render_planned(scenes: list[SceneSpec], folder: Path, preset: presets.Preset | None = None) -> int:
    """Write the manifest (or check that the folder's is the same), render what is missing, and a contact sheet.

    Returns:
        Number of shards rendered now.

    Raises:
        InputError: the folder holds another plan.
    """
    if (folder / MANIFEST).exists():
        if read_manifest(folder) != scenes:
            raise InputError(f"{folder / MANIFEST}: holds another plan; remove the folder or choose another --out")
    else:
        write_manifest(folder, scenes)
    if preset is not None:
        presets.save_resolved(preset, folder)
    from render.worker import render_scenes

    rendered = render_scenes(scenes, folder)
    if rendered:
        with atomic_path(folder / "preview.png") as temporary:
            pictures.scene_sheet(scenes, folder).save(temporary)
    return rendered
