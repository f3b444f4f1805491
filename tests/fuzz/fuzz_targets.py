"""Every reader of the project, and a small corpus (`fuzz_corpus`) for each.

A target makes a folder of sound files, of which one is mutated at a time, and reads the folder as the commands do.
"""

import json
import os
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import data_folders
import fuzz_app
import fuzz_corpus
from textures_support import write_maps


class Target(NamedTuple):
    """A reader.

    Attributes:
        make: Fills an empty folder with sound files.
        read: Reads what is in the folder; gets the folder and the file that was mutated.
        pattern: Files that are mutated.
    """

    make: Callable[[Path], Any]
    read: Callable[[Path, Path], Any]
    pattern: str = "*"


def _read_shard(folder: Path, path: Path) -> None:
    from render.records.manifest import read_manifest
    from render.records.shards import is_whole, read_shard

    scene = data_folders.scene_of(data_folders.sphere_shard(name="a", count=3))
    if path.suffix == ".exr":
        is_whole(path, scene)
        read_shard(path)
        read_shard(path, scene)
    else:
        read_manifest(folder)


def _read_data(folder: Path, path: Path) -> None:
    from pipelines import cli

    command = ("status", "card", "preview", "validate")[zlib.crc32(path.read_bytes()) % 4]  # all four take a second
    _command(cli.main, ["data", command, str(folder)])
    for made in ("DATASET_CARD.md", "croissant.json", "preview"):
        shutil.rmtree(folder / made, ignore_errors=True)


def _command(main: Callable[[list[str]], int], words: list[str]) -> None:
    """Run a command in this process; what it prints as an error is checked by the caller."""
    code = main(words)
    assert code in (0, 1, 2), code


def _read_preset(folder: Path, path: Path) -> None:
    from pipelines.shared import presets
    from render.planning.plan import plan

    preset = presets.load(str(path))
    if sum(preset.data.families.values()) < 10 and preset.data.views < 3 and preset.data.light_count < 100:
        plan(preset.data)


def _read_lights(folder: Path, path: Path) -> None:
    from render.planning import light_sets

    light_sets.load(str(path))


def _read_material(folder: Path, path: Path) -> None:
    from render.materials import library

    library.load(str(path))


def _read_maps(folder: Path, path: Path) -> None:
    from render.materials.textures import map_folder

    map_folder.read(folder)


def _read_mesh(folder: Path, path: Path) -> None:
    from render.shapes.files.mesh_file import load_mesh

    load_mesh(folder / "model.gltf" if path.suffix in (".bin", ".gltf") else path)


def _read_picture(folder: Path, path: Path) -> None:
    from sdps.photos.masks import read_mask
    from sdps.photos.measures import _camera_settings
    from sdps.photos.picture_file import decode

    decode(path)
    _camera_settings(path)
    read_mask(path, (12, 16))


def _read_camera_file(folder: Path, path: Path) -> None:
    from pipelines.app.common.uploads import Limits, check_pixels
    from sdps.photos.picture_file import decode

    check_pixels(path, Limits())
    decode(path)


def _read_foreign_picture(folder: Path, path: Path) -> None:
    from pipelines.evaluate.benchmarks.uw_photos import _read
    from render.shared.images import read_image

    (_read if path.suffix in (".jpg", ".tga") else read_image)(path)


def _read_environment(folder: Path, path: Path) -> None:
    from render.shared.imaging import environments

    environments.load(str(path))


def _read_light_file(folder: Path, path: Path) -> None:
    from sdps.photos.light_files import read_intensities, read_lights

    files = [f"{number}.png" for number in range(1, 7)]
    read_lights(path, files)
    if path.suffix in (".txt", ".npz"):
        read_intensities(path, files)


def _read_source(folder: Path, path: Path) -> None:
    from sdps.photos import find_poses

    find_poses(path, inside=folder)


def _read_weights(folder: Path, path: Path) -> None:
    from sdps.models.checkpoint import load_state, load_weights
    from sdps.publishing.learning_curves import read_metrics

    {".pt": load_state, ".jsonl": read_metrics}.get(path.suffix, load_weights)(path)


def _read_run(folder: Path, path: Path) -> None:
    from sdps.publishing.model_card import render_card

    render_card(folder / "run" / "a.safetensors", folder / "data")


def _read_tree(folder: Path, path: Path) -> None:
    from pipelines import cli

    layout = "diligent" if (folder / "tree" / "pmsData").exists() else "psfcn"
    words = ["data", "import", str(folder / "tree"), "--layout", layout, "--out", str(folder.parent / "imported")]
    _command(cli.main, words)
    shutil.rmtree(folder.parent / "imported", ignore_errors=True)


def _read_records(folder: Path, path: Path) -> None:
    from pipelines.evaluate.report.sections import read_sections
    from render.exchange.layouts.foreign_samples import read_record

    if path.name == "section.json":
        read_sections(folder)
    else:
        read_record(path)


def _read_result(folder: Path, path: Path) -> None:
    from sdps.surface.exports.registry import EXPORTS, write_exports
    from sdps.surface.exports.saved_result import read_result

    try:
        write_exports(read_result(folder / "result"), EXPORTS, folder / "exports")
    finally:
        shutil.rmtree(folder / "exports", ignore_errors=True)


def _read_cache(folder: Path, path: Path) -> None:
    from sdps.data.scene_store import SceneStore

    SceneStore(folder, cache=True).load(data_folders.scene_of(data_folders.sphere_shard(name="a", count=3)))


def _read_command_line(folder: Path, path: Path) -> None:
    from pipelines import cli

    place = folder / "here"
    place.mkdir(exist_ok=True)
    before = Path.cwd()
    os.chdir(place)
    try:
        _command(cli.main, json.loads(path.read_bytes()))
    except SystemExit as error:
        assert error.code in (0, 1, 2), error.code
    finally:
        os.chdir(before)
        shutil.rmtree(place, ignore_errors=True)


TARGETS: dict[str, Target] = {
    "shards": Target(fuzz_corpus.shards, _read_shard, "shards/*.exr"),
    "manifests": Target(fuzz_corpus.shards, _read_shard, "*.jsonl"),
    "data folders": Target(fuzz_corpus.data, _read_data, "**/*.json*"),
    "presets": Target(fuzz_corpus.asset("presets/smoke.yaml"), _read_preset),
    "lights": Target(fuzz_corpus.lights, _read_lights),
    "materials": Target(fuzz_corpus.asset("materials/chrome.yaml"), _read_material),
    "MERL tables": Target(fuzz_corpus.merl, _read_material),
    "RGL files": Target(fuzz_corpus.rgl, _read_material),
    "PBR maps": Target(write_maps, _read_maps),
    "meshes": Target(fuzz_corpus.meshes, _read_mesh),
    "photographs and masks": Target(fuzz_corpus.pictures, _read_picture),
    "RAW and HEIC": Target(fuzz_corpus.camera_files, _read_camera_file),
    "pictures of other layouts": Target(fuzz_corpus.pictures, _read_foreign_picture, "*.[pj][np]g"),
    "environment maps": Target(fuzz_corpus.environments, _read_environment),
    "light files": Target(fuzz_corpus.light_files, _read_light_file),
    "archives and films": Target(fuzz_corpus.sources, _read_source),
    "weights, checkpoints, curves": Target(fuzz_corpus.weights, _read_weights),
    "model cards": Target(fuzz_corpus.run, _read_run, "[rd]*/*.*"),
    "uploads to the app": Target(fuzz_app.uploads, fuzz_app.read_upload, "uploads/*"),
    "requests to the app": Target(fuzz_app.requests, fuzz_app.read_request, "*.http"),
    "folders the app shows": Target(fuzz_app.room, fuzz_app.read_room, "root/**/*.json*"),
    "PS-FCN trees": Target(fuzz_corpus.psfcn, _read_tree, "tree/**/*.*"),
    "DiLiGenT trees": Target(fuzz_corpus.diligent, _read_tree, "tree/**/*.*"),
    "command lines": Target(fuzz_corpus.command_lines, _read_command_line, "*.argv"),
    "records": Target(fuzz_corpus.records, _read_records, "**/*.json"),
    "saved results": Target(fuzz_corpus.result, _read_result, "result/*"),
    "training cache": Target(fuzz_corpus.cache, _read_cache, "**/*.npy"),
}
SLOW = ("data folders", "PS-FCN trees", "DiLiGenT trees", "model cards", "folders the app shows")
"""Targets of which an input takes a tenth of a second or more: they get fewer."""
