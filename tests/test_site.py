"""The site in docs/: built strictly, read offline from the disk, on a desktop and on a phone."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import hqp_grasp as hg

pytest.importorskip("material", reason="no mkdocs-material: pip install 'hqp_grasp[docs]'")
import browser

ROOT = Path(__file__).parents[1]
PAGE = SimpleNamespace(file=SimpleNamespace(src_uri="page.md"))
PHONE = {"width": 390, "height": 800}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", out]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return out


@pytest.fixture
def mathematics():
    spec = importlib.util.spec_from_file_location("mathematics", ROOT / "docs/mathematics.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return lambda latex: module.on_page_content(
        rf'<span class="arithmatex">\({latex}\)</span>', page=PAGE
    )


def test_an_equation_becomes_mathml(mathematics):
    made = mathematics(r"\lVert x\rVert &lt; \dot q")
    assert made.startswith("<math") and "arithmatex" not in made
    assert (
        made.count('<mo stretchy="false" lspace="0" rspace="0">&#x02016;</mo>') == 2
        and "&#x0003C;" in made
    )
    assert '<mover accent="true"><mi>q</mi>' in made


def test_an_equation_that_cannot_be_set_names_its_page(mathematics):
    with pytest.raises(Exception, match=r"page\.md: no MathML for .*\\fraction"):
        mathematics(r"\fraction{1}{2}")


def test_no_equation_is_left_as_it_was_typed(site):
    pages = [page.read_text(encoding="utf-8") for page in site.glob("*.html")]
    assert not any('class="arithmatex"' in page for page in pages)
    assert sum(page.count("<math") for page in pages) > 100


def test_the_reference_has_all_that_is_exported(site):
    pages = [p.read_text(encoding="utf-8") for p in (site / "reference").glob("*.html")]
    found = [name for page in pages for name in re.findall(r'<h2 id="hqp_grasp\.(\w+)"', page)]
    assert sorted(found) == sorted(hg.__all__)


def test_the_reference_tells_shapes_and_units_that_stand_beside_fields(site):
    page = (site / "reference/grasp.html").read_text(encoding="utf-8")
    assert "<li><code>position</code>: (3,) [m], world</li>" in page
    assert "<li><code>NO_TOUCH</code>: a finger closed without touching</li>" in page


def pages_of(site):
    """All but the replay, and the page that only a server shows."""
    return sorted(p for p in site.rglob("*.html") if p.name not in ("replay.html", "404.html"))


@pytest.mark.browser
def test_no_page_is_wider_than_a_phone_or_asks_another_host(site):
    with browser.page(offline=True) as (opened, requests, errors):
        opened.set_viewport_size(PHONE)
        for page in pages_of(site):
            opened.goto(page.as_uri())
            wide = opened.evaluate("document.documentElement.scrollWidth")
            assert wide <= PHONE["width"], page
    assert not errors
    assert {url.split(":")[0] for url in requests} <= {"file", "data", "blob", "about"}


@pytest.mark.browser
def test_pages_are_light_and_dark_as_the_system_until_the_reader_chooses(site):
    shade = "getComputedStyle(document.body).backgroundColor.match(/\\d+/)[0] < 128"
    with browser.page(offline=True) as (opened, _, _):
        opened.goto((site / "laws.html").as_uri())
        for scheme, dark in (("dark", True), ("light", False), ("dark", True)):
            opened.emulate_media(color_scheme=scheme)
            opened.wait_for_function(f"({shade}) == {str(dark).lower()}")
            shown = opened.locator("img[src*=law-force]:visible").get_attribute("src")
            assert ("dark" in shown) == dark
        opened.locator("label[title*='switch to light']").click()
        opened.wait_for_function(f"!({shade})")


@pytest.mark.browser
def test_search_works_from_the_disk(site):
    with browser.page(offline=True) as (opened, _, errors):
        opened.goto((site / "index.html").as_uri())
        opened.fill("input.md-search__input", "certificate")
        opened.locator(".md-search-result__link[href*='solver.html']").first.wait_for()
    assert not errors


@pytest.mark.browser
def test_the_grasp_on_the_front_page_turns_and_leaves_the_wheel_to_the_page(site):
    with browser.page(offline=True) as (opened, requests, errors):
        opened.goto((site / "index.html").as_uri())
        inside = opened.frame_locator(".replay iframe")
        inside.locator("input").first.wait_for(timeout=60_000)
        opened.keyboard.press("Escape")
        box = opened.locator(".replay").bounding_box()
        x, y = box["x"] + 0.3 * box["width"], box["y"] + 0.4 * box["height"]
        opened.mouse.click(x, y)
        opened.keyboard.press("Space")  # the replay stands still
        before = browser.screenshot(opened)
        opened.mouse.down()
        opened.mouse.move(x + 120, y, steps=8)
        opened.mouse.up()
        after = browser.screenshot(opened)
        assert (np.abs(after - before).max(axis=-1) > 50).mean() > 0.02
        opened.mouse.wheel(0, 300)
        opened.wait_for_function("scrollY > 200")
    assert not errors
    assert {url.split(":")[0] for url in requests} <= {"file", "data", "blob", "about"}
