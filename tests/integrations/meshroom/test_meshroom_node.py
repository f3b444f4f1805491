"""The node for Meshroom, run with a stand-in for Meshroom's own modules, with a pretended `sdps` and the real one."""

import importlib.util
import json
import shlex
import sys
from pathlib import Path
from types import ModuleType

import cv2
import meshroom_desc
import numpy as np
import photo_folders as folders
import pytest

ROOT = Path(__file__).resolve().parents[3]
FILE = ROOT / "integrations" / "meshroom" / "meshroom" / "sdpsNodes" / "SdpsPhotometricStereo.py"
PRETENDED = """
import json, sys
from pathlib import Path
out = Path(sys.argv[sys.argv.index("--out") + 1])
maps = out / "exports" / "normals-alicevision"
maps.mkdir(parents=True)
for path in (maps / "normal.exr", maps / "normal.png", out / "mask.png"):
    path.write_text(path.name)
(out / "said.json").write_text(json.dumps(sys.argv[1:]))
if "fails" in sys.argv:
    sys.exit("sdps: a.png: no such picture")
"""
LIGHTS = {"lights": [{"viewId": str(view), "type": "directional", "direction": [0.0, -0.1 * view, -1.0],
                      "intensity": [1.0, 2.0, 3.0]} for view in range(1, 5)]}  # fmt: skip


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    meshroom_desc.install(monkeypatch)
    spec = importlib.util.spec_from_file_location("SdpsPhotometricStereo", FILE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def pretended(tmp_path: Path) -> str:
    (tmp_path / "sdps.py").write_text(PRETENDED)
    return shlex.join([sys.executable, str(tmp_path / "sdps.py")])


def write_scene(path: Path, folder: Path, names: list[str], version: tuple[int, ...] = (1, 2, 6)) -> str:
    """Write SfMData of one pose, 2, and of a photograph that is alone in its pose."""
    views = [{"viewId": str(number), "poseId": "2", "intrinsicId": "9", "path": str(folder / name), "width": "60",
              "height": "40"} for number, name in enumerate(names, start=1)]  # fmt: skip
    alone = {**views[0], "viewId": "77", "poseId": "77"}
    intrinsic = {"intrinsicId": "9", "width": "60", "height": "40", "type": "pinhole"}
    if version >= (1, 2, 2):
        intrinsic |= {"sensorWidth": "36", "focalLength": "90", "principalPoint": ["-0.5", "1.5"]}
    else:
        intrinsic |= {"pxFocalLength": "150", "principalPoint": ["29.5", "21.5"]}
    poses = [{"poseId": pose, "pose": {"transform": {"rotation": ["1"], "center": ["0"]}}} for pose in ("2", "77")]
    scene = {"version": list(map(str, version)), "views": [*views, alone], "intrinsics": [intrinsic], "poses": poses}
    path.write_text(json.dumps(scene))
    return str(path)


def test_the_description_is_what_meshroom_takes(node: ModuleType) -> None:
    description = node.SdpsPhotometricStereo
    assert issubclass(description, meshroom_desc.Node) and description.documentation and description.category
    attributes = [*description.inputs, *description.outputs]
    assert [attribute.checkValueTypes() for attribute in attributes] == [""] * len(attributes)
    names = [attribute.name for attribute in attributes]
    assert len(set(names)) == len(names) and all(attribute.label for attribute in attributes)
    assert {"inputPath", "maskPath", "pathToJSONLightFile", "outputSfmDataNormal"} <= set(names)  # as AliceVision's
    assert (FILE.parent / "__init__.py").is_file()


@pytest.mark.parametrize("version", [(1, 2, 6), (1, 0, 0)])
def test_a_pose_becomes_a_run_and_its_maps_sfmdata(
    node: ModuleType, pretended: str, tmp_path: Path, version: tuple[int, ...]
) -> None:
    names = ["b 2.png", "a[1].png", "ambient.png", "c.png"]
    scene = write_scene(tmp_path / "cameraInit.sfm", tmp_path / "ps_vase", names, version)
    (tmp_path / "lights.json").write_text(json.dumps(LIGHTS))
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "vase.png").touch()
    chunk = meshroom_desc.make_chunk(
        node.SdpsPhotometricStereo, tmp_path / "cache", inputPath=scene, command=pretended,
        maskPath=str(tmp_path / "masks"), pathToJSONLightFile=str(tmp_path / "lights.json"), arguments="--no-refine",
    )  # fmt: skip
    node.SdpsPhotometricStereo().processChunk(chunk)
    out = tmp_path / "cache"
    words = json.loads((out / "2" / "said.json").read_text())
    assert words[:2] == ["infer", str(tmp_path / "ps_vase")] and words[-1] == "--no-refine"
    told = {flag: words[place + 1] for place, flag in enumerate(words) if flag.startswith("--") and flag != words[-1]}
    used = ["a[1].png", "b 2.png", "c.png"]  # in the order of their paths, without the ambient one
    assert [words[place + 1] for place, flag in enumerate(words) if flag == "--images"] == used
    assert (told["--focal"], told["--principal"]) == ("150px", "29.5,21.5") and told["--mask"].endswith("vase.png")
    lights = json.loads(Path(told["--lights"]).read_text())["images"]
    assert [light["file"] for light in lights] == used
    assert lights[0]["direction"] == [0.0, 0.2, 1.0] and lights[2]["direction"] == pytest.approx([0.0, 0.4, 1.0])
    written = json.loads((out / "normalMaps.sfm").read_text())
    (view,), (pose,) = written["views"], written["poses"]
    assert view["viewId"] == view["poseId"] == pose["poseId"] == "2" and written["intrinsics"][0]["intrinsicId"] == "9"
    assert Path(view["path"]).read_text() == "normal.exr" and (out / "masks" / "2.png").is_file()
    assert json.loads((out / "normalMapsPNG.sfm").read_text())["views"][0]["path"].endswith("2_normals.png")
    assert not (out / "77").exists() and chunk.subprocess is None


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"inputPath": "scene.abc"}, "name a .sfm or .json file"),
        ({"inputPath": "few.sfm"}, "begins with ps_"),
        ({"arguments": "--scale 0.5"}, "leave it out"),
        ({"arguments": "fails"}, "no such picture"),
        ({"command": "no-such-command"}, "cannot be started"),
        ({"maskPath": "."}, "no mask of pose 2"),
    ],
)
def test_what_fails_is_told(
    node: ModuleType, pretended: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, values: dict[str, str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path / "few.sfm", tmp_path, ["a.png", "b.png"])
    scene = write_scene(tmp_path / "scene.sfm", tmp_path, ["a.png", "b.png", "c.png"])
    chunk = meshroom_desc.make_chunk(
        node.SdpsPhotometricStereo, tmp_path / "cache", **({"inputPath": scene, "command": pretended} | values)
    )
    with pytest.raises(RuntimeError, match=said):
        node.SdpsPhotometricStereo().processChunk(chunk)


@pytest.mark.slow
def test_the_real_command_finds_normals(node: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ring = np.arange(8) * np.pi / 4
    lights = np.stack([0.6 * np.cos(ring), 0.6 * np.sin(ring), np.full(8, 0.8)], axis=-1)
    images, mask = folders.matte(lights, size=40)
    folders.write_folder(tmp_path / "ps_hills", images, mask)
    monkeypatch.chdir(ROOT)
    chunk = meshroom_desc.make_chunk(
        node.SdpsPhotometricStereo, tmp_path / "cache", inputPath=str(tmp_path / "ps_hills"), method="pf14",
        command=shlex.join([sys.executable, "-m", "pipelines.cli"]), maskPath=str(tmp_path / "ps_hills"),
    )  # fmt: skip
    node.SdpsPhotometricStereo().processChunk(chunk)
    (view,) = json.loads((tmp_path / "cache" / "normalMapsPNG.sfm").read_text())["views"]
    coded = cv2.imread(view["path"], cv2.IMREAD_UNCHANGED)
    assert coded.dtype == np.uint16 and coded.shape == (*mask.shape, 3) and (coded[mask][:, 0] > 32768).mean() > 0.99
