"""Code shown in the docs runs, and prints what the docs say it prints."""

import contextlib
import io
import re
from pathlib import Path

import pytest

from hqp_grasp.experiments.record import COLUMNS, CONTACT_COLUMNS, LAW_COLUMNS, TRIAL_COLUMNS
from hqp_grasp.experiments.study import STUDY_COLUMNS

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
# A block of Python, and the block of text that stands right below it where there is one.
BLOCK = re.compile(r"^```python\n(.*?)^```\n(?:\n```text\n(.*?)^```)?", re.DOTALL | re.MULTILINE)
EXAMPLES = {page.name: BLOCK.findall(page.read_text(encoding="utf-8")) for page in PAGES}
SHOWN_ON = [
    "CONTRIBUTING.md",
    "README.md",
    "index.md",
    "looking.md",
    "mink.md",
    "objects.md",
    "only-solver.md",
    "own-hand.md",
    "own-law.md",
    "quickstart.md",
    "real-hand.md",
    "solver.md",
]


def test_the_pages_that_show_code_are_all_found():
    assert sorted(page for page, blocks in EXAMPLES.items() if blocks) == SHOWN_ON


@pytest.mark.parametrize("page", SHOWN_ON)
def test_examples_run_and_print_what_the_page_shows(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if page == "looking.md":
        pytest.importorskip("viser", reason="the page is about the extra hqp_grasp[view]")
    names = {"__name__": "__main__"}  # a page's later blocks go on from its earlier ones
    for code, shown in EXAMPLES[page]:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(code, page, "exec"), names)
        if shown:
            assert printed.getvalue() == shown


def test_the_quickstart_lists_every_column_of_the_results_in_their_order():
    page = (ROOT / "docs" / "quickstart.md").read_text(encoding="utf-8")
    (table,) = re.findall(r"^\| column \|.*?(?=\n\n)", page, re.DOTALL | re.MULTILINE)
    listed = [
        name for row in table.splitlines() for name in re.findall(r"`(\S+)`", row.split("|")[1])
    ]
    assert listed == [
        *STUDY_COLUMNS,
        "probe",
        *TRIAL_COLUMNS,
        *COLUMNS,
        *(f"{name}_{{law}}" for name in LAW_COLUMNS),
        *(f"contact_{{i}}_{name}" for name in CONTACT_COLUMNS),
        "q_{joint}",
    ]
