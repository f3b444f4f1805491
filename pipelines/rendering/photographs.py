"""`sdps regenerate --photographs`: rendered scenes as the files of a camera, for `sdps infer` and other readers."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from render.records.manifest import SceneSpec
from render.records.shards import read_shard
from render.shared.config import to_plain
from render.shared.files import atomic_folder, write_json, write_text
from render.shared.images import quantise, write_png
from render.shared.imaging.sensor import Sensor, SensorModel, jpeg
from render.shared.progress import progress_bar
from render.shared.seeds import generator
from render.shared.tables import format_rows, lines_text
from sdps.data.augment import Augmentation, exposure_scale


def save_photographs(
    scenes: Sequence[SceneSpec], data: Path, folder: Path, model: SensorModel, seed: int
) -> list[Sensor]:
    """Save each scene in `<folder>/<id>`: pictures, mask.png, lights, normal map (float32 .npy), camera.json.

    A light meter exposes each scene: the object's mean over all images is that of training (`Augmentation.mean_level`).
    Then the scene's own camera takes the pictures, all at one setting. A camera of 8 bits saves linear 8-bit PNG, one
    of more linear 16-bit PNG, one with JPEG sRGB files.

    Args:
        scenes: Rendered scenes.
        data: Their data folder.
        folder: Where to; what is there of the same scenes is replaced.
        model: Which cameras there are.
        seed: Root seed; each scene has a camera and noise of its own.

    Returns:
        The cameras.

    Raises:
        InputError: a missing or damaged shard, or a full disk.
    """
    meter, cameras = Augmentation(), []
    for scene in progress_bar(scenes, unit="scene", desc="photograph"):
        rng = generator(seed, "photographs", scene.id)
        camera, shard = model.draw(rng), read_shard(data / scene.file, scene)
        images = shard.images.astype(np.float32)
        exposure = exposure_scale(images[:, shard.mask], meter.mean_level, 1.0)
        with atomic_folder(folder / scene.id) as place:
            _save_pictures(place, images * exposure, camera, rng)
            write_png(place / "mask.png", shard.mask.astype(np.uint8) * 255)
            write_text(place / "light_directions.txt", lines_text(format_rows(scene.light_directions())))
            np.save(place / "normals.npy", shard.normals)
            about = {"exposure": float(exposure), "seed": seed} | to_plain(camera)
            write_json(place / "camera.json", {"scene": scene.id, **about})
        cameras.append(camera)
    return cameras


def _save_pictures(place: Path, images: np.ndarray, camera: Sensor, rng: np.random.Generator) -> None:
    """Take and save one picture after another, of exposed images (L, H, W, 3)."""
    for number, image in enumerate(images, start=1):
        linear = camera.develop(camera.expose(image[None], rng))[0]
        if camera.jpeg_quality:
            (place / f"{number:03d}.jpg").write_bytes(jpeg(linear, camera.jpeg_quality))
        else:
            write_png(place / f"{number:03d}.png", quantise(linear, 8 if camera.bits == 8 else 16))
