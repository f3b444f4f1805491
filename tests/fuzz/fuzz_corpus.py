"""Small folders of sound files, one kind each, of which the fuzzer mutates one file at a time."""

import gzip
import json
import shutil
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import benchmark_folders
import cv2
import data_folders
import exchange_support
import numpy as np
import OpenEXR
import scipy.io
import tifffile
import trimesh
import yaml
from PIL import Image
from saved_results import save_result, sphere

_RNG = np.random.default_rng(0)
_IMAGE = _RNG.uniform(0, 1, (12, 16, 3))


def shards(folder: Path) -> None:
    data_folders.write_folder(folder, [data_folders.sphere_shard(name="a", count=3)])


def data(folder: Path) -> None:
    scenes = data_folders.good_folder(folder)
    (folder / "log").mkdir()
    line = {"bytes": 5, "seconds": 1.5, "stages": {"render": 1.0}, "time": "2026-01-01T00:00:00.000+00:00", "worker": 1}
    rows = [{"id": scene.id, "spec": scene.digest(), **line} for scene in scenes]
    (folder / "log" / "done-host-1-0.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    failed = rows[0] | {"seed": 1, "shape": "sphere", "material": "chrome", "reason": "it broke", "attempt": 1}
    failed["traceback"] = "Traceback"
    (folder / "failed.jsonl").write_text(json.dumps(failed) + "\n")
    check = {"name": "x", "level": "error", "findings": 1, "about": "y"}
    (folder / "validation.json").write_text(json.dumps(
        {"checked": 4, "planned": 4, "errors": 1, "warnings": 0, "time": "2026-01-01", "sound": False,
         "manifest_sha256": "0", "checks": [check]}
    ))  # fmt: skip


def asset(name: str) -> Callable[[Path], Any]:
    root = Path(__file__).resolve().parents[2] / "assets"
    return lambda folder: shutil.copy(root / name, folder / f"own-{Path(name).name}")


def lights(folder: Path) -> None:
    rows = np.round(data_folders.light_directions(12).astype(float), 6).tolist()
    (folder / "rig.yaml").write_text(yaml.safe_dump({"name": "rig", "directions": rows}))


def merl(folder: Path) -> None:
    (folder / "a.binary").write_bytes(struct.pack("<3i", 90, 90, 180) + bytes(8 * 400))


def rgl(folder: Path) -> None:
    from render.materials import rgl

    rgl.write(folder / "a_rgb.bsdf", lambda wi, wo: np.full((len(wi), 3), 0.3), slices=3, side=4)


def meshes(folder: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=1)
    for kind in ("ply", "obj", "stl", "glb", "off", "stl_ascii"):
        ball.export(folder / f"ball-{kind}.{kind.split('_')[0]}", file_type=kind)
    ball.export(folder / "ball-ascii.ply", encoding="ascii")
    (folder / "ball.ply.gz").write_bytes(gzip.compress((folder / "ball-ply.ply").read_bytes()))
    for name, data in trimesh.Scene(ball).export(file_type="gltf").items():
        (folder / name).write_bytes(data)


def pictures(folder: Path) -> None:
    from photo_folders import write

    for name, bits in (("a8.png", 8), ("a16.png", 16), ("a8.tif", 8), ("a16.tif", 16), ("a.jpg", 8), ("a.exr", 16)):
        write(folder / name, _IMAGE, bits)
    tifffile.imwrite(folder / "float.tiff", _IMAGE.astype(np.float32), compression="deflate")
    grey = np.dstack([_IMAGE, _IMAGE[..., :1]])
    assert cv2.imwrite(str(folder / "alpha.png"), (grey * 65535).astype(np.uint16))
    for name in ("a.bmp", "a.tga", "a.ppm", "a.webp", "jpeg.png"):
        Image.fromarray((_IMAGE * 255).astype(np.uint8)).save(folder / name, "JPEG" if name == "jpeg.png" else None)
    tifffile.imwrite(folder / "planes.tif", np.moveaxis(_IMAGE, -1, 0).astype(np.float16), planarconfig="separate")
    (folder / "text.pgm").write_text("P2 16 12 1023\n" + " ".join(str(5 * number) for number in range(192)))
    layers = {f"View.{name}": np.ascontiguousarray(_IMAGE[..., k], np.float32) for k, name in enumerate("RGB")}
    OpenEXR.File({}, layers | {"View.Depth.Z": layers["View.R"]}).write(str(folder / "layers.exr"))


def camera_files(folder: Path) -> None:
    from raw_files import dng

    (folder / "a.dng").write_bytes(dng((np.resize(_IMAGE, (24, 32)) * 65535).astype(np.uint16), seconds=0.1))
    for name in ("upright", "turned"):
        heic = Path(__file__).parent.parent / f"sdps/photos/pictures/decoding/{name}.heic"
        (folder / heic.name).write_bytes(heic.read_bytes())


def environments(folder: Path) -> None:
    from photo_folders import write

    sky = np.repeat(_IMAGE[:8], 1, axis=1).astype(np.float32)  # 8 x 16
    assert cv2.imwrite(str(folder / "sky.hdr"), sky)
    write(folder / "sky.exr", sky)


def light_files(folder: Path) -> None:
    from sdps.photos.light_files import write_lights

    names = [f"{number}.png" for number in range(1, 7)]
    vectors = data_folders.light_directions(6).astype(float)
    write_lights(folder / "lights.json", names, vectors, np.ones(6))
    (folder / "lights.txt").write_text("".join("{} {} {}\n".format(*row) for row in vectors))
    (folder / "named.txt").write_text(
        "".join(f"{name} {x} {y} {z} 1.0\n" for name, (x, y, z) in zip(names, vectors, strict=True))
    )
    rows = [(name, *vector) for name, vector in zip(names, np.round(vectors, 5).tolist(), strict=True)]
    (folder / "paths.lp").write_text("6\n" + "".join("C:\\rti\\{} {} {} {}\n".format(*row) for row in rows))
    (folder / "angles.csv").write_text("file;azimuth;elevation\n" + "".join(f"{name};30,5;45\n" for name in names))
    for name, row in (("slants", [10, 20, 30, 40, 50, 60]), ("tilts", [0, 60, 120, 180, 240, 300])):
        (folder / f"{name}.tup").write_text("006\n" + "".join(f"2 {value:.16e}\n" for value in row))
    np.save(folder / "lights.npy", vectors.T)
    np.savez(folder / "lights.npz", L=vectors, light_intensities=np.ones(6), images=np.zeros((6, 4, 4)))
    for name, packed in (("plain.mat", False), ("packed.mat", True)):
        content = {"S": vectors, "images": np.zeros((4, 4, 6)), "about": {"a": "b"}}
        scipy.io.savemat(folder / name, content, do_compression=packed)
    meshroom = [{"viewId": str(number), "type": "SH", "intensity": ["1", "2", "1"],
                 "direction": [str(value) for value in (*(row[1:] * np.array([1, -1, -1])), *[0.1] * 6)]}
                for number, row in enumerate(map(np.array, [(0.0, *row[1:]) for row in rows]))]  # fmt: skip
    (folder / "meshroom.json").write_text(json.dumps({"lights": meshroom}))
    near = {"kind": "near", "unit": "mm", "object": [0, 0, -1], "positions": {name: row for name, *row in rows}}
    (folder / "near.yaml").write_text(json.dumps(near | {"intensities": dict.fromkeys(names, 1.0)}))
    (folder / "near.lp").write_text(
        "# near, unit cm, object 0 0 -2\n" + "".join("{} {} {}\n".format(*row) for row in 9 * vectors)
    )
    write_lights(folder / "near.json", names, vectors, np.ones(6), np.linspace(0.0, 0.5, 6))
    images = [{"filename": name, "direction": dict(zip("xyz", vector, strict=True))} for name, *vector in rows]
    (folder / "project.relight").write_text(json.dumps({"images": images}))
    places = [image["direction"] for image in images]
    factors = [dict.fromkeys("rgb", 1.0 + number) for number in range(6)]
    dome = {"domeDiameter": 600, "imageWidth": 90, "verticalOffset": -9, "directions": places, "ledAdjust": factors}
    (folder / "rig.dome").write_text(json.dumps(dome))


def sources(folder: Path) -> None:
    with zipfile.ZipFile(folder / "rig.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for number in range(6):
            picture = cv2.imencode(".png", np.rint(255 * np.roll(_IMAGE, number, axis=1)).astype(np.uint8))[1]
            archive.writestr(f"rig/ps_{number // 3}/{number}.png", picture.tobytes())
    for name, code in (("lamp.avi", "MJPG"), ("lamp.mp4", "mp4v")):
        film = cv2.VideoWriter(str(folder / name), cv2.VideoWriter_fourcc(*code), 25, (16, 12))
        for number in range(8):
            film.write(np.rint(255 * np.roll(_IMAGE, number, axis=1)).astype(np.uint8))
        film.release()


def weights(folder: Path) -> None:
    from render.shared.config import to_plain
    from sdps.data.augment import Augmentation
    from sdps.models import registry
    from sdps.models.checkpoint import TrainedModel, save_state, save_weights

    network = registry.create("frames")
    metadata = {"config": {"augmentation": to_plain(Augmentation())}, "data": "0", "code": "0", "step": 1}
    save_weights(folder / "a.safetensors", TrainedModel("frames", network, {}, metadata), half=True)
    values = list(network.state_dict().values())[:3]
    save_state(folder / "checkpoint.pt", {"step": 3, "network": dict(enumerate(values)), "best": None, "names": ["a"]})
    (folder / "metrics.jsonl").write_text('{"step": 1, "loss": 0.5}\n{"step": 2, "loss": 0.4, "val_mae": 9.5}\n')


def run(folder: Path) -> None:
    """Write what a model card is made of: weights that tell much, curves, presets, a data folder with its own card."""
    from render.records.manifest import MANIFEST
    from render.records.shards import file_hash
    from render.shared.config import to_plain
    from sdps.data.augment import Augmentation
    from sdps.models import registry
    from sdps.models.checkpoint import TrainedModel, save_weights

    data_folders.write_folder(folder / "data", [data_folders.sphere_shard(name="a", count=3)])
    (folder / "data" / "DATASET_CARD.md").write_text("# a\n\n## Licences\n\nfree\n")
    metadata = {
        "config": {"augmentation": to_plain(Augmentation()), "lights": "true", "learning_rate": 1e-4, "epochs": [1, 2]},
        "data": file_hash(folder / "data" / MANIFEST), "code": "0", "step": 2, "seconds": 7200.0, "scenes": 1,
        "computed": [{"precision": "float32", "device": "cpu", "step": 1}], "metrics": {"val_direction_mae": 9.5},
        "lighting": {"model": "lcnet", "sha256": "0"}, "lights": "true",
    }  # fmt: skip
    run = folder / "run"
    run.mkdir()
    model = TrainedModel("frames", registry.create("frames"), {}, metadata)
    save_weights(run / "a.safetensors", model, half=True)
    rows = [{"step": 1, "loss": 0.5, "images_per_second": 9.0}, {"step": 2, "loss": 0.4, "val_direction_mae": 9.5}]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (run / "training.yaml").write_text("model: lcnet\nsteps: 5\n")
    (run / "config.yaml").write_text("name: x\ndata: {size: 16}\ntest: {size: 16}\n")


def psfcn(folder: Path) -> None:
    _exported(folder, "psfcn")


def diligent(folder: Path) -> None:
    benchmark_folders.write_diligent(folder / "tree", ("ball",), lights=4)
    shutil.rmtree(folder / "tree-shards")


def _exported(folder: Path, layout: str) -> None:
    from pipelines import cli

    exchange_support.write_folder(folder / "data", lights=3, size=12)
    done = cli.main(["data", "export", str(folder / "data"), "--layout", layout, "--out", str(folder / "tree")])
    assert done == 0
    shutil.rmtree(folder / "data")


def records(folder: Path) -> None:
    (folder / "export.json").write_text('{"layout": "psfcn", "bits": 16, "scenes": {}}')
    table = {"title": "t", "header": ["a", "b"], "rows": [["x", 1.0]]}
    section = {"name": "x", "order": 1, "title": "t", "text": "a", "tables": [table], "strips": []}
    (folder / "report" / "x").mkdir(parents=True)
    (folder / "report" / "x" / "section.json").write_text(json.dumps(section))


def cache(folder: Path) -> None:
    from sdps.data.scene_store import SceneStore

    scenes = data_folders.write_folder(folder, [data_folders.sphere_shard(name="a", count=3)])
    SceneStore(folder, cache=True).load(scenes[0])


def command_lines(folder: Path) -> None:
    """Write a line for every flag and positional of every command, which ends before anything long is begun."""
    from pipelines.cli import COMMANDS, Group, build_parser

    known = [(name,) for name, command in COMMANDS.items() if not isinstance(command, Group)]
    known += [(name, inner) for name, group in COMMANDS.items() if isinstance(group, Group) for inner in group.commands]
    number = 0
    for words in known:
        parser = _innermost(build_parser(words), words)
        actions = [action for action in parser._actions if action.dest != "help"]
        lines = [[*words, "--nothing", "value"]]
        for action in actions if words[-1] not in _LONG else ():
            if action.nargs == 0:
                continue
            flag = action.option_strings[-1:]
            missing = ["missing"] if flag and any(not other.option_strings for other in actions) else []
            lines.append([*words, *_stop(words, actions), *missing, *flag, "value"])
        for line in lines:
            (folder / f"{number:03d}-{words[-1]}.argv").write_text(json.dumps(line))
            number += 1


_LONG = ("shapes",)
"""Commands that begin to work whatever their flags are; only flags they do not have are tried."""


def _stop(words: tuple[str, ...], actions: list[Any]) -> list[str]:
    """Return flags that end a command which needs no other, before anything long is begun."""
    stops = {
        "materials": ["--materials", "missing"],
        "app": ["--max-files", "0", "--max-megabytes", "0"],
    }
    preset = any(action.dest == "preset" for action in actions)
    return stops.get(words[-1], ["--set", "data.size=0"] if preset else [])


def _innermost(parser: Any, words: tuple[str, ...]) -> Any:
    import argparse

    for word in words:
        (children,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
        parser = children.choices[word]
    return parser


def result(folder: Path) -> None:
    from sdps.core.geometry import Camera

    camera = Camera(40.0)
    save_result(folder / "result", sphere(15, 6.0, camera), camera=camera, pixel_size=0.5)
