"""Render an object of your own, in materials of your own: images, ground truth and shards.

python examples/01_render_a_scene.py --out out/example-1
"""

import argparse
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

import render


def vase() -> trimesh.Trimesh:
    """Return a fluted vase with an inside, y up; any watertight mesh will do, and a mesh file too."""
    t = np.linspace(0.0, 1.0, 160)
    radius = 0.4 + 0.4 * np.sin(np.pi * t) ** 2 + 0.2 * t**6
    outside, inside = np.stack([radius, 2 * t], axis=1), np.stack([radius - 0.05, 2 * t], axis=1)[:4:-1]
    mesh = trimesh.creation.revolve(np.concatenate([[[0, 0]], outside, inside, [[0, 0.06]]]), sections=240)
    x, y, z = mesh.vertices.T
    flutes = 1 + 0.035 * np.cos(14 * np.arctan2(y, x)) * np.sin(np.pi * z / 2)
    return trimesh.Trimesh(np.stack([flutes * x, z, -flutes * y], axis=1), mesh.faces)


def lacquer(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:  # (N, 3) in 1/sr
    """Return a red diffuse base under a glossy GGX coat; z is the surface normal."""
    half = (wi + wo) / np.linalg.norm(wi + wo, axis=1, keepdims=True)
    cosine = np.maximum((wi * half).sum(axis=1), 0.05)
    a2 = 0.2**4
    lobe = a2 / (np.pi * (half[:, 2] ** 2 * (a2 - 1) + 1) ** 2)
    coat = (0.04 + 0.96 * (1 - cosine) ** 5) * lobe / (4 * cosine**2)
    return np.array([0.45, 0.05, 0.03]) / np.pi + coat[:, None]


def screen(linear: np.ndarray) -> np.ndarray:  # uint8
    """Return linear radiance as a screen wants it."""
    return (255 * np.clip(linear, 0, 1) ** (1 / 2.2)).astype(np.uint8)


def main() -> None:
    """Render the vase in three materials under five lights."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/example-1"))
    parser.add_argument("--size", type=int, default=192, help="image side in pixels")
    parser.add_argument("--spp", type=int, default=64, help="camera samples per pixel")
    args = parser.parse_args()

    own = args.out / "lacquer.yaml"
    own.parent.mkdir(parents=True, exist_ok=True)
    print(f"lacquer: fitted with a relative error of {render.fit_material(own, lacquer).fit_error:.3f}")
    materials = {
        "clay": "lambertian:0.75/0.6/0.5",
        "lacquer": own,
        "striped": f"stripes:4:{own}+pearl-paint",
    }
    # Light vectors point from the surface to the light: x right, y up, z to the camera.
    lights = np.array([[0, 0, 1], [-1, 0.3, 1], [1, 0.3, 1], [0.2, 1, 0.9], [-0.4, -0.5, 1]])
    tipped = trimesh.transformations.rotation_matrix(np.radians(35), [1, 0, 0])[:3, :3]  # seen from above
    views = render.render_views(
        vase(), list(materials.values()), lights, size=args.size, spp=args.spp, scale=0.95, rotation=tipped
    )
    rows = []
    for name, view in zip(materials, views, strict=True):
        render.write_shard(args.out / f"{name}.exr", view.shard(name))
        normals = (255 * (view.normals + 1) / 2).astype(np.uint8)
        rows.append(np.concatenate([*screen(view.images), normals], axis=1))
        print(f"{name}: images {view.images.shape}, {view.mask.sum()} object pixels -> {name}.exr")
    Image.fromarray(np.concatenate(rows)).save(args.out / "images.png")


if __name__ == "__main__":
    main()
