"""The part of `lab bench` that times mixed light: images from a stored light stage against rendering them anew."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from lab.shared.memory import measure_seconds
from render.planning import light_sets
from render.records.manifest import SceneSpec, View, write_manifest
from render.shared.imaging import environments
from render.shared.imaging.mixing import LightMix, LightStage, mix
from render.shared.progress import progress_bar
from render.shared.seeds import generator
from render.shared.templates import markdown_table

_LIGHTS, _SIZE, _SPP, _BOUNCES = 256, 128, 64, 2
_IMAGES, _FEW, _REPEATS = 32, 10, 5
_SHAPE, _MATERIAL = "blobby:9", "blue-acrylic"


def relight(_: int, __: Path | None) -> tuple[dict[str, Any], str]:
    """Time images of one scene under environments: rendered with `path` one by one, and mixed from its shard.

    Loading Mitsuba's scenes and compiling are left out of its time; reading the shard is part of ours.
    """
    from render.running.scene_rendering import render_scenes

    lights = tuple(tuple(row) for row in light_sets.load(f"stage:{_LIGHTS}").round(6).tolist())
    scene = SceneSpec(id="stage", seed=0, split="train", shape=_SHAPE, material=_MATERIAL, view=View(scale=0.8),
                      lights=lights, size=_SIZE, spp=_SPP, bounces=_BOUNCES)  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        write_manifest(folder, [scene])
        rendering = measure_seconds(lambda: render_scenes([scene], folder))
        ways = _ways(scene, Path(folder))
        ways["path"][0]()  # compiles
        times: dict[str, list[float]] = {name: [] for name in ways}
        for _repeat in progress_bar(range(_REPEATS), unit="round", desc="bench"):
            for name, (way, images) in ways.items():
                times[name].append(measure_seconds(way) / images)
    seconds = {name: float(np.median(values)) for name, values in times.items()}
    ratios = {f"path / {name}": seconds["path"] / seconds[name] for name in ways if name != "path"}
    values = {"seconds_per_image": seconds, "stage_seconds": rendering, "ratios": ratios}
    return values, _text(values)


def _ways(scene: SceneSpec, folder: Path) -> dict[str, tuple[Callable[[], object], int]]:
    """Return what is timed, and how many images it makes."""
    from render.records.shards import read_shard
    from sdps.data.scene_store import PackedImages, SceneStore

    stage, store = LightStage(scene.light_directions(), "bench"), SceneStore(folder, cache=True)
    store.load(scene)
    rng = generator(0, "bench")  # every run draws other maps, so that none is timed twice

    def from_shard(images: int) -> None:
        stack = read_shard(folder / scene.file, scene).images
        mix(stack.reshape(_LIGHTS, -1, 3), LightMix().draw(stage, images, rng)[0])

    def from_cache() -> None:
        packed = PackedImages.of(store.load(scene).images)
        mix(packed.values, LightMix().draw(stage, _IMAGES, rng)[0])

    return {
        "path": (_environment_renders(scene), 1),
        "shard, few": (lambda: from_shard(_FEW), _FEW),
        "shard": (lambda: from_shard(_IMAGES), _IMAGES),
        "cache": (from_cache, _IMAGES),
    }


def _environment_renders(scene: SceneSpec) -> Callable[[], object]:
    """Return what renders one image of the scene under an environment with Mitsuba's `path`, the scene loaded."""
    from render import shapes
    from render.backend.jit import mi
    from render.kernel import reference
    from render.materials.kernels import surface_bsdf

    surface_bsdf.register()
    described = reference.scene_dict(shapes.load(scene.shape), scene.view, scene.material, _SIZE, _SPP, _BOUNCES)
    described["light"] = {"type": "envmap", "bitmap": mi.Bitmap(environments.load("studio"))}
    loaded = mi.load_dict(described)
    return lambda: np.array(mi.render(loaded, seed=0))


def _text(values: dict[str, Any]) -> str:
    """Format the times as a Markdown table."""
    seconds, ratios = values["seconds_per_image"], values["ratios"]
    labels = {
        "shard, few": f"mixed, {_FEW} images a read of the shard (as `sdps data relight` makes)",
        "shard": f"mixed, {_IMAGES} images a read of the shard",
        "cache": f"mixed, {_IMAGES} images a scene of training's cache",
    }
    rows = [("Mitsuba `path` under the environment", f"{1000 * seconds['path']:.1f}", "")]
    rows += [(text, f"{1000 * seconds[name]:.1f}", f"{ratios[f'path / {name}']:.0f}") for name, text in labels.items()]
    about = (
        f"Mixed light: {_SHAPE}, {_MATERIAL}, {_SIZE}x{_SIZE} pixels, {_SPP} spp, {_BOUNCES} bounces; the stage of "
        f"{_LIGHTS} lights was rendered and written in {values['stage_seconds']:.1f} s\n\n"
    )
    return about + markdown_table(("way", "ms an image", "times faster (target: 20)"), rows) + "\n"
