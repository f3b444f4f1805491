"""From photographs under unknown lights to normals, a mesh and a picture under a light you choose.

python examples/03_photographs_to_mesh.py my-photographs --out out/example-3
python examples/03_photographs_to_mesh.py --out out/example-3      (makes photographs with the renderer first)
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

import render
import sdps


def save(path: Path, linear: np.ndarray) -> None:
    """Write linear radiance as a camera or a screen has it: sRGB, 8 bits."""
    linear = np.clip(linear, 0, 1)
    coded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    Image.fromarray((255 * coded + 0.5).astype(np.uint8)).save(path)


def photograph(folder: Path, size: int, count: int) -> render.RenderedView:
    """Make photographs of a bust, the lights of unequal strength, and a mask; return the truth."""
    view = render.render_view("sculpture:16", "white-paint", f"near-uniform:{count}", size=size, spp=32)
    strengths = np.random.default_rng(0).uniform(0.6, 1.0, count)
    exposed = view.images * strengths[:, None, None, None] / np.percentile(view.images[:, view.mask], 99.9)
    folder.mkdir(parents=True, exist_ok=True)
    for number, image in enumerate(exposed):
        save(folder / f"{number:03d}.png", image)
    Image.fromarray(255 * view.mask.astype(np.uint8)).save(folder / "mask.png")
    return view


def main() -> None:
    """Load the photographs, infer normals and lights, write what follows from them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("photographs", type=Path, nargs="?", help="folder; see docs/guides/capture.md")
    parser.add_argument("--out", type=Path, default=Path("out/example-3"))
    parser.add_argument("--method", default="auto", help="sdps, pf14, ...; auto takes the best there is")
    parser.add_argument("--size", type=int, default=128, help="side of the photographs that are made")
    parser.add_argument("--count", type=int, default=24, help="how many are made")
    args = parser.parse_args()

    folder, truth = args.photographs, None
    if folder is None:
        folder = args.out / "photographs"
        truth = photograph(folder, args.size, args.count)
    photos = sdps.load(folder)
    result = sdps.infer(photos, args.method)
    print(f"{len(photos)} photographs, {result.method}, {result.seconds:.1f} s")
    if truth is not None:
        scores = sdps.score(result.estimate, truth.mask, normals=truth.normals, light_directions=truth.light_directions)
        print(", ".join(f"{item.name} {item.value:.1f} {item.unit}" for item in scores if item.unit))

    surface = sdps.mesh(result.depth, normals=result.normals)
    sdps.write_mesh(surface, args.out / "mesh.ply")
    lit = sdps.relit(result.normals, result.albedo, np.array([-0.7, 0.5, 0.7]), depth=result.depth)
    Image.fromarray((255 * (result.normals + 1) / 2).astype(np.uint8)).save(args.out / "normals.png")
    save(args.out / "relit.png", lit / np.percentile(lit[photos.mask], 99))
    print(f"mesh of {len(surface.faces)} triangles; see {args.out / 'relit.png'}")


if __name__ == "__main__":
    main()
