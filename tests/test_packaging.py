"""The Makefile runs what README and docs quote, and the wheel has all that the package needs."""

import re
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
# A benchmark, or a study that fixes its seed or its hand: it is quoted with its figures.
COMMAND = re.compile(
    r"(?<![\w/])(?:python (?=benchmarks/)|hqp-grasp (?=run .*?--(?:seed [1-9]|preset)))"
    r"(\w+[^`\n#]*)"
)


def words(command):
    """The command's words, but for where it writes."""
    return tuple(re.sub(r"--(out|plot) \S+|>.*", "", command).split())


QUOTED = {words(found) for page in PAGES for found in COMMAND.findall(page.read_text("utf-8"))}


@pytest.fixture(scope="module")
def run():
    """The commands of `make results`."""
    make = ["make", "--dry-run", "results", "PY=python", "HQP=hqp-grasp"]
    said = subprocess.run(make, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return {words(found) for found in COMMAND.findall(said)}


@pytest.mark.parametrize("command", sorted(c for c in QUOTED if "--help" not in c), ids=" ".join)
def test_what_a_page_quotes_is_run_by_make_results(run, command):
    if command[0] == "run":  # `make results` writes some defaults out
        assert any(set(command) <= set(line) for line in run)
    else:
        assert command in run


def test_every_folder_of_the_package_is_in_the_wheel():
    tool = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
        "setuptools"
    ]
    rooms = [p.parent.relative_to(ROOT) for p in ROOT.glob("hqp_grasp/**/__init__.py")]
    own = {".".join(room.parts) for room in rooms}
    assert set(tool["packages"]) == own | set(tool["package-dir"])
    assert len(tool["packages"]) == len(set(tool["packages"]))


def test_a_package_says_what_it_is_and_what_each_requirement_is_for():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for field in ("description", "readme", "license", "authors", "keywords", "classifiers"):
        assert project[field]
    assert len(project["description"]) < 512
    cff = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"version: {project['version']}\n" in cff and f"license: {project['license']}\n" in cff
    assert f"name: {project['authors'][0]['name']}\n" in cff
