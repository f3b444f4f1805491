"""Take the pictures of docs/app.md: every room of `sdps app` in Chromium, and the viewer of a preview.html.

    pip install 'sdps[app,browser]'          # and Debian's chromium
    python -m lab.studies.app_pictures RUN docs/images

RUN is a folder with `data` (made by `render-data`, with its preview.html) and, for the curves, trained models.
"""

import argparse
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from playwright.sync_api import sync_playwright

_WIDTH, _HEIGHT, _PATIENCE = 1000, 760, 600_000  # pixels; milliseconds a step may take
_QUALITY = 85
_NARROW = 900  # pixels of the tall pictures


def main() -> int:
    """Take them all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port = found.getsockname()[1]
    command = [sys.executable, "-m", "pipelines.cli", "app", args.run.name, "--port", str(port), "--no-browser"]
    server = subprocess.Popen(command, cwd=args.run.resolve().parent)
    try:
        address = f"http://127.0.0.1:{port}"
        _wait(address)
        with sync_playwright() as started:
            browser = started.chromium.launch(
                executable_path=shutil.which("chromium"), args=["--no-sandbox", "--use-angle=swiftshader"]
            )
            page = browser.new_page(viewport={"width": _WIDTH, "height": _HEIGHT})
            page.set_default_timeout(_PATIENCE)
            for take in (_data, _preview, _studio, _photographs):
                take(page, args, address)
    finally:
        server.terminate()
        server.wait()
    return 0


def _wait(address: str) -> None:
    for _ in range(200):
        try:
            urllib.request.urlopen(address).close()
        except OSError:
            time.sleep(0.1)
        else:
            return
    raise SystemExit(f"{address}: no answer")


def _keep(png: bytes, path: Path, width: int = 0) -> None:
    """Write a picture, reduced to a width where one is named."""
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None  # the browser made it
    if width:
        height = round(picture.shape[0] * width / picture.shape[1])
        picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])


def _photographs(page: Any, args: argparse.Namespace, address: str) -> None:
    page.set_viewport_size({"width": 1280, "height": _HEIGHT})
    page.goto(f"{address}/photographs")
    page.click("#example")
    page.wait_for_selector("#findings li")
    page.wait_for_timeout(1000)
    _keep(page.locator("#main").screenshot(), args.out / "app_photographs.jpg", _NARROW)
    page.click("#start")
    page.locator("#mesh canvas").wait_for()
    page.locator("#relit-light input").first.fill("135")
    page.locator(".hover").focus()
    page.keyboard.press("ArrowDown")
    page.wait_for_timeout(3000)
    _keep(page.locator("#results").screenshot(), args.out / "app_results.jpg", _NARROW)


def _studio(page: Any, args: argparse.Namespace, address: str) -> None:
    page.goto(f"{address}/studio")
    page.locator("#gallery button").nth(35).wait_for()
    page.fill("#name", "gold-metallic-paint")
    page.click("#own button[type=submit]")
    page.locator("#rate", has_text="gold-metallic-paint").wait_for()
    page.locator("#status").wait_for(state="hidden")
    page.wait_for_timeout(1000)
    _keep(page.screenshot(), args.out / "app_studio.jpg")


def _data(page: Any, args: argparse.Namespace, address: str) -> None:
    page.goto(f"{address}/data")
    page.get_by_role("button", name="data: data").click()
    page.locator("#tiles .note", has_text="mean radiance").nth(8).wait_for()
    page.wait_for_timeout(1000)
    _keep(page.screenshot(), args.out / "app_data.jpg")
    page.locator("#tiles button").nth(3).click()
    page.locator("#lamp-card").wait_for()
    page.wait_for_timeout(3000)
    _keep(page.locator("#lamp-card").screenshot(), args.out / "app_scene.jpg")


def _preview(page: Any, args: argparse.Namespace, address: str) -> None:
    page.goto((args.run / "data" / "preview.html").resolve().as_uri())
    viewer = page.locator("#viewer")
    viewer.scroll_into_view_if_needed()
    page.wait_for_timeout(1000)
    _keep(viewer.screenshot(), args.out / "preview.jpg")


if __name__ == "__main__":
    sys.exit(main())
