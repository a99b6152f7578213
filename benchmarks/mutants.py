"""Spoil the code in one line at a time, drawn by a seed, and see whether the tests notice.

`make mutants SEED=1` draws 60. Neither well-kept tool draws them: cosmic-ray has one test command
for all mutants and no sample; mutmut 3 knows which tests reach a function, but mutates neither
decorated functions (our compiled kernels) nor constants of a module, and has no seed. What is
here instead: edits by the syntax tree, and pytest-cov to know which tests reach a line.
"""

from __future__ import annotations

import ast
import gzip
import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import tyro

ROOT = Path(__file__).parents[1]
TREE = ("hqp_grasp", "robots", "scenarios", "tests", "docs", "benchmarks")  # what tests read
FILES = ("pyproject.toml", "Makefile", "mkdocs.yml", "LICENSE", "CITATION.cff")
PAGES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")
SLACK = 120.0  # [s] for imports and compiling, beside 4 × the time that the tests take
LONGEST = 1800.0  # [s] for all tests

SWAPPED = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.Lt: ("<", "<=", ">"),
    ast.LtE: ("<=", "<", ">="),
    ast.Gt: (">", ">=", "<"),
    ast.GtE: (">=", ">", "<="),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.And: ("and", "or"),
    ast.Or: ("or", "and"),
    ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"),
    ast.In: ("in", "not in"),
    ast.NotIn: ("not in", "in"),
}
CALLS = {"min": "max", "minimum": "maximum", "argmin": "argmax", "sin": "cos", "any": "all"}
CALLS |= {new: old for old, new in CALLS.items()} | {"floor": "ceil", "ceil": "floor"}
# To exchange the first two arguments of these changes nothing.
COMMUTE = {"min", "max", "minimum", "maximum", "fmin", "fmax", "hypot", "not_equal", "equal"}
# What only shows: how a figure looks, what a message says; `strict` guards lengths that agree.
LOOKS = {
    "repr",
    "strict",
    "figsize",
    "linewidth",
    "lw",
    "alpha",
    "color",
    "fontsize",
    "dpi",
    "width",
    "precision",
}
TALKS = {"print", "warn", "write", "format", "add_argument", "set_title", "legend", "text"}
ATOMS = (ast.Name, ast.Attribute, ast.Call, ast.Subscript, ast.Constant)


@dataclass(frozen=True)
class Mutant:
    """One edit: bytes begin:end of a module's source become `new`."""

    module: str  # path from the root of the repository
    line: int  # from 1
    begin: int
    end: int
    new: str
    kind: str
    first: int  # the statement's lines, by which tests are found …
    last: int
    hidden: bool  # … unless coverage cannot see them: compiled, or run by the import

    def applied(self, source: str) -> str:
        """The edited source."""
        data = source.encode()
        return (data[: self.begin] + self.new.encode() + data[self.end :]).decode()

    def told(self, source: str) -> str:
        """The line before → after."""
        lines = (
            text.splitlines()[self.line - 1].strip() for text in (source, self.applied(source))
        )
        return " → ".join(lines)


def mutants_of(source: str, module: str) -> list[Mutant]:
    """All one-line edits of a module, as the tree tells them; `differs` knows if one is Python."""
    data = source.encode()
    starts = [0]
    for text in data.splitlines(keepends=True):
        starts.append(starts[-1] + len(text))
    found: dict[tuple[int, int, str], Mutant] = {}

    def span(node: ast.expr) -> tuple[int, int]:
        assert node.end_lineno is not None and node.end_col_offset is not None
        begin = starts[node.lineno - 1] + node.col_offset
        return begin, starts[node.end_lineno - 1] + node.end_col_offset

    def text(node: ast.expr) -> str:
        begin, end = span(node)
        kept = data[begin:end].decode()
        return kept if isinstance(node, ATOMS) else f"({kept})"

    def edits(node: ast.AST, index: bool) -> Iterator[tuple[str, int, int, str]]:
        """(kind, begin, end, new); `index` where the node stands in brackets or is an axis."""
        if isinstance(node, ast.BinOp | ast.BoolOp):
            sides = [node.left, node.right] if isinstance(node, ast.BinOp) else node.values
            yield from operator(node.op, sides[0], sides[1])
            if isinstance(node, ast.BoolOp) or isinstance(node.op, ast.Add | ast.Sub):
                for kept in sides:
                    yield ("dropped term", *span(node), text(kept))
        elif isinstance(node, ast.Compare) and len(node.ops) == 1:
            yield from operator(node.ops[0], node.left, node.comparators[0])
        elif isinstance(node, ast.AugAssign):
            yield from operator(node.op, node.target, node.value)
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
            if index and isinstance(node.operand, ast.Constant):
                yield ("index", *span(node), "0")
            else:
                yield ("sign", *span(node), text(node.operand))
        elif isinstance(node, ast.Constant):
            yield from constant(node, index)
        elif isinstance(node, ast.Call):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if name in CALLS:
                end = span(node.func)[1]
                yield "call", end - len(name), end, CALLS[name]
            starred = any(isinstance(each, ast.Starred) for each in node.args[:2])
            if len(node.args) > 1 and name not in {"isinstance", *COMMUTE} and not starred:
                (begin, left), (right, end) = span(node.args[0]), span(node.args[1])
                turned = data[right:end] + data[left:right] + data[begin:left]
                yield "order", begin, end, turned.decode()

    def operator(
        op: ast.AST, left: ast.expr, right: ast.expr
    ) -> Iterator[tuple[str, int, int, str]]:
        if type(op) not in SWAPPED:
            return
        old, *others = SWAPPED[type(op)]
        begin, end = span(left)[1], span(right)[0]
        between = data[begin:end].decode()
        if between.count(old) == 1:
            at = begin + len(between[: between.index(old)].encode())
            kind = "comparison" if isinstance(op, ast.cmpop) else "operator"
            for new in others:
                yield kind, at, at + len(old), new

    def constant(node: ast.Constant, index: bool) -> Iterator[tuple[str, int, int, str]]:
        value = node.value
        if isinstance(value, bool):
            yield ("bool", *span(node), str(not value))
        elif index and isinstance(value, int):
            yield ("index", *span(node), {0: "1", 1: "0"}.get(value, str(value - 1)))
            if value == 0:
                yield ("index", *span(node), "-1")
        elif isinstance(value, int | float):
            yield ("constant", *span(node), repr(3 * value) if value else "1")

    def visit(node: ast.AST, place: tuple[int, int, bool], index: bool) -> None:
        if cosmetic(node):
            return
        if isinstance(node, ast.FunctionDef):
            compiled = any("jit" in ast.unparse(each) for each in node.decorator_list)
            for statement in node.body:
                visit(statement, (0, 0, compiled), False)
            for default in [*node.args.defaults, *filter(None, node.args.kw_defaults)]:
                visit(default, (node.lineno, default.lineno, True), False)
            return
        if isinstance(node, ast.ClassDef):
            for statement in node.body:
                visit(statement, (0, 0, True), False)
            return
        if isinstance(node, ast.stmt):
            last = node.body[0].lineno - 1 if hasattr(node, "body") else node.end_lineno
            place = (node.lineno, max(node.lineno, last or 0), place[2])
        for kind, begin, end, new in edits(node, index):
            if b"\n" not in data[begin:end] and "\n" not in new:
                line = data[:begin].count(b"\n") + 1
                mutant = Mutant(module, line, begin, end, new, kind, *place)
                found.setdefault((begin, end, new), mutant)
        if index and isinstance(node, ast.UnaryOp):  # −1 is one number here
            return
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list"):
                continue
            inside = name == "slice" or (index and isinstance(node, ast.Tuple | ast.Slice))
            inside |= isinstance(node, ast.keyword) and node.arg == "axis"
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    visit(child, place, inside)

    tree = ast.parse(source)
    visit(tree, (0, 0, True), False)
    return list(found.values())


def differs(mutant: Mutant, source: str) -> bool:
    """Whether the edit is Python, and other than what was there."""
    try:
        return ast.dump(ast.parse(mutant.applied(source))) != ast.dump(ast.parse(source))
    except SyntaxError:
        return False


def cosmetic(node: ast.AST) -> bool:
    """What no test should hold: messages, looks, types, and f-strings, whose places 3.11 lacks."""
    if isinstance(node, ast.JoinedStr | ast.Raise | ast.Import | ast.ImportFrom):
        return True
    if isinstance(node, ast.FunctionDef):
        return node.name in ("__repr__", "__str__")
    if isinstance(node, ast.If):
        return "TYPE_CHECKING" in ast.unparse(node.test)
    if isinstance(node, ast.keyword):
        return node.arg in LOOKS
    if isinstance(node, ast.Call):
        name = getattr(node.func, "attr", getattr(node.func, "id", ""))
        return name in TALKS or name.endswith(("Error", "Warning"))
    return False


def drawn(sources: dict[str, str], count: int, seed: int) -> list[Mutant]:
    """`count` mutants, from each module in turn; there, each kind of edit is as likely."""
    rng = random.Random(seed)
    modules = sorted(sources)
    rng.shuffle(modules)
    left: dict[str, list[Mutant]] = {}
    chosen: list[Mutant] = []
    while len(chosen) < count and modules:
        for module in list(modules):
            if module not in left:
                left[module] = mutants_of(sources[module], module)
            if not left[module]:
                modules.remove(module)
            elif len(chosen) < count:
                kind = rng.choice(sorted({each.kind for each in left[module]}))
                mutant = rng.choice([each for each in left[module] if each.kind == kind])
                left[module].remove(mutant)
                while not differs(mutant, sources[module]) and left[module]:
                    mutant = left[module].pop(rng.randrange(len(left[module])))
                if differs(mutant, sources[module]):
                    chosen.append(mutant)
    return chosen


@dataclass(frozen=True)
class Reach:
    """Which tests run which lines, and how long each takes."""

    seconds: dict[str, float]  # of each test function that passes
    lines: dict[str, dict[str, list[str]]]  # module, line, tests

    def tests(self, mutant: Mutant) -> list[str]:
        """The tests that reach the line, file by file, the quickest first; all where unknown."""
        lines = self.lines.get(mutant.module, {})
        if mutant.hidden:
            hit = {test for tests in lines.values() for test in tests}
        else:
            wanted = range(mutant.first, mutant.last + 1)
            hit = {test for line in wanted for test in lines.get(str(line), [])}
        hit &= set(self.seconds)
        folder = mutant.module.replace("hqp_grasp", "tests", 1).rpartition("/")[0]
        rest = set(self.seconds) - hit if mutant.hidden or not hit else set()
        files: dict[str, float] = {}
        for test in hit:
            name = test.split("::")[0]
            files[name] = files.get(name, 0.0) + self.seconds[test]

        def turn(test: str) -> tuple:
            name = test.split("::")[0]
            near = mutant.hidden and name.rpartition("/")[0] != folder
            return test in rest, near, files.get(name, 0.0), name, self.seconds[test]

        return sorted(hit | rest, key=turn)


def copied(folder: Path) -> Path:
    """A copy of the tree in `folder`, with what Python and numba have compiled."""
    for name in TREE:
        shutil.copytree(ROOT / name, folder / name)
    for name in FILES + PAGES:
        shutil.copy2(ROOT / name, folder / name)
    return folder


def pytest(tree: Path, arguments: list[str], longest: float) -> tuple[int | None, str]:
    """pytest's exit code and what it says; None where it takes longer than `longest` [s]."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments]
    environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        command,
        cwd=tree,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as running:
        try:
            said, _ = running.communicate(timeout=longest)
        except subprocess.TimeoutExpired:
            os.killpg(running.pid, signal.SIGKILL)
            return None, ""
        return running.returncode, said


def reach(out: Path) -> Reach:
    """Read from `out`, or measured by one run of all tests; kept for this state of the tree."""
    digest = hashlib.sha256()
    for path in sorted(p for n in ("hqp_grasp", "tests") for p in (ROOT / n).rglob("*.py")):
        digest.update(str(path.relative_to(ROOT)).encode() + path.read_bytes())
    kept = out / f"reach-{digest.hexdigest()[:12]}.json.gz"
    if not kept.exists():
        from coverage import CoverageData  # here, so that the drawer's tests do without

        print("running all tests once, to know which lines each reaches", flush=True)
        with tempfile.TemporaryDirectory() as folder:
            tree = copied(Path(folder).resolve())
            cover = ["--cov=hqp_grasp", "--cov-context=test", "--cov-report="]
            code, said = pytest(tree, ["-n", "2", "--junitxml=times.xml", *cover], LONGEST)
            if code not in (0, 1):
                sys.exit(f"pytest did not run:\n{said[-3000:]}")
            seconds: dict[str, float] = {}
            for case in ElementTree.parse(tree / "times.xml").iter("testcase"):
                name = f"{case.get('classname', '').replace('.', '/')}.py::{case.get('name')}"
                name = named(name)
                if not len(case):  # neither failed nor skipped
                    seconds[name] = seconds.get(name, 0.0) + float(case.get("time", 0.0))
            for name in map(named, failures(said)):
                seconds.pop(name, None)
            if code:
                print("fail without any mutant, and are left out:", *failures(said), sep="\n  ")
            data = CoverageData(str(tree / ".coverage"))
            data.read()
            lines = {
                str(Path(name).relative_to(tree)): {
                    str(line): sorted({named(c.rpartition("|")[0]) for c in contexts if c})
                    for line, contexts in data.contexts_by_lineno(name).items()
                }
                for name in data.measured_files()
            }
        out.mkdir(parents=True, exist_ok=True)
        text = json.dumps({"seconds": seconds, "lines": lines})
        kept.write_bytes(gzip.compress(text.encode(), 1))  # 3 MB instead of 120
    return Reach(**json.loads(gzip.decompress(kept.read_bytes())))


def named(test: str) -> str:
    """A test without its parameters, which a mutant may call otherwise."""
    return test.partition("[")[0]


def failures(said: str) -> list[str]:
    """The tests that pytest's summary calls failed."""
    return re.findall(r"^(?:FAILED|ERROR) (tests/.*?)(?: - .*)?$", said, re.MULTILINE)


def forget_compiled(tree: Path, module: str) -> None:
    """Remove kernels that may hold old code: those of `module` and of all that import from it."""
    stale = [module]
    sources = {p: p.read_text(encoding="utf-8") for p in (tree / "hqp_grasp").rglob("*.py")}
    for name in stale:  # grows while it is read
        dotted = name.removesuffix(".py").replace("/", ".")
        parent, _, last = dotted.rpartition(".")
        imported = rf"^from ({re.escape(dotted)} import|{re.escape(parent)} import.*\b{last}\b)"
        for path, source in sources.items():
            relative = str(path.relative_to(tree))
            if relative not in stale and re.search(imported, source, re.MULTILINE):
                stale.append(relative)
    for name in stale:
        path = tree / name
        for kept in (path.parent / "__pycache__").glob(f"{path.stem}.*.nb[ci]"):
            kept.unlink()


def judge(mutant: Mutant, known: Reach) -> str:
    """The test that notices the mutant; empty where none does."""
    tests = known.tests(mutant)
    with tempfile.TemporaryDirectory() as folder:
        tree = copied(Path(folder))
        path = tree / mutant.module
        path.write_text(mutant.applied(path.read_text(encoding="utf-8")), encoding="utf-8")
        forget_compiled(tree, mutant.module)
        (tree / "chosen.txt").write_text("\n".join(tests), encoding="utf-8")
        longest = SLACK + 4.0 * sum(known.seconds[test] for test in tests)
        code, said = pytest(tree, ["-x", "@chosen.txt"], longest)
    return verdict(code, said, longest)


def verdict(code: int | None, said: str, longest: float) -> str:
    """What noticed: a test, a test file that cannot be imported, the clock, or a crash."""
    if code is None:
        return f"longer than {longest:.0f} s"
    if code == 0:
        return ""
    if code < 0:
        return f"signal {-code}"
    if failed := failures(said):
        return failed[0]
    raise RuntimeError(f"pytest did not run:\n{said[-3000:]}")


def main(
    seed: int,
    count: int = 60,
    under: tuple[str, ...] = (),
    jobs: int = 2,
    dry: bool = False,
    out: Path = ROOT / "out" / "mutants",
) -> None:
    """Try mutants; exit with an error where fewer than nine of ten are killed.

    Args:
        seed: Draws the mutants.
        count: How many.
        under: Folders or files of hqp_grasp to draw from, as `control tasks/moment.py`; else all.
        jobs: Mutants tried at a time.
        dry: Draw and print them only.
        out: Where results go.
    """
    places = [ROOT / "hqp_grasp" / name for name in under] or [ROOT / "hqp_grasp"]
    if missing := [str(place) for place in places if not place.exists()]:
        sys.exit(f"there is no {', '.join(missing)}")
    paths = {p for place in places for p in ([place] if place.is_file() else place.rglob("*.py"))}
    sources = {str(p.relative_to(ROOT)): p.read_text(encoding="utf-8") for p in paths}
    chosen = drawn(sources, count, seed)
    told = [f"{m.module}:{m.line}: {m.told(sources[m.module])}" for m in chosen]
    if dry:
        return print(*told, sep="\n")
    known = reach(out)
    begin = time.monotonic()
    rows = []
    with ThreadPoolExecutor(jobs) as pool:
        noticed = pool.map(partial(judge, known=known), chosen)
        for mutant, edit, killer in zip(chosen, told, noticed, strict=True):
            print(f"{edit}\n    {f'killed by {killer}' if killer else 'SURVIVED'}", flush=True)
            rows.append(asdict(mutant) | {"edit": edit, "killed_by": killer})
            text = json.dumps(rows, indent=1, ensure_ascii=False)
            (out / f"seed-{seed}.json").write_text(text, encoding="utf-8")
    killed = sum(bool(row["killed_by"]) for row in rows)
    minutes = (time.monotonic() - begin) / 60.0
    print(f"\nseed {seed}: {killed} of {len(rows)} killed, in {minutes:.0f} minutes")
    if killed < 0.9 * len(rows):
        sys.exit("fewer than nine of ten")


if __name__ == "__main__":
    tyro.cli(main)
