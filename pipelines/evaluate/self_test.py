"""The self-test of `sdps infer`: render a bunny, save it as photographs, and compare what is found with the truth."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.evaluate.workbench import draw_intensities, write_photographs
from pipelines.rendering.render_data import render_planned
from pipelines.shared.presets import Preset, TestConfig
from pipelines.shared.scenes import test_scenes
from pipelines.shared.text_tables import number
from render.records.shards import read_shard
from render.shared.files import read_json, write_json

if TYPE_CHECKING:
    from sdps.api import Inference

TRUTH = "truth"
_LIGHTS, _SIZE, _SPP = "near-uniform:48", 256, 64
_UNCLIPPED = 99.9
"""Per cent of the object's values that the exposure leaves below full scale, as a careful photographer does."""


def photograph_bunny(folder: Path, material: str = "red-phenolic") -> Path:
    """Render the bunny under 48 lights of unequal strength, and save 16-bit pictures and a mask as a user would.

    Args:
        folder: Gets `000.png` and so on, `mask.png`, and below `truth` what was rendered.
        material: Its material.

    Raises:
        InputError: the folder cannot be written.
    """
    test = TestConfig(shapes=("bunny",), materials=(material,), lights=_LIGHTS, size=_SIZE, spp=_SPP)
    (scene,) = test_scenes(test)
    rendered = folder / TRUTH
    render_planned([scene], rendered, Preset(name="self-test", description="", test=test))
    shard = read_shard(rendered / scene.file, scene)
    gains = draw_intensities(scene, test, 0)
    images = shard.images.astype(np.float32) * gains[:, None, None, None]
    write_photographs(folder, images / np.percentile(images[:, shard.mask], _UNCLIPPED), shard.mask)
    truth = {"shard": scene.file, "intensities": gains.tolist(), "directions": scene.light_directions().tolist()}
    write_json(rendered / "lights.json", truth)
    return folder


def compare(folder: Path, result: "Inference", out: Path) -> str:
    """Score an inference on the photographs of `photograph_bunny`; also written to `self_test.json`.

    Returns:
        A line per figure.
    """
    from sdps.core.metrics import direction_mae, intensity_error, normal_mae

    stored = read_json(folder / TRUTH / "lights.json", "make the photographs again")
    shard = read_shard(folder / TRUTH / stored["shard"])
    scores = {"normals, degrees": normal_mae(result.normals, shard.normals, shard.mask)}
    if len(result.light_directions):
        scores["light directions, degrees"] = direction_mae(result.light_directions, np.array(stored["directions"]))
        scores["light intensities, relative"] = intensity_error(result.intensities, np.array(stored["intensities"]))
    inside = shard.mask
    depth = result.depth.z[inside] * (2.0 / max(inside.shape))  # half image widths, as in the shard
    off = depth - shard.depth[inside]
    scores["depth, share of its range"] = float(np.abs(off - np.median(off)).mean() / np.ptp(shard.depth[inside]))
    write_json(out / "self_test.json", {"method": result.method, "scores": scores})
    lines = "".join(f"  {name}: {number(value)}\n" for name, value in scores.items())
    return f"against the truth (bunny, 48 lights, 16-bit pictures):\n{lines}"
