"""Code shown in the docs runs, and prints what the docs say it prints."""

import contextlib
import io
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import hqp_grasp as hg
from hqp_grasp.__main__ import main
from hqp_grasp.experiments.study import _run_one

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
    "any-robot.md",
    "change-a-rule.md",
    "forces.md",
    "index.md",
    "judging.md",
    "laws.md",
    "looking.md",
    "many-trials.md",
    "mink.md",
    "objects.md",
    "only-solver.md",
    "own-hand.md",
    "own-law.md",
    "picking.md",
    "quickstart.md",
    "real-hand.md",
    "solver.md",
]
COMMANDS_ON = [
    "any-robot.md",
    "judging.md",
    "looking.md",
    "many-trials.md",
    "objects.md",
    "physics.md",
    "picking.md",
    "quickstart.md",
    "real-hand.md",
    "results.md",
]
SMALL = ["--probes", "2", "--jobs", "1"]  # in the place of what the page says, and so few trials


def commands(script):
    """The command lines of a block, in words; comments are left out."""
    lines = (shlex.split(line, comments=True) for line in script.splitlines())
    return [words for words in lines if words]


def calls(page):
    """The page's calls of hqp-grasp, each by its arguments."""
    found = [w for kind, _, code, _ in BLOCKS[page] if kind == "sh" for w in commands(code)]
    own = [w[1:] for w in found if w[0] == "hqp-grasp"]
    return [w for w in own if "--cluster" not in w]  # `make test-all` starts clusters


def call(arguments, monkeypatch):
    """Do in this process what `hqp-grasp ARGUMENTS` does, with few and short trials."""
    if arguments[0] in ("run", "pick"):
        trials = "8" if "--replay" in arguments else "2"
        arguments = [*arguments, *SMALL, "--trials", trials]
    elif arguments[0] == "view":
        arguments = [*arguments, "--port", "0"]
    elif arguments[0] == "judge":
        arguments = [*arguments, "--jobs", "1"]
    monkeypatch.setattr(sys, "argv", ["hqp-grasp", *arguments])
    for name in [name for name in sys.modules if name.startswith("hqp_grasp.scenarios.")]:
        monkeypatch.delitem(sys.modules, name)  # a command starts afresh
    with contextlib.suppress(SystemExit) if "--help" in arguments else contextlib.nullcontext():
        main()


def interrupted(viewer):
    raise KeyboardInterrupt


NEEDS = {  # what a page shows beyond what hqp_grasp needs, and the extra that installs it
    "looking.md": {"viser": "view"},
    "many-trials.md": {"pandas": "read", "duckdb": "read", "viser": "view"},
}


def test_the_pages_that_show_code_are_all_found():
    with_python = [page for page in BLOCKS if any(b[0] == "python" for b in BLOCKS[page])]
    assert sorted(with_python) == PYTHON_ON
    assert sorted(page for page in BLOCKS if calls(page)) == COMMANDS_ON


@pytest.mark.parametrize("page", sorted({*PYTHON_ON, *COMMANDS_ON}))
def test_what_a_page_shows_runs_and_prints_what_the_page_says(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for package, extra in NEEDS.get(page, {}).items():
        pytest.importorskip(package, reason=f"the page is about the extra hqp_grasp[{extra}]")
    if any("view" in arguments for arguments in calls(page)):
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


@pytest.mark.parametrize("seed", [2, 3])
def test_the_hand_that_a_page_describes_comes_to_balance(seed, tmp_path):
    """From other starts than the one whose verdict the page prints."""
    for _, file, code, _ in BLOCKS["any-robot.md"]:
        if file:
            (tmp_path / file).write_text(code, encoding="utf-8")
    (robot,) = tmp_path.glob("*.toml")
    scene = hg.Scene(robot, hg.Cylinder(radius=0.05))
    assert hg.Trial(scene, hg.stack_of("fmk"), probes=20).run(seed).verdict == "good"


def test_no_page_takes_a_trial_that_is_not_lost_for_a_success():
    assert [page for page in BLOCKS if any(".lost" in code for _, _, code, _ in BLOCKS[page])] == []


@pytest.mark.parametrize("page", BLOCKS)
def test_make_knows_what_a_page_has_it_make(page):
    found = [w for kind, _, code, _ in BLOCKS[page] if kind == "sh" for w in commands(code)]
    for words in found:
        if words[0] == "make":
            subprocess.run([*words, "--dry-run"], cwd=ROOT, check=True, capture_output=True)


def test_nothing_but_hqp_grasp_python_make_pip_and_dask_is_shown_as_a_command():
    found = [w for p in BLOCKS for k, _, code, _ in BLOCKS[p] if k == "sh" for w in commands(code)]
    assert {words[0] for words in found} <= {
        *("hqp-grasp", "make", "python", ".venv/bin/python", "pip", "dask")
    }


# A unit on the page, and how the metadata of a column begins.
UNITS = {"N²": "N^2", "(N·m)²": "(N m)^2", "°": "deg", "µs": "us", "the law's": "unit of the law"}


@pytest.fixture(scope="module")
def recorded():
    """The fields of a trial's rows: {column: meaning}, of a geometric and of a physical probe."""
    fields = {}
    for probe in ("geometric", "physical"):
        scene = hg.Scene(object=hg.Cylinder(0.05))
        trial = hg.Trial(scene, hg.ForceTask() >> hg.MomentTask(), probes=1, probe=probe)
        for field in _run_one(trial, 0, 0).schema:
            fields[field.name] = field.metadata[b"meaning"].decode()
    return fields


def general(column):
    """The name that a page gives to a column: law, contact point and joint as placeholders."""
    column = re.sub(r"^(error|status|rank)_.*", r"\1_{law}", column)
    column = re.sub(r"^contact_\d+_", "contact_{i}_", column)
    return re.sub(r"^q_.*", "q_{joint}", column)


def test_a_page_lists_every_column_of_the_results_with_its_unit_in_their_order(recorded):
    page = (ROOT / "docs" / "many-trials.md").read_text(encoding="utf-8")
    (table,) = re.findall(r"^\| column \|.*?\n\n|^\| column \|.*\Z", page, re.DOTALL | re.MULTILINE)
    listed = {}
    for row in table.strip().splitlines()[2:]:
        _, names, unit, _, _ = re.split(r"\s*\|\s*", row)
        listed |= dict.fromkeys(re.findall(r"`(\S+)`", names), unit)
    meanings = {general(column): meaning for column, meaning in recorded.items()}
    # Columns of one law, of one contact point and of one joint stand together in the file.
    assert list(listed) == sorted(meanings, key=list(listed).index)
    plain = [name for name in recorded if name in listed]
    assert plain == [name for name in listed if name in recorded]
    for name, unit in listed.items():
        if unit == "–":
            assert not re.match(r"(\S+|\(N m\)\^2): ", meanings[name])
        else:
            assert meanings[name].startswith(f"{UNITS.get(unit, unit)}: ")
