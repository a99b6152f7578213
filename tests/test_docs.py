"""Code shown in the docs runs, and prints what the docs say it prints."""

import contextlib
import io
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from hqp_grasp.experiments.record import COLUMNS, CONTACT_COLUMNS, LAW_COLUMNS, TRIAL_COLUMNS
from hqp_grasp.experiments.study import STUDY_COLUMNS

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
# A fenced block, the name of the file where it is one, and the block of text right below it.
BLOCK = re.compile(
    r"^```(python|sh|text)(?: title=\"(.+?)\")?\n(.*?)^```\n(?:\n```text\n(.*?)^```)?",
    re.DOTALL | re.MULTILINE,
)
BLOCKS = {page.name: BLOCK.findall(page.read_text(encoding="utf-8")) for page in PAGES}
PYTHON_ON = [
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
COMMANDS_ON = ["looking.md", "objects.md", "quickstart.md", "real-hand.md", "results.md"]
SMALL = ["--probes", "2", "--jobs", "1"]  # in the place of what the page says, and so few trials
ELSEWHERE = ("benchmarks/", "pytest", "ruff")  # what `make results`, `make test` run


def commands(script):
    """The command lines of a block, in words; comments are left out."""
    lines = (shlex.split(line, comments=True) for line in script.splitlines())
    return [words for words in lines if words]


def calls(page):
    """The page's calls of hqp_grasp and of scenarios, each by its arguments after `python`."""
    found = [w for kind, _, code, _ in BLOCKS[page] if kind == "sh" for w in commands(code)]
    python = [w[1:] for w in found if w[0] in ("python", ".venv/bin/python")]
    return [w for w in python if not any(part in " ".join(w[:2]) for part in ELSEWHERE)]


def call(arguments, monkeypatch):
    """Do in this process what `python ARGUMENTS` does, with few and short trials."""
    if arguments[0] == "-m":
        module, arguments = arguments[1], arguments[2:]
    else:
        module = "hqp_grasp." + arguments[0].removesuffix(".py").replace("/", ".")
        arguments = arguments[1:]
    if module != "hqp_grasp" or arguments[0] == "run":
        trials = "8" if "--replay" in arguments else "2"
        arguments = [*arguments, *SMALL, "--trials", trials]
    elif arguments[0] == "view":
        arguments = [*arguments, "--port", "0"]
    monkeypatch.setattr(sys, "argv", [module, *arguments])
    for name in [name for name in sys.modules if name.startswith("hqp_grasp.scenarios.")]:
        monkeypatch.delitem(sys.modules, name)  # a command starts afresh
    runpy.run_module(module, run_name="__main__")


def interrupted(viewer):
    raise KeyboardInterrupt


def test_the_pages_that_show_code_are_all_found():
    with_python = [page for page in BLOCKS if any(b[0] == "python" for b in BLOCKS[page])]
    assert sorted(with_python) == PYTHON_ON
    assert sorted(page for page in BLOCKS if calls(page)) == COMMANDS_ON


@pytest.mark.parametrize("page", sorted({*PYTHON_ON, *COMMANDS_ON}))
def test_what_a_page_shows_runs_and_prints_what_the_page_says(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if page == "looking.md":
        pytest.importorskip("viser", reason="the page is about the extra hqp_grasp[view]")
        monkeypatch.setattr("hqp_grasp.experiments.view.Viewer.play", interrupted)
    names = {"__name__": "__main__"}  # a page's later blocks go on from its earlier ones
    for kind, file, code, shown in BLOCKS[page]:
        if file:
            Path(file).write_text(code, encoding="utf-8")
        elif kind == "python":
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed):
                exec(compile(code, page, "exec"), names)
            if shown:
                assert printed.getvalue() == shown
    for arguments in calls(page):
        call(arguments, monkeypatch)


@pytest.mark.parametrize("page", BLOCKS)
def test_make_knows_what_a_page_has_it_make(page):
    found = [w for kind, _, code, _ in BLOCKS[page] if kind == "sh" for w in commands(code)]
    for words in found:
        if words[0] == "make":
            subprocess.run([*words, "--dry-run"], cwd=ROOT, check=True, capture_output=True)


def test_nothing_else_than_python_and_make_is_shown_as_a_command():
    found = [w for p in BLOCKS for k, _, code, _ in BLOCKS[p] if k == "sh" for w in commands(code)]
    assert {words[0] for words in found} <= {"make", "python", ".venv/bin/python"}


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
