"""The Makefile runs what README and docs quote."""

import re
import subprocess
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
