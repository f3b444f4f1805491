"""Pages in Chromium, driven by Playwright: no console errors, nothing fetched from elsewhere, axe content."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

try:
    from axe_playwright_python.sync_playwright import Axe
    from playwright.sync_api import sync_playwright
except ImportError:
    Axe = sync_playwright = None

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
WIDTHS = {"desktop": (1280, 900), "phone": (390, 844)}


needs_browser = pytest.mark.skipif(
    Axe is None or CHROMIUM is None,
    reason="needs pip install sdps[browser]" if Axe is None else "no Chromium here: apt-get install chromium",
)


@contextmanager
def launched() -> Iterator[Any]:
    """Run Chromium without a screen."""
    with sync_playwright() as started:
        options = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        opened = started.chromium.launch(executable_path=CHROMIUM, args=options)
        yield opened
        opened.close()


@contextmanager
def watched(browser: Any, width: str, address: str, patience: int = 30_000) -> Iterator[Any]:
    """Open an empty page and judge at the end what was done with it.

    Args:
        browser: From `launched`.
        width: A name of `WIDTHS`.
        address: Beginning of the only addresses that may be asked.
        patience: Milliseconds any step may take.
    """
    across, down = WIDTHS[width]
    context = browser.new_context(viewport={"width": across, "height": down})
    opened, wrong = context.new_page(), []
    opened.set_default_timeout(patience)
    opened.on("console", lambda item: wrong.append(item.text) if item.type == "error" else None)
    opened.on("pageerror", lambda error: wrong.append(str(error)))
    opened.on(
        "request", lambda item: wrong.append(item.url) if not item.url.startswith((address, "blob:", "data:")) else None
    )
    yield opened
    assert opened.evaluate("document.documentElement.scrollWidth") <= across, "the page scrolls sideways"
    found = Axe().run(opened).response["violations"]
    assert not found, [(item["id"], [node["target"] for node in item["nodes"]][:4]) for item in found]
    context.close()
    assert not wrong
