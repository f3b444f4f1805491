"""The page "Photographs" over HTTP: limits, refusals, whose is what, and the way from files to a ZIP."""

import io
import json
import os
import struct
import time
import zipfile
import zlib
from pathlib import Path
from urllib.parse import quote

import cv2
import numpy as np
import OpenEXR
import photo_folders as folders
import pytest
from app_server import Client, serving
from ball_scenes import LIGHTS as BALL_LIGHTS
from ball_scenes import paint
from ball_scenes import write as write_balls
from PIL import Image
from sdps_scenes import hemisphere_lights

from pipelines.app.common import uploads
from render.shared.errors import InputError

LIGHTS = hemisphere_lights(12, np.random.default_rng(0))
LIMITS = {"files": 20, "bytes": 4_000_000, "pixels": 200_000}


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory):
    pytest.importorskip("starlette", reason="needs pip install sdps[app]")
    pytest.importorskip("uvicorn", reason="needs pip install sdps[app]")
    with serving(tmp_path_factory.mktemp("root"), **LIMITS) as place:
        yield place


@pytest.fixture(scope="module")
def hills(tmp_path_factory: pytest.TempPathFactory) -> Path:
    images, mask = folders.matte(LIGHTS, size=40)
    return folders.write_folder(tmp_path_factory.mktemp("hills"), images, mask, bits=8)


def message(answer: tuple[int, bytes], status: int = 400) -> str:
    assert answer[0] == status, answer
    return json.loads(answer[1])["message"]


def archive(**files: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as opened:
        for name, data in files.items():
            opened.writestr(name, data)
    return buffer.getvalue()


def test_an_ambient_picture_among_the_uploads_is_subtracted(address: str, hills: Path) -> None:
    client = Client(address)
    path = client.new_set(hills)
    dim = io.BytesIO()
    Image.fromarray(np.asarray(Image.open(hills / "1.png")) // 4).save(dim, "PNG")
    assert client.send("PUT", f"{path}/uploads/ambient.png", dim.getvalue())[0] == 200
    checked = client.wait(client.post(f"{path}/start/check"))
    assert len(checked["result"]["files"]) == len(LIGHTS)
    assert "ambient.png was subtracted, as an ambient picture" in checked["result"]["notes"]


def test_from_files_to_a_zip(address: str, hills: Path) -> None:
    client = Client(address)
    path = client.new_set(hills)
    checked = client.wait(client.post(f"{path}/start/check"))
    assert checked["state"] == "done", checked
    assert len(checked["result"]["files"]) == len(LIGHTS)
    assert checked["result"]["methods"][0]["name"] == "auto"
    job = client.wait(client.post(f"{path}/start/infer", {"method": "factorisation"}))
    assert job["state"] == "done", job
    view = job["result"]
    basis = client.get(f"{path}/files/runs/1/view/basis.bin")
    assert len(basis) == view["width"] * view["height"] * 14
    pixel = json.loads(client.get(f"{path}/runs/1/pixel?row=36&column=36"))
    assert len(pixel["observed"]) == len(pixel["model"]) == len(LIGHTS)
    assert message(client.send("GET", f"{path}/runs/1/pixel?row=9999&column=0"))
    with zipfile.ZipFile(io.BytesIO(client.get(f"{path}/runs/1/download"))) as opened:
        assert {"normal.npy", "mesh.ply", "report.html", "result.json", "relit/grazing.png"} <= set(opened.namelist())


def test_a_film_is_taken_apart(address: str, tmp_path: Path) -> None:
    """Alone or in a ZIP, with its mask; what is no film is refused by the checks."""
    images, mask = folders.matte(LIGHTS, size=40)
    writer = cv2.VideoWriter(str(tmp_path / "lamp.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 25, mask.shape[::-1])
    for image in images:
        writer.write(np.rint(255 * folders.to_srgb(image[..., ::-1])).astype(np.uint8))
    writer.release()
    film, outline = (tmp_path / "lamp.avi").read_bytes(), io.BytesIO()
    Image.fromarray(mask).save(outline, "png")
    for name, data in (
        ("lamp.AVI", film),
        ("all.zip", archive(**{"a/lamp.avi": film, "a/mask.png": outline.getvalue()})),
    ):
        client = Client(address)
        path = client.new_set()
        assert client.send("PUT", f"{path}/uploads/{name}", data)[0] == 200
        checked = client.wait(client.post(f"{path}/start/check"))
        assert checked["state"] == "done", checked
        assert checked["result"]["files"] == [f"frame-{number:04d}.png" for number in range(len(LIGHTS))]
        assert checked["result"]["mask"] == ("file" if name == "all.zip" else "automatic")
        job = client.wait(client.post(f"{path}/start/infer", {"method": "factorisation"}))
        assert job["state"] == "done", job
    path = client.new_set()
    assert client.send("PUT", f"{path}/uploads/lamp.mp4", b"nothing")[0] == 200
    job = client.wait(client.post(f"{path}/start/check"))
    assert job["state"] == "failed" and job["message"].startswith("lamp.mp4: damaged or not a film")


def test_poses_are_told_apart(address: str, hills: Path) -> None:
    """As a folder and as a ZIP; a pose is looked at, and inferred, by its name."""
    files = {
        f"ps_{pose}/{path.name}": path.read_bytes() for pose in ("left", "right") for path in hills.glob("[1-4].png")
    }
    masks = {f"{pose}.png": (hills / "mask.png").read_bytes() for pose in ("left", "right")}
    for zipped in (False, True):
        client = Client(address)
        path = client.new_set()
        sent = (
            {"all.zip": archive(**files, **masks)} if zipped else {f"toy/{name}": data for name, data in files.items()}
        )
        for name, data in sent.items():
            assert client.send("PUT", f"{path}/uploads/{quote(name, safe='')}", data)[0] == 200
        checked = client.wait(client.post(f"{path}/start/check", {"pose": "right"}))["result"]
        assert (checked["poses"], checked["pose"]) == (["left", "right"], "right")
        assert checked["mask"] == ("file" if zipped else "automatic")
        assert len(checked["files"]) == 4
    shown = client.wait(client.post(f"{path}/start/infer", {"method": "factorisation", "pose": "left"}))["result"]
    assert shown["pose"] == "left"
    job = client.wait(client.post(f"{path}/start/check", {"pose": "lift"}))
    assert job["state"] == "failed" and "did you mean 'left'" in job["message"]
    path, picture = client.new_set(), (hills / "1.png").read_bytes()
    there = (("ps_a.png", 200), ("ps_a.png/1.png", 400), ("ps_b.png/1.png", 200), ("ps_b.png", 400))  # a file, a folder
    for name, expected in (*there, ("ps_b.png/1.png", 400)):
        status, said = client.send("PUT", f"{path}/uploads/{quote(name, safe='')}", picture)
        assert status == expected and ("two files of this name" in said.decode()) == (status == 400), name


def test_what_will_happen_is_said_before_it_starts(address: str, hills: Path) -> None:
    client = Client(address)
    path = client.new_set(hills)

    def check(**asked: object) -> dict:
        return client.wait(client.post(f"{path}/start/check", asked))["result"]

    said = dict(check(method="factorisation", pixel_size="0.5", scale="0.5")["work"])
    assert "pictures of 36x36: about" in said["time"] and "GiB of memory" in said["time"]
    assert said["size"].startswith("1 mm a pixel") and said["results"].endswith("report.html into the ZIP")
    assert said["files"].startswith("1.png to 12.png") and said["object"] and said["curve"] and said["camera"]
    refused = check(method="least-squares")
    assert refused["work"] == [] and "needs the lights" in refused["trouble"] and "--" not in refused["trouble"]
    film = client.wait(client.post(f"{path}/start/check", {"every": 2}))
    assert film["state"] == "failed" and film["message"].startswith('"Every so many frames" 2: ')


def test_a_focal_length_is_used(address: str, hills: Path) -> None:
    client = Client(address)
    path = client.new_set(hills)

    def infer(focal: object) -> dict:
        return client.wait(client.post(f"{path}/start/infer", {"method": "factorisation", "focal": focal}))

    assert infer("50")["result"]["camera"] == "perspective, focal length 118 px, as given"  # of 72 x 72 pixels
    assert infer("")["result"]["camera"] == "taken for far away: no focal length is known"
    assert infer("400px")["result"]["camera"] == "perspective, focal length 400 px, as given"
    for focal, said in (
        ("0mm", '"Focal length" 0mm: must be above 0'),
        (-3, "must be above 0"),
        ("wide", 'unknown "Focal length"'),
    ):
        job = infer(focal)
        assert job["state"] == "failed" and said in job["message"]


def test_a_distance_of_the_lamps_is_used(address: str, hills: Path) -> None:
    client = Client(address)
    path = client.new_set(hills)

    def infer(**more: object) -> dict:
        return client.wait(client.post(f"{path}/start/infer", {"method": "factorisation", **more}))

    assert infer()["result"]["lamps"] == "the lamps were taken for far away"
    assert infer(light_distance="far")["result"]["lamps"] == "the lamps stood far away, as given"
    found = infer(light_distance=4)["result"]
    assert found["lamps"] == "the lamps stood about 4 object sizes away, as given"
    assert found["distances"] == [4.0] * len(found["files"])
    job = infer(light_distance="near")
    assert job["state"] == "failed" and "How far away the lamps stood" in job["message"]


def test_balls_are_found_and_used(address: str, tmp_path: Path) -> None:
    balls = [(85.0, 45.0, 28.0), (85.0, -45.0, 30.0)]
    client = Client(address)
    path = client.new_set(write_balls(tmp_path, [paint(lamp, 1.0, chrome=balls) for lamp in BALL_LIGHTS]))
    found = client.wait(client.post(f"{path}/start/check", {"balls": ["auto"]}))["result"]
    assert found["lit"] and [ball["kind"] for ball in found["balls"]] == ["chrome", "chrome"]
    assert all(len(ball["highlights"]) == len(BALL_LIGHTS) for ball in found["balls"])
    named = [f"{ball['x']},{ball['y']},{ball['radius']}" for ball in found["balls"]]
    job = client.wait(client.post(f"{path}/start/infer", {"method": "least-squares", "balls": named[:1]}))
    assert np.abs(np.array(job["result"]["lights"]) - BALL_LIGHTS).max() < 0.03
    job = client.wait(client.post(f"{path}/start/check", {"balls": ["60,60,20"]}))
    assert job["state"] == "failed" and "shows no light" in job["message"]
    for bad in (["/etc"], ["/etc:1,2,9"], "auto", ["auto"] * 9, [{}]):
        assert "balls: must be" in message(
            client.send("POST", f"{path}/start/check", json.dumps({"balls": bad}).encode())
        )


def test_a_ball_in_pictures_of_its_own(address: str, hills: Path, tmp_path: Path) -> None:
    client = Client(address)
    path = client.new_set(hills)
    for number, lamp in enumerate(LIGHTS, start=1):
        write_balls(tmp_path, [paint(lamp, 1.0)])  # whose object is a white ball
        (picture,) = tmp_path.glob("*.png")
        assert client.send("PUT", f"{path}/ball/1/{number}.png", picture.read_bytes())[0] == 200
    found = client.wait(client.post(f"{path}/start/check", {"ball_alone": 1}))["result"]
    assert found["lit"] and found["balls"] == [] and found["ball_alone"] == "white"
    assert len(found["files"]) == len(LIGHTS)
    job = client.wait(client.post(f"{path}/start/infer", {"method": "least-squares", "ball_alone": 1}))
    assert np.abs(np.array(job["result"]["lights"]) - LIGHTS).max() < 0.05
    job = client.wait(client.post(f"{path}/start/check", {"ball_alone": 2}))
    assert job["state"] == "failed" and "no such folder" in job["message"]


def test_a_flat_thing_at_a_size_that_fits(address: str, hills: Path) -> None:
    client = Client(address)
    path = client.new_set(hills)
    asked = {"method": "factorisation", "flat": "turned", "scale": "auto"}
    job = client.wait(client.post(f"{path}/start/infer", asked))
    assert job["state"] == "done"
    said = job["result"]["findings"][-1]["text"]
    assert 'hollow, use "Is it flat?": yes; if it is not flat, "Is it flat?": no' in said
    with zipfile.ZipFile(io.BytesIO(client.get(f"{path}/runs/1/download"))) as opened:
        facts = json.loads(opened.read("result.json"))
    assert facts["flat"]["tilt_degrees"] > 0.0 and facts["scale"] == 1.0
    status, said = client.send("POST", f"{path}/start/infer", json.dumps({"flat": "round"}).encode())
    assert status == 400 and "flat: must be one of auto, yes" in json.loads(said)["message"]


def test_a_painted_mask_is_used(address: str, hills: Path) -> None:
    client = Client(address)
    path = client.new_set(hills)
    with Image.open(hills / "mask.png") as image:
        mask = np.zeros(image.size[::-1], np.uint8)
    mask[30:42, 30:42] = 255
    buffer = io.BytesIO()
    Image.fromarray(mask).save(buffer, "png")
    assert client.send("PUT", f"{path}/mask", buffer.getvalue())[0] == 200
    result = client.wait(client.post(f"{path}/start/check"))["result"]
    assert (result["mask"], result["pixels"]) == ("painted", 144)
    assert client.send("PUT", f"{path}/mask", b"")[0] == 200
    assert client.wait(client.post(f"{path}/start/check"))["result"]["mask"] == "file"


def test_bad_photographs_end_in_the_line_of_the_command(address: str, hills: Path) -> None:
    client = Client(address)
    path = client.new_set()
    client.send("PUT", f"{path}/uploads/a.png", (hills / "1.png").read_bytes())
    job = client.wait(client.post(f"{path}/start/check"))
    assert job["state"] == "failed"
    assert "only one picture, a.png" in job["message"]
    assert "/tmp" not in job["message"] and "\n" not in job["message"]


def test_lights_of_other_programs_are_used(address: str, hills: Path) -> None:
    client = Client(address)
    names = sorted((path.name for path in hills.glob("[0-9]*.png")), key=lambda name: int(name[:-4]))
    rows = "".join("C:\\rti\\{} {} {} {}\n".format(name, *row) for name, row in zip(names, LIGHTS, strict=True))
    buffer = io.BytesIO()
    np.save(buffer, LIGHTS.T)
    for name, data in (("object.lp", rows.encode()), ("lights.npy", buffer.getvalue())):
        path = client.new_set(hills)
        assert client.send("PUT", f"{path}/uploads/{name}", data)[0] == 200
        checked = client.wait(client.post(f"{path}/start/check", {"lights": True}))["result"]
        assert checked["lights_there"] and checked["lit"]
        assert f"lights are those of {name}, axes y-up" in checked["notes"]


def test_uploads_are_limited(address: str, hills: Path) -> None:
    client = Client(address)
    path = client.new_set()
    small = (hills / "1.png").read_bytes()
    assert "cannot be used here" in message(client.send("PUT", f"{path}/uploads/a.exe", small))
    assert "cannot be read as a picture" in message(client.send("PUT", f"{path}/uploads/a.png", b"nothing"))
    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)  # a small file of 3.6 billion pixels
    chunk = b"IHDR" + header
    bomb = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    assert "a.png" in message(client.send("PUT", f"{path}/uploads/a.png", bomb))
    assert "too large" in message(client.send("PUT", f"{path}/uploads/a.txt", bytes(LIMITS["bytes"] + 1)))
    for number in range(LIMITS["files"]):
        assert client.send("PUT", f"{path}/uploads/{number}.png", small)[0] == 200
    assert "more than 20 files" in message(client.send("PUT", f"{path}/uploads/more.png", small))


@pytest.mark.parametrize(
    "body", [b"{", b"[1]", b"\xff", b"[" * 30_000, b'{"gamma": "\\ud800"}', b'{"a": "%s"}' % bytes(70_000)]
)
def test_settings_that_are_none_end_in_one_line(body: bytes, address: str) -> None:
    client = Client(address)
    said = message(client.send("POST", f"{client.new_set()}/start/check", body))
    assert said.startswith("the request: ") and "\n" not in said
    assert message(client.send("POST", "/studio/start/preset", body)) == said


def test_a_damaged_mask_or_archive_ends_in_one_line(address: str, hills: Path) -> None:
    client = Client(address)
    path, mask = client.new_set(hills), (hills / "mask.png").read_bytes()
    assert "damaged" in message(client.send("PUT", f"{path}/mask", mask[:-40]))
    jpeg = io.BytesIO()
    Image.new("L", (8, 8)).save(jpeg, "jpeg")
    assert "not a PNG" in message(client.send("PUT", f"{path}/mask", jpeg.getvalue()))
    packed = archive(**{"a.png": mask * 3})
    at = packed.index(b"PK\1\2")
    moved = packed[: at + 42] + b"\xff\xff\xff\xff" + packed[at + 46 :]  # where it says the file begins
    torn = packed[:60] + bytes(20) + packed[80:]
    for data in (moved, torn):
        assert "cannot be unpacked" in message(client.send("PUT", f"{client.new_set()}/uploads/a.zip", data))


def test_the_header_of_an_exr_is_read_without_its_library(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    folders.write(path, np.zeros((40, 50, 3)))
    assert uploads._read_size(path) == (50, 40)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(InputError, match=r"a\.exr: cannot be read as a picture"):
        uploads.check_pixels(path, uploads.Limits())


def test_uploads_are_what_their_bytes_say(tmp_path: Path) -> None:
    picture, limits = np.zeros((40, 50, 3), np.uint8), uploads.Limits(pixels=1000)
    kinds = {
        "PNG": ".png",
        "JPEG": ".jpg",
        "BMP": ".bmp",
        "PPM": ".ppm",
        "TGA": ".tga",
        "WEBP": ".webp",
        "TIFF": ".tif",
    }
    for kind, suffix in kinds.items():
        for name in {f"a{suffix}", "a.png" if kind != "TGA" else "a.tga", "a.jpg" if kind != "TGA" else "a.tga"}:
            path = tmp_path / uploads.clean_name(name)
            Image.fromarray(picture).save(path, kind)
            assert uploads._read_size(path) == (50, 40)
            with pytest.raises(InputError, match="is 50x40 pixels"):
                uploads.check_pixels(path, limits)
    folders.write(tmp_path / "a.exr", picture / 1.0)
    (tmp_path / "a.exr").rename(tmp_path / "b.png")
    assert uploads._read_size(tmp_path / "b.png") == (50, 40)


def test_all_windows_of_an_exr_count(tmp_path: Path) -> None:
    small, large = np.zeros((4, 5), np.float32), np.zeros((40, 50), np.float32)
    header = {"displayWindow": (np.array([0, 0], np.int32), np.array([4, 3], np.int32))}
    parts = [OpenEXR.Part(dict(header), {"Y": small}, "a"), OpenEXR.Part(dict(header), {"Y": large}, "b")]
    OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    assert uploads._read_size(tmp_path / "a.exr") == (50, 40)
    window = (np.array([0, 0], np.int32), np.array([999, 799], np.int32))
    OpenEXR.File({"displayWindow": window}, {"Y": small}).write(str(tmp_path / "b.exr"))
    assert uploads._read_size(tmp_path / "b.exr") == (1000, 800)


def test_archives_do_not_explode(address: str, hills: Path) -> None:
    client = Client(address)
    path, small = client.new_set(), (hills / "1.png").read_bytes()
    bomb = archive(**{"a.png": bytes(50_000_000)})
    assert len(bomb) < 100_000
    assert "too large unpacked" in message(client.send("PUT", f"{path}/uploads/bomb.zip", bomb))
    many = archive(**{f"{number}.png": small for number in range(30)})
    assert "more than 20 files" in message(client.send("PUT", f"{client.new_set()}/uploads/many.zip", many))
    assert "cannot be unpacked" in message(client.send("PUT", f"{client.new_set()}/uploads/no.zip", b"PK no"))


def test_what_is_one_visitors_is_nobody_elses(address: str, hills: Path) -> None:
    one, other = Client(address), Client(address)
    path = one.new_set(hills)
    job = one.post(f"{path}/start/check")
    assert other.send("GET", f"/jobs/{job['id']}")[0] == 404
    assert other.send("POST", f"/jobs/{job['id']}/cancel")[0] == 404
    assert other.send("GET", f"{path}/files/photos/1.png")[0] == 400
    assert one.send("GET", f"{path}/files/photos/1.png")[0] == 200
    for outside in ("%2e%2e/", "..%2f", "photos/..%2f..%2f", "%2fetc/passwd"):
        assert one.send("GET", f"{path}/files/{outside}")[0] in (400, 404)
    one.wait(job)


def test_foreign_pages_and_names_are_refused(address: str) -> None:
    client = Client(address)
    client.origin = "http://elsewhere.example"
    assert "must come from the app" in message(client.send("POST", "/photographs/sets"), 403)
    assert message(client.send("GET", "/photographs", Host="elsewhere.example"), 403)
    client.origin = address
    assert client.post("/photographs/sets")


def test_cancel_ends_a_job_and_the_next_one_runs(address: str, hills: Path) -> None:
    client = Client(address)
    path = client.new_set(hills)
    job = client.post(f"{path}/start/infer", {"method": "sdps-plus"})
    waiting = client.post(f"{path}/start/infer", {"method": "sdps-plus"})
    while json.loads(client.get(f"/jobs/{job['id']}"))["state"] == "queued":
        time.sleep(0.02)
    assert client.post(f"/jobs/{waiting['id']}/cancel")["state"] == "cancelled"
    assert client.post(f"/jobs/{job['id']}/cancel")["state"] == "cancelled"
    assert client.wait(client.post(f"{path}/start/check"))["state"] == "done"


def test_names_are_escaped(address: str) -> None:
    status, page = Client(address).send("GET", "/%3Cscript%3E")
    assert status == 404 and b"<script>" not in page


def test_sessions_end(tmp_path: Path) -> None:
    from pipelines.app.common.sessions import Sessions

    sessions = Sessions()
    first, second = sessions.create(), sessions.create()
    second.used = first.used + 1
    assert sessions.expire(idle=1e9, most=1) == [first.token]
    assert not first.folder.exists() and second.folder.exists() and sessions.find(first.token) is None
    sessions.close()
    assert not sessions.folder.exists() and os.path.isdir(sessions.folder.parent)
