"""A Meshroom node that finds normals with `sdps infer`, pose by pose.

It needs nothing but Python's standard library and Meshroom itself; sdps runs as a command, with its own Python.
"""

# ruff: noqa: RUF012  (Meshroom's descriptions are lists of the class)
import json
import os
import shlex
import shutil

from meshroom.core import desc
from meshroom.core.utils import VERBOSE_LEVEL

__version__ = "1.0"
__license__ = "MIT"

FEWEST = 3
"""Views of a pose from which photometric stereo is possible; poses with fewer are left out."""
_OURS = "x right, y up, z to the camera"


class SdpsPhotometricStereo(desc.Node):
    """Normals, lights and expected errors of photographs under changing light, by `sdps infer`.

    Views with one poseId are the photographs of one pose. Without a light file the lights are found.
    """

    category = "Photometric Stereo"
    size = desc.StaticNodeSize(1)
    cpu = desc.Level.INTENSIVE
    ram = desc.Level.INTENSIVE

    documentation = __doc__

    inputs = [
        desc.File(
            name="inputPath",
            label="SfMData",
            description="SfMData file (.sfm, .json) whose views with one poseId are the photographs of one pose; or a "
            "folder of photographs of one pose.",
            value="",
        ),
        desc.File(
            name="maskPath",
            label="Mask Folder Path",
            description="Folder of masks, <poseId>.png or the name of the pose's folder without 'ps_'; or one mask. "
            "Empty: the mask is found.",
            value="",
        ),
        desc.File(
            name="pathToJSONLightFile",
            label="Light File",
            description="JSON of LightingCalibration, .lp, any light file that sdps reads, or a folder with DiLiGenT's "
            "light_directions.txt and light_intensities.txt. Empty: the lights are found.",
            value="",
        ),
        desc.StringParam(
            name="method",
            label="Method",
            description="Method of `sdps infer`.",
            value="auto",
        ),
        desc.BoolParam(
            name="useIntrinsics",
            label="Use Intrinsics",
            description="Take focal length and principal point from SfMData; else from the files' EXIF data.",
            value=True,
            advanced=True,
        ),
        desc.StringParam(
            name="arguments",
            label="More Arguments",
            description="Further flags of `sdps infer`, such as --light-distance each; not --scale.",
            value="",
            advanced=True,
        ),
        desc.StringParam(
            name="command",
            label="Command",
            description="How sdps is started: its path in a virtual environment, for example.",
            value="sdps",
            invalidate=False,
            advanced=True,
        ),
        desc.ChoiceParam(
            name="verboseLevel",
            label="Verbose Level",
            description="Verbosity level (fatal, error, warning, info, debug, trace).",
            values=VERBOSE_LEVEL,
            value="info",
        ),
    ]

    outputs = [
        desc.File(
            name="outputPath",
            label="Output Folder",
            description="Maps of all poses, and a folder with everything that sdps found for each.",
            value="{nodeCacheFolder}",
        ),
        desc.File(
            name="outputSfmDataNormal",
            label="SfMData Normal",
            description="SfMData of the normal maps, EXR in AliceVision's camera frame.",
            value="{nodeCacheFolder}/normalMaps.sfm",
        ),
        desc.File(
            name="outputSfmDataNormalPNG",
            label="SfMData Normal PNG",
            description="SfMData of the normal maps, 16-bit PNG in OpenGL's look, as Open-RNb reads them.",
            value="{nodeCacheFolder}/normalMapsPNG.sfm",
        ),
        desc.File(
            name="outputMaskFolder",
            label="Mask Folder",
            description="Masks, <poseId>.png.",
            value="{nodeCacheFolder}/masks",
        ),
        desc.File(
            name="normals",
            label="Normal Maps Camera",
            description="Normal maps in the camera's frame.",
            semantic="image",
            value="{nodeCacheFolder}/<POSE_ID>_normals.exr",
        ),
        desc.File(
            name="normalsPNG",
            label="Normal Maps Camera (in false colors)",
            description="Normal maps in the camera's frame, as colors.",
            semantic="image",
            value="{nodeCacheFolder}/<POSE_ID>_normals.png",
        ),
    ]

    def processChunk(self, chunk):
        """Run `sdps infer` on every pose, collect its maps, and write SfMData that names them."""
        try:
            chunk.logManager.start(chunk.node.verboseLevel.value)
            node, out = chunk.node, chunk.node.outputPath.value
            os.makedirs(os.path.join(out, "masks"), exist_ok=True)
            scene = read_scene(node.inputPath.value)
            poses = group_views(scene, chunk.logger)
            for number, (pose, views) in enumerate(poses.items(), start=1):
                chunk.logger.info("Pose %s (%d of %d): %d photographs", pose, number, len(poses), len(views))
                words = build_command(node, scene, pose, views, os.path.join(out, pose))
                run(chunk, words)
                collect_maps(os.path.join(out, pose), out, pose)
            for name, suffix in (("outputSfmDataNormal", "exr"), ("outputSfmDataNormalPNG", "png")):
                save_scene(describe_maps(scene, poses, out, suffix), getattr(node, name).value)
        finally:
            chunk.logManager.end()


def read_scene(path):
    """Return SfMData as a dictionary; of a folder of photographs one pose, without a camera."""
    if os.path.isdir(path):
        endings = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".exr")
        files = [name for name in sorted(os.listdir(path)) if name.lower().endswith(endings) and not _is_mask(name)]
        views = [{"viewId": str(number), "poseId": "1", "path": os.path.join(path, name)}
                 for number, name in enumerate(files, start=1)]  # fmt: skip
        return {"version": ["1", "2", "6"], "views": views}
    if not path or os.path.splitext(path)[1].lower() not in (".sfm", ".json"):
        raise RuntimeError(f"SfMData {path!r}: name a .sfm or .json file, or a folder of photographs")
    try:
        with open(path, encoding="utf-8") as file:
            scene = json.load(file)
    except (OSError, ValueError) as error:
        raise RuntimeError(f"SfMData {path}: cannot be read ({error})") from error
    if not isinstance(scene, dict):
        raise RuntimeError(f"SfMData {path}: has no views")
    return scene


def group_views(scene, logger):
    """Return {poseId: its views in the order of their paths}, of poses with enough of them; ambient views are left out.

    Raises RuntimeError where there is none, or where the photographs of a pose lie in several folders.
    """
    groups = {}
    for view in scene.get("views", []):
        stem = os.path.splitext(os.path.basename(view["path"]))[0].lower()
        if "ambient" not in stem and "ambiant" not in stem:
            groups.setdefault(str(view.get("poseId", view["viewId"])), []).append(view)
    few = [pose for pose, views in groups.items() if len(views) < FEWEST]
    if few:
        logger.info("Left out %d pose(s) with fewer than %d photographs", len(few), FEWEST)
    kept = {pose: sorted(views, key=lambda view: view["path"]) for pose, views in groups.items() if pose not in few}
    if not kept:
        raise RuntimeError(
            f"no {FEWEST} views have one poseId: put the photographs of each pose into a folder whose name begins with "
            "ps_, and run CameraInit again"
        )
    for pose, views in kept.items():
        if len({os.path.dirname(view["path"]) for view in views}) > 1:
            raise RuntimeError(f"pose {pose}: its photographs lie in several folders; put them into one")
    return kept


def build_command(node, scene, pose, views, out):
    """Return the words of `sdps infer` for one pose."""
    folder = os.path.dirname(views[0]["path"])
    words = [*split(node.command.value), "infer", folder, "--out", out, "--method", node.method.value]
    words += ["--normals", "alicevision"]
    for view in views:
        words += ["--images", os.path.basename(view["path"])]
    mask = find_mask(node.maskPath.value, pose, folder, {view["path"] for view in views})
    if mask:
        words += ["--mask", mask]
    words += choose_lights(node.pathToJSONLightFile.value, views, out + "_lights.json")
    if node.useIntrinsics.value:
        words += describe_camera(scene, views[0])
    more = split(node.arguments.value)
    if any(word.partition("=")[0] == "--scale" for word in more):
        raise RuntimeError("--scale: maps of another size would not fit SfMData's cameras; leave it out")
    return words + more


def split(text):
    """Split a line into words; backslashes are letters on Windows."""
    return [word.strip("\"'") if os.name == "nt" else word for word in shlex.split(text, posix=os.name != "nt")]


def find_mask(path, pose, folder, photographs):
    """Return the mask of a pose: by its id, by its folder's name without ps_, or the one named; '' for none."""
    if not path or os.path.isfile(path):
        return path
    name = os.path.basename(folder)
    for stem in (pose, name[3:] if name.startswith("ps_") else name, "mask"):
        found = os.path.join(path, stem + ".png")
        if os.path.isfile(found) and found not in photographs:
            return found
    raise RuntimeError(f"{path}: no mask of pose {pose}; name it {pose}.png, or leave the mask folder out")


def choose_lights(path, views, own):
    """Return the flags for a light file. Lights that are told apart by ids of views are written to `own` by name."""
    if not path:
        return []
    if os.path.isdir(path):
        directions, intensities = (os.path.join(path, f"light_{kind}.txt") for kind in ("directions", "intensities"))
        more = ["--intensities", intensities] if os.path.isfile(intensities) else []
        return ["--lights", directions, *more]
    if not path.lower().endswith(".json"):
        return ["--lights", path]
    try:
        with open(path, encoding="utf-8") as file:
            lights = json.load(file)["lights"]
        found = {str(light["viewId"]): light for light in lights}
    except (OSError, ValueError, KeyError, TypeError):
        return ["--lights", path]  # of another layout: sdps reads it, or says why it does not
    rows = []
    for view in views:
        name = os.path.basename(view["path"])
        if str(view["viewId"]) not in found:
            raise RuntimeError(f"{path}: no light of {name} (view {view['viewId']}); calibrate the lights again")
        light = found[str(view["viewId"])]
        x, y, z = [float(value) for value in light["direction"][:3]]  # of spherical harmonics the directional part
        intensity = [float(value) for value in light.get("intensity", [1, 1, 1])]
        rows.append({"file": name, "direction": [x, -y, -z], "intensity": intensity})
    save_scene({"frame": _OURS, "images": rows}, own)
    return ["--lights", own]


def describe_camera(scene, view):
    """Return --focal and --principal of a view's intrinsics, nothing where SfMData does not know them.

    AliceVision measures the principal point from the middle of the picture since 1.2.1, from its corner before, and the
    focal length in millimetres since 1.2.2.
    """
    known = {str(intrinsic["intrinsicId"]): intrinsic for intrinsic in scene.get("intrinsics", [])}
    intrinsic = known.get(str(view.get("intrinsicId")))
    if intrinsic is None:
        return []
    version = tuple(int(part) for part in scene.get("version", ["1", "2", "6"]))
    width, height = (float(intrinsic[key]) for key in ("width", "height"))
    if "pxFocalLength" in intrinsic:
        value = intrinsic["pxFocalLength"]
        focal = float(value[0] if isinstance(value, list) else value)
    else:
        focal = float(intrinsic.get("focalLength", -1)) / float(intrinsic.get("sensorWidth", 36)) * width
    if not focal > 0:
        return []
    column, row = (float(value) for value in intrinsic.get("principalPoint", ["0", "0"]))
    if version >= (1, 2, 1):
        column, row = column + width / 2, row + height / 2
    return ["--focal", f"{focal:.6g}px", "--principal", f"{column:.6g},{row:.6g}"]


def run(chunk, words):
    """Run a command, write what it says into the log, and raise RuntimeError where it fails."""
    import subprocess

    import psutil  # Meshroom has it, and stops a node's process through it

    # Meshroom's own modules must not reach the other Python.
    clean = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
    chunk.logger.info("%s", " ".join(map(shlex.quote, words)))
    try:
        process = psutil.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=clean, text=True,
                               encoding="utf-8", errors="replace")  # fmt: skip
    except OSError as error:
        raise RuntimeError(f"{words[0]}: cannot be started ({error}); name the command of sdps in the node") from error
    chunk.subprocess, said = process, []
    try:
        for line in process.stdout:
            said = [*said[-19:], line.rstrip()]
            chunk.logger.info("%s", said[-1])
        process.wait()
    finally:
        chunk.subprocess = None
    if process.returncode:
        raise RuntimeError("sdps infer failed:\n" + "\n".join(said))


def collect_maps(result, out, pose):
    """Copy the maps of a result to where the node's outputs say."""
    maps = os.path.join(result, "exports", "normals-alicevision")
    for source, target in (
        (os.path.join(maps, "normal.exr"), f"{pose}_normals.exr"),
        (os.path.join(maps, "normal.png"), f"{pose}_normals.png"),
        (os.path.join(result, "mask.png"), os.path.join("masks", f"{pose}.png")),
    ):
        shutil.copyfile(source, os.path.join(out, target))


def describe_maps(scene, poses, out, suffix):
    """Return SfMData of the maps: one view for each pose, with the cameras and poses of the scene."""
    views = []
    for pose, group in poses.items():
        view = next((view for view in group if str(view["viewId"]) == pose), group[0])
        views.append({**view, "path": os.path.join(out, f"{pose}_normals.{suffix}")})
    kept = {key: value for key, value in scene.items() if key in ("version", "intrinsics", "rigs")}
    return {**kept, "views": views, "poses": [pose for pose in scene.get("poses", []) if str(pose["poseId"]) in poses]}


def save_scene(content, path):
    """Write JSON to a temporary name, then rename it."""
    with open(path + ".part", "w", encoding="utf-8") as file:
        json.dump(content, file, indent=4)
    os.replace(path + ".part", path)


def _is_mask(name):
    """Tell a mask among photographs by its name."""
    return "mask" in os.path.splitext(name)[0].lower()
