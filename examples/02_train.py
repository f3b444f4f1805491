"""Plan and render a few training scenes, train LCNet and then NENet on them, and try both on a scene they never saw.

python examples/02_train.py --out out/example-2
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

import render
import sdps


def coloured(normals: np.ndarray) -> np.ndarray:  # (H, W, 3) uint8
    """Return normals as colours."""
    return (255 * (normals + 1) / 2).astype(np.uint8)


def main() -> None:
    """Render, train for a few steps, and compare with the pretrained networks."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/example-2"))
    parser.add_argument("--size", type=int, default=64, help="image side in pixels, a multiple of 4")
    parser.add_argument("--shapes", type=int, default=8)
    parser.add_argument("--steps", type=int, default=60, help="per network; a real run takes thousands")
    parser.add_argument("--method", default="sdps", help="pretrained method to compare with")
    args = parser.parse_args()

    data = args.out / "data"
    config = render.DataConfig(
        families={"blobby": args.shapes}, views=1, materials_per_view=2, validation=0.2, light_count=16,
        size=args.size, spp=16,
    )  # fmt: skip
    scenes = render.plan(config)
    render.render_plan(scenes, data)
    found = render.validate(data)
    print(f"{len(scenes)} scenes of 16 images each in {data}, {'sound' if found.sound else found.findings}")

    def tell(step: int, values: dict[str, float]) -> None:
        shown = (f"{name} {value:.2f}" for name, value in values.items() if name == "loss" or name.endswith("_mae"))
        print(f"  step {step}: {', '.join(shown)}")

    common = {
        "steps": args.steps, "batch_scenes": 2, "images": 8, "optimiser": "muon", "schedule": "cosine", "workers": 0,
        "log_every": max(1, args.steps // 10),
    }  # fmt: skip
    for model, settings in (("lcnet", {"learning_rate": 1e-3}), ("nenet", {"learning_rate": 2e-3, "crop": 32})):
        print(f"{model}:")
        result = sdps.train(model, data, args.out, on_log=tell, **common, **settings)
        print(f"  {result.steps} steps in {result.seconds:.0f} s -> {result.weights[model]}")

    scene = render.read_manifest(data, "val")[0]
    shard = render.read_shard(data / scene.file, scene)
    images = shard.images.astype(np.float32)
    pictures = [(255 * np.clip(images[0], 0, 1) ** (1 / 2.2)).astype(np.uint8), coloured(shard.normals)]
    for name, models in (("lcnet+nenet", args.out), (args.method, None)):
        estimate = sdps.estimate(images, shard.mask, name, models=models)
        scores = sdps.score(estimate, shard.mask, normals=shard.normals, light_directions=shard.light_directions)
        print(f"{name}, {'trained here' if models else 'pretrained'}: "
              + ", ".join(f"{item.name} {item.value:.1f} {item.unit}" for item in scores if item.unit))  # fmt: skip
        pictures.append(coloured(estimate.normals))
    Image.fromarray(np.concatenate(pictures, axis=1)).save(args.out / "normals.png")


if __name__ == "__main__":
    main()
