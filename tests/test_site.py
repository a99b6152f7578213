"""The site in docs/: built strictly, read offline from the disk, on a desktop and on a phone."""

import importlib.util
import os
import re
import shlex
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import unquote, urlsplit

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
    done = build(ROOT / "mkdocs.yml", out)
    assert done.returncode == 0, done.stdout + done.stderr
    return out


def build(config, out):
    """What `make docs` and `make test` do."""
    make = ["make", "--dry-run", "docs", f"PY={sys.executable}"]
    said = subprocess.run(make, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    (line,) = [line for line in said.splitlines() if "mkdocs build" in line]
    command = [*shlex.split(line), "--config-file", config, "--site-dir", out]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    return subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )


def broken_links(site):
    """Each page with what it refers to, by link, picture, script or frame, that is not there."""
    pages = {p.resolve(): Page(p.read_text(encoding="utf-8")) for p in pages_of(site)}
    for page, found in pages.items():
        for reference in found.references:
            url = urlsplit(reference)
            if url.scheme or url.netloc:
                continue  # elsewhere, or in the page itself: the site is read offline
            path = (page.parent / unquote(url.path)).resolve() if url.path else page
            there = path.exists()
            if there and url.fragment and path in pages:
                there = unquote(url.fragment) in pages[path].places
            if not there:
                yield page.relative_to(site.resolve()).as_posix(), reference


class Page(HTMLParser):
    """What a page refers to, and the places in it that can be referred to."""

    def __init__(self, text):
        super().__init__()
        self.references, self.places = set(), {"", "__top"}
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        for name, value in attrs:
            if name in ("href", "src", "data", "poster"):
                self.references.add(value or "")
            elif name in ("id", "name"):
                self.places.add(value)


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


def test_every_link_of_the_site_leads_somewhere(site):
    assert list(broken_links(site)) == []


@pytest.mark.parametrize(
    "page", [*ROOT.glob("*.md"), *ROOT.glob("*/*/README.md")], ids=lambda p: p.parent.name + p.name
)
def test_links_of_pages_outside_the_site_lead_to_files(page):
    found = re.findall(r"\]\((?!https?:)([^)#\s]+)", page.read_text(encoding="utf-8"))
    assert [link for link in found if not (page.parent / link).exists()] == []


BROKEN = {  # by what mkdocs names
    "nowhere.md": "[page](nowhere.md)",
    "index.md#nowhere": "[place](index.md#nowhere)",
    "#nothing": "[place](#nothing)",
    "hqp_grasp.NoLaw": "[law][hqp_grasp.NoLaw]",
    "rad, m": "| a |\n|---|\n| [low, high] [rad, m] |",
    "nowhere.png": "![picture](nowhere.png)",
    "../README.md": "[outside](../README.md)",
}


def test_a_broken_link_fails_the_step_that_builds_the_docs(tmp_path):
    sound = build(small(tmp_path, "[here](#here)\n\n## Here"), tmp_path / "site")
    assert sound.returncode == 0, sound.stderr
    failed = build(small(tmp_path, "\n\n".join(BROKEN.values())), tmp_path / "site")
    assert failed.returncode != 0
    said = [line for line in failed.stderr.splitlines() if line.startswith("WARNING")]
    for name in BROKEN:
        assert sum(f"'{name}'" in line for line in said) == 1, failed.stderr
    assert len(said) == len(BROKEN)


def test_what_mkdocs_takes_as_it_stands_is_checked_in_the_site(tmp_path):
    page = '<a href="{}"><a href="#{}"><img src="{}"><a href="https://a.b/c">'
    (tmp_path / "index.html").write_text(page.format("index.html", "here", "index.html#here"))
    assert {found for _, found in broken_links(tmp_path)} == {"#here", "index.html#here"}
    (tmp_path / "index.html").write_text('<p id="here">' + page.format("no.html", "here", "no.png"))
    assert {found for _, found in broken_links(tmp_path)} == {"no.html", "no.png"}


def small(folder, text):
    """A site of one page, built as ours is; its mkdocs.yml."""
    ours = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    config = re.sub(r"(?ms)^(theme|extra|nav|hooks|extra_css|exclude_docs):.*?(?=^\w)", "", ours)
    config = config.replace("            extensions: [docs/reference.py]\n", "")
    (folder / "docs").mkdir(exist_ok=True)
    (folder / "docs/index.md").write_text(f"# Small\n\n{text}\n", encoding="utf-8")
    (folder / "mkdocs.yml").write_text(
        config + "theme: {name: material, font: false}\n", encoding="utf-8"
    )
    return folder / "mkdocs.yml"


def test_the_reference_has_all_that_is_exported(site):
    pages = [p.read_text(encoding="utf-8") for p in (site / "reference").glob("*.html")]
    found = [name for page in pages for name in re.findall(r'<h2 id="hqp_grasp\.(\w+)"', page)]
    assert sorted(found) == sorted(hg.__all__)


def test_the_reference_begins_with_a_line_for_each_name_that_is_exported(site):
    page = (site / "reference/index.html").read_text(encoding="utf-8")
    lines = dict(re.findall(r"<li><a [^>]*><code>(\w+)</code></a>: (\S.*?)</li>", page))
    assert sorted(lines) == sorted(hg.__all__)
    assert lines["Missed"] == "A probe that brought no grasp."
    assert lines["GRIP_LAWS"] != lines["Forces"] and len(set(lines.values())) == len(lines)


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
