"""A headless browser for the slow tests, and how to read what it shows."""

import io
import shutil
from contextlib import contextmanager

import matplotlib.pyplot as plt
import numpy as np
import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]  # no GPU needed
SIZE = {"width": 1280, "height": 720}
DRAWN = """() => {
  const canvas = document.querySelector('canvas');
  return canvas && getComputedStyle(canvas).opacity == '1' && document.querySelector('input');
}"""
# Frames, not seconds: a loaded machine draws few a second.
FRAMES = """count => new Promise(done => {
  const next = () => count-- > 0 ? requestAnimationFrame(next) : done();
  next();
})"""


@contextmanager
def page(offline=False):
    """A page, and lists that fill with its requests and with the errors of its console."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="no playwright: pip install 'hqp_grasp[browser]'"
    )
    if CHROMIUM is None:
        pytest.skip("no chromium on the path; Debian, Ubuntu: apt install chromium")
    with playwright.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        opened = browser.new_context(viewport=SIZE, offline=offline).new_page()
        requests, errors = [], []
        opened.on("request", lambda request: requests.append(request.url))
        opened.on("pageerror", lambda error: errors.append(str(error)))
        opened.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
        try:
            yield opened, requests, errors
        finally:
            browser.close()


def wait_until_drawn(opened):
    opened.wait_for_function(DRAWN, timeout=60_000)


def screenshot(opened):
    """What the page shows, (height, width, 3) of 0 … 255, once it stands still."""
    last = None
    for _ in range(40):
        opened.evaluate(FRAMES, 15)
        opened.wait_for_timeout(250)
        with io.BytesIO(opened.screenshot()) as png:
            now = (255 * plt.imread(png, format="png")[..., :3]).astype(int)
        if last is not None and np.array_equal(now, last):
            return now
        last = now
    raise AssertionError("the page never stands still")
