"""The Gourd&Apple set (Alldrin, Zickler & Kriegman, CVPR 2008): HDR photographs, measured lights, no normals.

Its frame is ours: x right, y up, z to the camera, vectors to the light. The refined lights, corrected by its authors
while they fitted the objects, are what published results compare with.
"""

from pathlib import Path

from pipelines.benchmarks import lit_photographs as common
from pipelines.evaluate.evaluation import TestObject
from render.shared.errors import InputError
from render.shared.tables import read_names

OBJECTS = ("apple", "gourd1", "gourd2")
WANT = "give the folder of apple, gourd1 and gourd2, or one of them; see docs/guides/benchmarks.md"


def gourd_apple_objects(root: Path, *, refined: bool = True, longest: int = 0) -> list[TestObject]:
    """Return the objects of a folder, or of one object's folder.

    Args:
        root: The folder.
        refined: Take the refined lights rather than the measured ones.
        longest: Greatest side in pixels, 0 for no limit.

    Raises:
        InputError: files that are missing or do not fit together.
    """
    lights = f"light_directions{'_refined' if refined else ''}.txt"
    folders = [root] if (root / lights).is_file() else common.object_folders(root, lights, WANT)
    return [_object(folder, refined, longest) for folder in folders]


def _object(folder: Path, refined: bool, longest: int) -> TestObject:
    suffix = "_refined" if refined else ""
    directions, _ = common.read_directions(folder / f"light_directions{suffix}.txt", 1.0)
    count = len(directions)
    intensities = common.read_intensities(folder / f"light_intensities{suffix}.txt", count)
    mask, packed = folder / "mask.png", folder / f"{folder.name}_uncalib.npy"
    if packed.is_file():
        files, names = [packed], [f"{packed}, image {number}" for number in range(count)]
        read = common.packed_images(packed, count)
    else:
        listed = folder / "names.txt"
        if listed.is_file():
            files = [folder / name for name in read_names(listed)]
            if len(files) != count:
                raise InputError(f"{listed}: {len(files)} images for {count} lights; give one image per light")
        else:
            files = common.picture_files(folder, (".exr",), count)
        names, read = [str(path) for path in files], common.picture_reader(files, 1.0)
    return common.photographed(
        folder.name, read, names, common.binary_mask(mask), directions, intensities,
        files=[*files, mask], settings=(), longest=longest,
    )  # fmt: skip
