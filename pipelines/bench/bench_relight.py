"""The part of `sdps bench` that times mixed light: images from a stored light stage against rendering them anew."""

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.shared.memory import timed
from render.planning import light_sets
from render.records.manifest import SceneSpec, View, write_manifest
from render.shared.imaging import environments
from render.shared.imaging.mixing import LightMix, LightStage, mix
from render.shared.progress import progress_bar
from render.shared.seeds import generator
from render.shared.templates import markdown_table

_LIGHTS, _SIZE, _SPP, _BOUNCES = 256, 128, 64, 2
_IMAGES, _REPEATS = 32, 5
_SHAPE, _MATERIAL = "blobby:9", "blue-acrylic"


def relight(_: int, __: Path | None) -> tuple[dict[str, Any], str]:
    """Time images of one scene under environments: rendered with `path` one by one, and mixed from its shard.

    Loading Mitsuba's scenes and compiling are left out of its time; reading the shard is part of ours.
    """
    from render.records.shards import read_shard
    from render.running.worker import render_scenes
    from sdps.data.scene_store import PackedImages, SceneStore

    lights = tuple(tuple(row) for row in light_sets.load(f"stage:{_LIGHTS}").round(6).tolist())
    scene = SceneSpec(id="stage", seed=0, split="train", shape=_SHAPE, material=_MATERIAL, view=View(scale=0.8),
                      lights=lights, size=_SIZE, spp=_SPP, bounces=_BOUNCES)  # fmt: skip
    with tempfile.TemporaryDirectory() as place, progress_bar(total=3 * _REPEATS + 2, unit="run", desc="bench") as bar:
        folder = Path(place)
        write_manifest(folder, [scene])
        start = time.perf_counter()
        render_scenes([scene], folder)
        rendering = time.perf_counter() - start
        bar.update()
        stage = LightStage(scene.light_directions(), "bench")

        def from_shard(images: int = _IMAGES) -> None:
            stack = read_shard(folder / scene.file, scene).images
            weights, _ = LightMix().draw(stage, images, generator(0, "bench"))
            mix(stack.reshape(_LIGHTS, -1, 3), weights)

        store = SceneStore(folder, cache=True)
        store.load(scene)

        def from_cache() -> None:
            packed = PackedImages.of(store.load(scene).images)
            weights, _ = LightMix().draw(stage, _IMAGES, generator(0, "bench"))
            mix(packed.values, weights)

        times: dict[str, list[float]] = {"path": [], "shard": [], "cache": []}
        anew = _environment_renders(scene)
        anew()
        bar.update()
        for _repeat in range(_REPEATS):
            for name, way in (("path", anew), ("shard", from_shard), ("cache", from_cache)):
                times[name].append(timed(way) / (1 if name == "path" else _IMAGES))
                bar.update()
    seconds = {name: float(np.median(values)) for name, values in times.items()}
    ratios = {f"path / {name}": seconds["path"] / seconds[name] for name in ("shard", "cache")}
    values = {"seconds_per_image": seconds, "stage_seconds": rendering, "ratios": ratios, "images": _IMAGES}
    return values, _text(values)


def _environment_renders(scene: SceneSpec) -> Any:
    """Return what renders one image of the scene under an environment with Mitsuba's `path`, the scene loaded."""
    from render import shapes
    from render.backend import variant
    from render.kernel import reference
    from render.materials.kernels import surface_bsdf

    mi = variant.load()
    surface_bsdf.register()
    described = reference.scene_dict(shapes.load(scene.shape), scene.view, scene.material, _SIZE, _SPP, _BOUNCES)
    described["light"] = {"type": "envmap", "bitmap": mi.Bitmap(environments.load("studio"))}
    loaded = mi.load_dict(described)
    return lambda: np.array(mi.render(loaded, seed=0))


def _text(values: dict[str, Any]) -> str:
    """Format the times as a Markdown table."""
    seconds, ratios = values["seconds_per_image"], values["ratios"]
    rows = [
        ("Mitsuba `path` under the environment", f"{1000 * seconds['path']:.1f}", ""),
        (f"mixed, {_IMAGES} images a read of the shard", f"{1000 * seconds['shard']:.1f}",
         f"{ratios['path / shard']:.0f}"),
        (f"mixed, {_IMAGES} images a scene of training's cache", f"{1000 * seconds['cache']:.1f}",
         f"{ratios['path / cache']:.0f}"),
    ]  # fmt: skip
    about = (
        f"Mixed light: {_SHAPE}, {_MATERIAL}, {_SIZE}x{_SIZE} pixels, {_SPP} spp, {_BOUNCES} bounces; the stage of "
        f"{_LIGHTS} lights was rendered and written in {values['stage_seconds']:.1f} s\n\n"
    )
    return about + markdown_table(("way", "ms an image", "times faster (target: 20)"), rows) + "\n"
