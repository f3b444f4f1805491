"""Render and infer extreme but legal scenes, each in a process of its own: `python tests/faults/extreme_run.py`.

Every scene is checked against what it must be; prints a Markdown row each: what came of it, seconds, peak of memory.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
MARK = "result: "
SQUARE = 2237  # (2237 - 1)**2 * 2 triangles: ten million


def scene(shape: str, albedo: float, lights: np.ndarray, size: int, spp: int = 4, **options: object):
    """Render a Lambertian object, check that every value is finite and not negative, and return the view."""
    import render

    view = render.render_view(shape, f"lambertian:{albedo:g}", lights, size=size, spp=spp, **options)
    assert np.isfinite(view.images).all() and (view.images >= 0).all() and view.mask.any()
    assert view.images.shape == (len(lights), size, size, 3)
    return view


def spread(count: int, lowest: float = 0.3) -> np.ndarray:
    """Return directions along a spiral over the hemisphere, (count, 3)."""
    z = np.linspace(1.0, lowest, count)
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    return np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)


def shaded(view, lights: np.ndarray, albedo: float = 1.0) -> str:
    """Compare a sphere's images with Lambert's law inside its outline; tell the largest mean difference of a light."""
    cosine = np.maximum(np.einsum("hwc,lc->lhw", view.normals.astype(np.float64), lights), 0.0)
    inner = view.mask & (view.normals[..., 2] > 0.3)
    pairs = zip(view.images, cosine, strict=True)
    worst = max(float(abs(image[inner, 0] - albedo * law[inner]).mean()) for image, law in pairs)
    assert worst < 0.02, worst
    return f"within {worst:.4f} of Lambert's law"


def infer(images: np.ndarray, mask: np.ndarray, lights: np.ndarray | None, method: str):
    """Write images as a folder of photographs and infer from it, without the refinement (minutes, of 1,000)."""
    import sdps
    from pipelines.evaluate.workbench import write_photographs

    with tempfile.TemporaryDirectory() as name:
        folder = write_photographs(Path(name), images / max(float(images.max()), 1e-6), mask)
        if lights is not None:
            (folder / "light_directions.txt").write_text("".join("{} {} {}\n".format(*row) for row in lights))
        photos = sdps.load(folder, lights=None if lights is None else "folder", gamma="linear")
        found = sdps.infer(photos, method, refine=False)
        assert np.isfinite(found.normals).all()
        return found


def angle(found, view) -> str:
    """Return the mean angular error of an inference."""
    inner = view.mask & (np.linalg.norm(view.normals, axis=-1) > 0.5)
    cosine = np.clip((found.normals * view.normals).sum(axis=-1)[inner], -1, 1)
    error = float(np.degrees(np.arccos(cosine)).mean())
    assert error < 10, error
    return f"normals within {error:.1f} degrees"


def one_light() -> str:
    lights = spread(1)
    return shaded(scene("sphere", 1.0, lights, 64), lights)


def infer_one_light() -> str:
    view = scene("sphere", 1.0, spread(1), 64)
    infer(view.images, view.mask, spread(1), "least-squares")
    return "inferred"


def thousand_lights() -> str:
    lights = spread(1000)
    view = scene("sphere", 1.0, lights, 32)
    return f"{shaded(view, lights)}; {angle(infer(view.images, view.mask, lights, 'least-squares'), view)}"


def thousand_lights_network() -> str:
    view = scene("sphere", 0.8, spread(1000), 64)
    return angle(infer(view.images, view.mask, None, "sdps"), view)


def smallest() -> str:
    lights = spread(8)
    view = scene("sphere", 1.0, lights, 16)
    return f"{shaded(view, lights)}; {angle(infer(view.images, view.mask, lights, 'least-squares'), view)}"


def smallest_network() -> str:
    view = scene("sphere", 0.8, spread(12), 16)
    found = infer(view.images, view.mask, None, "sdps")
    return f"normals of {int((np.linalg.norm(found.normals, axis=-1) > 0.5).sum())} pixels"


def largest() -> str:
    lights = spread(1)
    return shaded(scene("sphere", 1.0, lights, 4096, spp=1), lights)


def infer_largest() -> str:
    side, lights = 4096, spread(4)
    x, y = np.meshgrid((np.arange(side) + 0.5) * 2 / side - 1, 1 - (np.arange(side) + 0.5) * 2 / side)
    z = np.sqrt(np.maximum(1 - (x / 0.9) ** 2 - (y / 0.9) ** 2, 0)).astype(np.float32)
    mask = z > 0.2
    normals = (np.stack([x / 0.9, y / 0.9, z], axis=-1) * mask[..., None]).astype(np.float32)
    images = np.maximum(np.einsum("hwc,lc->lhw", normals, lights.astype(np.float32)), 0)[..., None]
    images = np.repeat(images, 3, axis=-1)

    class View:
        pass

    view = View()
    view.mask, view.normals = mask, normals
    return angle(infer(images, mask, lights, "least-squares"), view)


def one_pixel() -> str:
    view = scene("sphere", 1.0, spread(4), 64, scale=0.02)
    return f"an object of {int(view.mask.sum())} pixels"


def black() -> str:
    scene("sphere", 0.0, spread(4), 32)
    return "rendered"


def white() -> str:
    lights = spread(4)
    view = scene("bunny", 1.0, lights, 64, bounces=8)
    return f"8 bounces inside a white bunny, at most {view.images.max():.2f}"


def grazing() -> str:
    lights = np.array([[np.cos(a), np.sin(a), np.sin(np.radians(0.5))] for a in (0.0, 2.0, 4.0)])
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    return shaded(scene("sphere", 1.0, lights, 64, spp=16), lights)


def ten_million_triangles() -> str:
    import render

    axis = np.linspace(-1, 1, SQUARE, dtype=np.float32)
    x, y = np.meshgrid(axis, axis)
    points = np.stack([x, y, 0.2 * np.sin(9 * x) * np.cos(7 * y)], axis=-1).reshape(-1, 3).astype("<f4")
    corner = (np.arange(SQUARE - 1)[:, None] * SQUARE + np.arange(SQUARE - 1)).reshape(-1)
    rows = np.empty(2 * len(corner), np.dtype([("count", "u1"), ("corners", "<u4", 3)]))
    rows["count"] = 3
    rows["corners"][::2] = np.stack([corner, corner + 1, corner + SQUARE], axis=1)
    rows["corners"][1::2] = np.stack([corner + 1, corner + SQUARE + 1, corner + SQUARE], axis=1)
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(rows)}\nproperty list uchar uint vertex_indices\nend_header\n"
    )
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "waves.ply"
        path.write_bytes(head.encode() + points.tobytes() + rows.tobytes())
        size, count = path.stat().st_size >> 20, len(rows)
        del points, rows, corner, x, y
        view = render.render_view(str(path), "lambertian:0.8", spread(4), size=128, spp=4)
    assert np.isfinite(view.images).all() and view.mask.mean() > 0.1
    return f"{count:,} triangles of a file of {size} MiB"


SCENES: dict[str, Callable[[], str]] = {
    "one light": one_light,
    "one light, inferred": infer_one_light,
    "1,000 lights, inferred with them known": thousand_lights,
    "1,000 lights, inferred by networks, not refined": thousand_lights_network,
    "16x16 pixels, inferred with known lights": smallest,
    "16x16 pixels, inferred by networks, not refined": smallest_network,
    "object of one pixel": one_pixel,
    "albedo 0": black,
    "albedo 1": white,
    "lights half a degree above the horizon": grazing,
    "4,096x4,096 pixels": largest,
    "4,096x4,096 pixels, inferred with known lights": infer_largest,
    "ten million triangles": ten_million_triangles,
}
CHEAP = tuple(SCENES)[:10]


def run(name: str, memory_gib: float = 0.0) -> dict[str, object]:
    """Render a scene in a process of its own; return what came of it, seconds and the peak of memory in MiB."""

    def limited() -> None:
        if memory_gib:
            resource.setrlimit(resource.RLIMIT_AS, (int(memory_gib * 2**30),) * 2)

    began = time.monotonic()
    done = subprocess.run(
        [sys.executable, __file__, "--child", name], cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, preexec_fn=limited,
    )  # fmt: skip
    lines = [line for line in done.stdout.splitlines() if line.startswith(MARK)]
    found = {"outcome": f"exit code {done.returncode}: {done.stderr[-300:]}", "good": False, "peak": 0}
    found |= json.loads(lines[-1].removeprefix(MARK)) if lines else {}
    return {"scene": name, "seconds": round(time.monotonic() - began, 1), **found}


def child(name: str) -> None:
    """Render a scene here and tell."""
    from render.shared.errors import InputError

    try:
        outcome, good = SCENES[name](), True
    except InputError as error:
        outcome, good = f"refused: {error}", "\n" not in str(error)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    sys.stdout.write(f"{MARK}{json.dumps({'outcome': outcome, 'good': good, 'peak': peak})}\n")


def main() -> int:
    """Render all scenes, and print a row each; 1 where one ended otherwise than rendered or refused."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", default=";".join(SCENES), help="names with semicolons")
    parser.add_argument("--child", choices=SCENES, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        child(args.child)
        return 0
    bad = 0
    for name in args.scenes.split(";"):
        row = run(name)
        bad += not row["good"]
        sys.stdout.write(f"| {name} | {row['outcome']} | {row['seconds']} s | {row['peak']:,} MiB |\n")
        sys.stdout.flush()
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
