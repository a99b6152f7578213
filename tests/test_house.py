"""Imports of the package point down, from floor to floor, and never in a circle."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "hqp_grasp"
# From the ground up. A file may import from its own folder and from floors below, never from
# above, nor from another folder of its floor.
FLOORS = (
    ("errors", "kernels"),
    ("files",),
    ("grasp",),
    ("mechanics",),
    ("history", "hierarchy", "world", "surface"),
    ("tasks",),
    ("control", "touch"),
    ("judge",),
    ("experiments",),
    ("__init__",),
    ("__main__",),
)
FLOOR = {room: height for height, rooms in enumerate(FLOORS) for room in rooms}


def imports(package):
    """The files that each file of `package` imports, anywhere in it, each with its line."""
    files = {path.relative_to(package.parent).as_posix(): path for path in package.rglob("*.py")}
    return {
        name: {
            (target, node.lineno)
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.Import | ast.ImportFrom)
            for target in targets(node, name, files)
        }
        for name, path in files.items()
    }


def targets(node, name, files):
    """The files of the package that one import statement in file `name` reads."""
    if isinstance(node, ast.Import):
        modules = [alias.name.split(".") for alias in node.names]
    else:
        above = name.split("/")[: -node.level] if node.level else []
        base = above + (node.module.split(".") if node.module else [])
        modules = [[*base, alias.name] for alias in node.names]  # a module, or a name in one
    for module in modules:
        for parts in (module, module[:-1]):
            path = "/".join(parts)
            found = {f"{path}.py", f"{path}/__init__.py"} & files.keys()
            if found:
                yield found.pop()
                break


def room(name):
    """The folder of the package that a file is in, or the file's own name."""
    return name.split("/")[1].removesuffix(".py")


def wrong_ways(graph):
    """Imports that point up or sideways, and files in rooms that no floor has."""
    for name in sorted(graph):
        if room(name) not in FLOOR:
            yield f"{name}: no floor of tests/test_house.py has {room(name)!r}"
            continue
        for target, line in sorted(graph[name]):
            here, there = room(name), room(target)
            if here != there and FLOOR.get(there, len(FLOORS)) >= FLOOR[here]:
                way = "up" if FLOOR.get(there, len(FLOORS)) > FLOOR[here] else "sideways"
                yield f"{name}:{line} imports {target}: that points {way}"


def circle(graph):
    """Files that import one another in a circle, the first one last again; or None."""
    clear = set()

    def search(name, path):
        if name in path:
            return [*path[path.index(name) :], name]
        if name in clear:
            return None
        for target, _ in sorted(graph[name]):
            found = search(target, [*path, name])
            if found:
                return found
        clear.add(name)
        return None

    return next(filter(None, (search(name, []) for name in sorted(graph))), None)


@pytest.fixture(scope="module")
def graph():
    return imports(PACKAGE)


def test_every_import_points_down(graph):
    assert list(wrong_ways(graph)) == []


def test_no_files_import_one_another_in_a_circle(graph):
    assert circle(graph) is None


def test_the_drawing_has_every_floor_and_no_other():
    rooms = {room(f"hqp_grasp/{path.name}") for path in PACKAGE.iterdir() if path.suffix == ".py"}
    rooms |= {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert rooms | {"__main__"} == set(FLOOR)


# ---------------------------------------------------------------- that these tests can fail


def house(folder, **files):
    """A package of that name: `world__scene="…"` is the file world/scene.py."""
    for name, text in files.items():
        path = folder / "hqp_grasp" / (name.replace("__", "/") + ".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (folder / "hqp_grasp" / "__init__.py").write_text("")
    return imports(folder / "hqp_grasp")


CLOSE = "from hqp_grasp.control.paper import laws\n"


@pytest.mark.parametrize(
    ("text", "way"),
    [
        (CLOSE, "up"),
        ("import hqp_grasp.control.paper as p\n", "up"),
        ("from hqp_grasp.control import paper\n", "up"),
        ("from ..control.paper import laws\n", "up"),
        (f"def late():\n    {CLOSE}", "up"),
        (f"from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    {CLOSE}", "up"),
        ("import hqp_grasp as hg\n", "up"),
        ("from hqp_grasp.hierarchy.level import Level\n", "sideways"),
    ],
)
def test_an_import_that_does_not_point_down_is_told_with_both_files(tmp_path, text, way):
    graph = house(tmp_path, world__scene=text, control__paper="", hierarchy__level="")
    (told,) = wrong_ways(graph)
    assert told.startswith("hqp_grasp/world/scene.py:")
    (target,) = {file for file, _ in graph["hqp_grasp/world/scene.py"]}
    assert target in told and told.endswith(f"points {way}")


@pytest.mark.parametrize("other", ["control", "touch"])
def test_control_and_touch_may_not_know_each_other(tmp_path, other):
    one = {"control": "touch", "touch": "control"}[other]
    text = f"from hqp_grasp.{other}.b import x\n"
    (told,) = wrong_ways(house(tmp_path, **{f"{one}__a": text, f"{other}__b": ""}))
    assert f"{one}/a.py" in told and f"{other}/b.py" in told and "sideways" in told


def test_imports_from_below_and_from_outside_are_fine(tmp_path):
    text = "import numpy as np\nfrom hqp_grasp.errors import x\nfrom hqp_grasp.world.b import y\n"
    assert list(wrong_ways(house(tmp_path, world__a=text, world__b="", errors=""))) == []


def test_a_circle_is_told_file_by_file_lazy_or_not(tmp_path):
    graph = house(
        tmp_path,
        tasks__a="from hqp_grasp.tasks.b import x\n",
        tasks__b="def late():\n    from hqp_grasp.tasks.c import x\n",
        tasks__c="from hqp_grasp.tasks import a\n",
    )
    files = [f"hqp_grasp/tasks/{letter}.py" for letter in "abca"]
    assert list(wrong_ways(graph)) == []
    assert circle(graph) == files


def test_a_room_without_a_floor_is_told(tmp_path):
    (told,) = wrong_ways(house(tmp_path, attic__box=""))
    assert told.startswith("hqp_grasp/attic/box.py: no floor")


def test_values_are_frozen():
    """Every dataclass is one, but what a lift notes of itself as it goes."""
    thawed = [
        node.name
        for path in sorted(PACKAGE.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef)
        for mark in map(ast.unparse, node.decorator_list)
        if mark.startswith("dataclass") and "frozen=True" not in mark
    ]
    assert thawed == ["_Looking"]


# ---------------------------------------------------------------- the planner's room

ROOM = [
    path
    for folder in ("control", "surface")
    for path in sorted((PACKAGE / folder).glob("*.py"))
    if path.name not in ("forces.py", "hold.py")
]


def constants(source):
    """Names of a module's constants: assigned at its top, in capitals."""
    for node in ast.parse(source).body:
        assigned = [node.target] if isinstance(node, ast.AnnAssign) else []
        for target in node.targets if isinstance(node, ast.Assign) else assigned:
            names = (name.id for name in ast.walk(target) if isinstance(name, ast.Name))
            yield from (name for name in names if name.isupper())


def test_the_planners_room_has_no_more_constants_than_it_had():
    """A constant is a debt: a new one takes the place of another, or moves this bound knowingly."""
    found = [f"{p.name}: {name}" for p in ROOM for name in constants(p.read_text("utf-8"))]
    assert len(found) <= 50, found
    assert list(constants("A = 1\nB: int = 2\nc = 3\nD, E = 4, 5\ndef f():\n    G = 6\n")) == [
        *"ABDE"
    ]


def test_the_planners_room_has_no_type_ignore_and_no_function_over_fifty_lines():
    for path in ROOM:
        source = path.read_text("utf-8")
        assert "type: ignore" not in source, path.name
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.FunctionDef):
                assert node.end_lineno - node.lineno < 50, f"{path.name}: {node.name}"


def test_no_law_and_no_probe_is_known_by_its_type_in_the_planners_room():
    kinds = {"Task", "ForceTask", "MomentTask", "KinematicTask", "ContactSpaceTask", "Probe"}
    for path in ROOM:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "isinstance":
                asked = {n.id for n in ast.walk(node.args[1]) if isinstance(n, ast.Name)}
                assert not asked & kinds, f"{path.name}: {ast.unparse(node)}"
