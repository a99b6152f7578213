"""`make mutants` draws edits that are Python, one line each, from every module in turn."""

import importlib.util
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
spec = importlib.util.spec_from_file_location("mutants", ROOT / "benchmarks" / "mutants.py")
assert spec is not None and spec.loader is not None
mutants = sys.modules["mutants"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(mutants)

NAMES = ("errors.py", "files.py", "tasks/force.py", "tasks/posture.py", "control/landing.py")
SOURCES = {f"hqp_grasp/{name}": (ROOT / "hqp_grasp" / name).read_text() for name in NAMES}


def edits(source: str) -> set[str]:
    """All mutants of a source of one line, as the line becomes."""
    return {m.applied(source) for m in mutants.mutants_of(source, "a.py")} - {source}


def test_a_seed_draws_the_same_mutants_and_another_seed_draws_others() -> None:
    first, again, other = (mutants.drawn(SOURCES, 20, seed) for seed in (5, 5, 6))
    assert first == again
    assert len(set(first)) == 20
    assert set(first) != set(other)


def test_every_module_has_its_turn() -> None:
    turns = [mutant.module for mutant in mutants.drawn(SOURCES, 12, 3)]
    assert set(turns[:5]) == set(turns[5:10]) == set(SOURCES)
    assert set(Counter(turns).values()) == {2, 3}


def test_each_mutant_is_python_and_differs_in_the_line_that_it_names() -> None:
    for mutant in mutants.drawn(SOURCES, 40, 1):
        source = SOURCES[mutant.module]
        edited = mutant.applied(source)
        compile(edited, mutant.module, "exec")
        pairs = zip(source.splitlines(), edited.splitlines(), strict=True)
        changed = [i for i, (old, new) in enumerate(pairs, 1) if old != new]
        assert changed == [mutant.line]
        assert mutant.first <= mutant.line <= mutant.last


@pytest.mark.parametrize(
    ("source", "edited"),
    [
        ("ä = b + c", {"ä = b - c", "ä = b", "ä = c"}),
        ("a = (b - c) * d", {"a = (b + c) * d", "a = (b) * d", "a = (c) * d", "a = (b - c) / d"}),
        ("a = -b", {"a = b"}),
        ("a = b < c", {"a = b <= c", "a = b > c"}),
        ("a = b == c", {"a = b != c"}),
        ("a = b[0]", {"a = b[1]", "a = b[-1]"}),
        ("a = b[-1]", {"a = b[0]"}),
        ("a = b.sum(axis=1)", {"a = b.sum(axis=0)"}),
        ("a = 0.5", {"a = 1.5"}),
        ("a = True", {"a = False"}),
        ("a = b and c", {"a = b or c", "a = b", "a = c"}),
        ("a = min(b, c)", {"a = max(b, c)"}),
        ("a = d(b, c)", {"a = d(c, b)"}),
        ("a += b", {"a -= b"}),
    ],
)
def test_each_kind_of_edit(source: str, edited: set[str]) -> None:
    assert edits(source) == edited


@pytest.mark.parametrize(
    "source",
    [
        '"""Between 0 and 1."""',
        "a: Literal[1]",
        "raise ValueError(1 + b)",
        'a = f"{b + 1}"',
        "def __repr__(a): return a + 1",
        "if TYPE_CHECKING: a = 1",
        "print(1 + b)",
        "figure(figsize=(6, 4))",
    ],
)
def test_what_only_shows_is_left_alone(source: str) -> None:
    assert not edits(source)


def test_tests_that_reach_the_line_are_tried_and_all_where_coverage_is_blind() -> None:
    seconds = {"tests/test_a.py::x": 2.0, "tests/test_a.py::y": 1.0, "tests/b/test_b.py::z": 0.1}
    reach = mutants.Reach(seconds, {"hqp_grasp/b/m.py": {"2": ["tests/test_a.py::x", "gone"]}})
    source = "def f(a):\n    return a + 1\n\n\nK = 2\n"
    seen, blind = (
        next(m for m in mutants.mutants_of(source, "hqp_grasp/b/m.py") if m.line == line)
        for line in (2, 5)
    )
    assert reach.tests(seen) == ["tests/test_a.py::x"]
    assert set(reach.tests(blind)) == set(seconds)


def test_kernels_are_compiled_anew_where_the_edited_module_is_imported(tmp_path: Path) -> None:
    folder = tmp_path / "hqp_grasp" / "hierarchy"
    kept = {}
    for name, source in {
        "a": "K = 1\n",
        "b": "from hqp_grasp.hierarchy.a import K\n",
        "c": "",
    }.items():
        (folder / "__pycache__").mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.py").write_text(source)
        kept[name] = folder / "__pycache__" / f"{name}.f-1.py311.1.nbc"
        kept[name].touch()
    mutants.forget_compiled(tmp_path, "hqp_grasp/hierarchy/a.py")
    assert [name for name, path in kept.items() if path.exists()] == ["c"]


@pytest.mark.parametrize(
    ("code", "said", "told"),
    [
        (0, "1 passed", ""),
        (1, "FAILED tests/a/test_b.py::test_c[1] - assert", "tests/a/test_b.py::test_c[1]"),
        (4, "ERROR tests/test_a.py - NameError: b", "tests/test_a.py"),
        (-11, "", "signal 11"),
        (None, "", "longer than 9 s"),
    ],
)
def test_what_noticed_is_named(code: int | None, said: str, told: str) -> None:
    assert mutants.verdict(code, said, 9.0) == told


def test_a_run_that_tried_no_test_has_noticed_nothing() -> None:
    with pytest.raises(RuntimeError, match="did not run"):
        mutants.verdict(4, "usage: pytest", 9.0)


def test_a_test_is_found_whatever_a_mutant_makes_of_its_parameters() -> None:
    assert (
        mutants.named("tests/test_a.py::test_b[Force(radius=0.05)[0]]") == "tests/test_a.py::test_b"
    )
