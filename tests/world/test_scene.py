"""Objects and scenes: what is refused, and that the compiled shapes are those asked for."""

import pickle
from pathlib import Path

import mujoco
import numpy as np
import pytest
import tiny_hand
from surfaces import nearest_on_circle, nearest_on_polygon

from hqp_grasp.errors import InputError, ModelError
from hqp_grasp.world.scene import OBJECT, Cylinder, Prism, Scene

SQUARE = ((0.03, -0.03), (0.03, 0.03), (-0.03, 0.03), (-0.03, -0.03))
LOPSIDED = ((0.09, -0.01), (0.02, 0.07), (-0.04, 0.03), (-0.02, -0.05))
PENTAGRAM = np.array([(np.cos(a), np.sin(a)) for a in 4 * np.pi / 5 * np.arange(5)])
# MuJoCo keeps meshes in single precision, and finds distances to them by iteration.
MESH_TOL = 1e-7  # [m]
EXACT_TOL = 1e-12  # [m]


@pytest.mark.parametrize("bad", [0.0, -0.05, np.nan, np.inf, -np.inf, None, "wide", [0.05, 0.06]])
def test_a_cylinder_has_a_finite_radius_and_height_above_zero(bad):
    with pytest.raises(InputError, match=r"Cylinder\.radius"):
        Cylinder(radius=bad)
    with pytest.raises(InputError, match=r"Cylinder\.height"):
        Cylinder(radius=0.05, height=bad)


@pytest.mark.parametrize("bad", [0.0, -0.05, np.nan, np.inf])
def test_a_prism_has_a_finite_height_and_side_above_zero(bad):
    with pytest.raises(InputError, match=r"Prism\.height"):
        Prism(SQUARE, height=bad)
    with pytest.raises(InputError, match="Prism side"):
        Prism.regular(6, bad)


@pytest.mark.parametrize(
    ("polygon", "message"),
    [
        pytest.param(SQUARE[:2], "at least 3 corners", id="two corners"),
        pytest.param((), "at least 3 corners", id="no corner"),
        pytest.param(0.1, "at least 3 corners", id="a number"),
        pytest.param(((0, 0, 0), (1, 0, 0), (0, 1, 0)), "at least 3 corners", id="three columns"),
        pytest.param(((0, 0), (1, 0), (0,)), "Prism.polygon", id="ragged"),
        pytest.param("square", "Prism.polygon", id="text"),
        pytest.param((*SQUARE[:3], (np.nan, -0.03)), "finite", id="NaN"),
        pytest.param((*SQUARE[:3], (-np.inf, -0.03)), "finite", id="infinite"),
        pytest.param(SQUARE[::-1], "counter-clockwise", id="clockwise"),
        pytest.param((*SQUARE, (0.0, -0.01)), "strictly convex", id="dent"),
        pytest.param((*SQUARE, (0.0, -0.03)), "strictly convex", id="collinear"),
        pytest.param((*SQUARE, SQUARE[0]), "leave the last out", id="closed by hand"),
        pytest.param((*SQUARE[:2], SQUARE[1], *SQUARE[2:]), "repeats the corner", id="repeated"),
        pytest.param(np.add(SQUARE, (0.1, 0.0)), "around the origin", id="origin outside"),
        pytest.param(np.add(SQUARE, (0.03, 0.0)), "around the origin", id="origin on an edge"),
        *(
            pytest.param(np.roll(PENTAGRAM, i, axis=0), "strictly convex", id=f"pentagram {i}")
            for i in range(5)
        ),
    ],
)
def test_a_prism_stands_on_a_convex_polygon_around_the_origin(polygon, message):
    with pytest.raises(InputError, match=message):
        Prism(polygon)


@pytest.mark.parametrize("sides", [0, 1, 2])
def test_a_regular_polygon_has_three_sides_or_more(sides):
    with pytest.raises(InputError, match="at least 3"):
        Prism.regular(sides, 0.05)


def test_a_regular_prism_has_the_sides_asked_for_and_a_corner_on_the_x_axis():
    for sides in (3, 4, 5, 6, 12):
        corners = np.array(Prism.regular(sides, 0.04).polygon)
        edges = np.roll(corners, -1, axis=0) - corners
        np.testing.assert_allclose(np.linalg.norm(edges, axis=1), 0.04, rtol=1e-12)
        np.testing.assert_allclose(corners.mean(axis=0), 0.0, atol=1e-15)
        assert corners[0, 0] > 0 and corners[0, 1] == 0


@pytest.mark.parametrize("first", range(6))
def test_any_corner_of_a_polygon_may_come_first(first):
    hexagon = Prism.regular(6, 0.05).polygon
    assert Prism(hexagon[first:] + hexagon[:first]).polygon[0] == hexagon[first]


def test_equal_objects_and_scenes_are_equal_values():
    assert Prism(np.array(SQUARE)) == Prism(SQUARE)
    assert hash(Prism(np.array(SQUARE))) == hash(Prism(SQUARE))
    assert Scene(object=Cylinder(0.05)) == Scene(object=Cylinder(0.05))
    assert Scene(object=Cylinder(0.05)) != Scene(object=Cylinder(0.04))


# ---------------------------------------------------------------- geometry


@pytest.fixture(scope="module")
def tip_over(tmp_path_factory):
    """The finger as a plotter: the tip's centre at any (x, y) near `centre`, to measure from."""
    xml = tiny_hand.change(
        tiny_hand.STIFF,
        '<joint name="lift" type="slide" axis="0 0 1" range="-0.5 0.5"/>',
        '<joint name="lift" type="slide" axis="0 0 1"/><joint name="x" type="slide" axis="1 0 0"/>'
        '<joint name="y" type="slide" axis="0 1 0"/>',
    )
    xml = tiny_hand.change(xml, 'qpos="0 0.2 0.1"', 'qpos="0 0 0 0.2 0"')
    toml = tiny_hand.change(tiny_hand.TOML, "lift = 0.1", "lift = 0.1\nx = 0.1\ny = 0.1")
    folder = tiny_hand.write(tmp_path_factory.mktemp("plotter"), xml, toml)

    def measure(thing, position, offsets):
        """Distance from the tip's surface to the object, the centre at position + offset."""
        scene = Scene(folder, thing, position)
        robot, data = scene.articulated, mujoco.MjData(scene.model)
        tip, other = scene.model.geom("tip").id, scene.model.geom(OBJECT).id
        found = []
        for x, y, z in np.add(position, offsets):
            robot.place(data, np.array([z, x - tiny_hand.LENGTH, y, 0.0]))
            np.testing.assert_allclose(
                robot.centers(np.array([z, x - tiny_hand.LENGTH, y, 0.0])), [[x, y, z]], atol=1e-12
            )
            found.append(mujoco.mj_geomDistance(scene.model, data, tip, other, 1.0, None))
        return np.array(found)

    return measure


@pytest.mark.parametrize(
    "polygon", [LOPSIDED, SQUARE, Prism.regular(6, 0.05).polygon, Prism.regular(3, 0.08).polygon]
)
def test_distances_to_a_prism_are_those_to_its_polygon(tip_over, polygon):
    """Which fixes every corner where it was asked for, the mesh's own frame notwithstanding."""
    rng = np.random.default_rng(0)
    offsets = rng.uniform((-0.15, -0.15, -0.15), (0.15, 0.15, 0.15), size=(200, 3))
    expected = np.array([nearest_on_polygon(polygon, p[:2])[0] for p in offsets]) - tiny_hand.TIP
    outside = expected > 0.0
    assert outside.sum() > 100
    found = tip_over(Prism(polygon, 0.4), (0.3, -0.2, 0.1), offsets[outside])
    np.testing.assert_allclose(found, expected[outside], atol=MESH_TOL)


def test_the_corners_of_a_prism_are_found_where_they_were_asked_for(tip_over):
    corners = np.array(LOPSIDED)
    away = corners / np.linalg.norm(corners, axis=1)[:, None]
    position, gap = (-0.1, 0.4, 0.3), 0.02
    for height in (-0.19, 0.0, 0.19):
        offsets = np.column_stack([corners + gap * away, np.full(len(corners), height)])
        expected = [nearest_on_polygon(corners, p[:2])[0] - tiny_hand.TIP for p in offsets]
        found = tip_over(Prism(LOPSIDED, 0.4), position, offsets)
        np.testing.assert_allclose(found, expected, atol=MESH_TOL)


@pytest.mark.parametrize("thing", [Prism(LOPSIDED, height=0.3), Cylinder(0.05, height=0.3)])
def test_objects_end_half_their_height_above_and_below_their_position(tip_over, thing):
    offsets = [(0.0, 0.0, sign * (0.15 + tiny_hand.TIP + 0.02)) for sign in (-1, 1)]
    found = tip_over(thing, (0.2, 0.1, -0.1), offsets)
    np.testing.assert_allclose(found, 0.02, atol=MESH_TOL)


def test_distances_to_a_cylinder_are_those_to_its_circle(tip_over):
    rng = np.random.default_rng(1)
    offsets = rng.uniform((-0.15, -0.15, -0.19), (0.15, 0.15, 0.19), size=(200, 3))
    expected = np.array([nearest_on_circle(0.05, p[:2])[0] for p in offsets]) - tiny_hand.TIP
    outside = expected > 0.0
    found = tip_over(Cylinder(0.05, 0.4), (0.3, -0.2, 0.1), offsets[outside])
    np.testing.assert_allclose(found, expected[outside], atol=EXACT_TOL)


# ---------------------------------------------------------------- scenes


def test_a_scene_holds_the_robot_as_it_is_alone():
    robot = Scene().articulated
    alone, model = mujoco.MjModel.from_xml_path(str(robot.description.xml)), robot.model
    assert (model.nq, model.neq, model.nu) == (alone.nq, alone.neq, alone.nu)
    assert model.ngeom == alone.ngeom + 1 and model.nbody == alone.nbody + 1
    full = robot.coupling @ robot.home + robot.offset
    np.testing.assert_allclose(full, alone.key("home").qpos, atol=1e-12)
    np.testing.assert_array_equal(model.jnt_range, alone.jnt_range)


def test_a_scene_compiles_once():
    scene = Scene("bhand")
    assert scene.model is scene.model
    assert scene.articulated is scene.articulated
    assert scene.articulated.model is scene.model


@pytest.mark.parametrize("thing", [Cylinder(0.04, 0.3), Prism(LOPSIDED)])
def test_a_scene_travels_by_pickle_without_its_model(thing):
    scene = Scene("bhand", thing, (0.1, 0.2, 0.3))
    fresh = pickle.dumps(scene)
    robot = scene.articulated
    assert len(pickle.dumps(scene)) == len(fresh) < 2000
    copy = pickle.loads(fresh)
    assert copy == scene and hash(copy) == hash(scene)
    assert copy.articulated.joints == robot.joints
    np.testing.assert_array_equal(copy.model.geom_pos, scene.model.geom_pos)
    np.testing.assert_array_equal(copy.model.mesh_vert, scene.model.mesh_vert)


def test_a_scene_with_a_robot_from_elsewhere_travels_too(tmp_path):
    scene = Scene(tiny_hand.write(tmp_path), Cylinder(0.02), (0.1, 0.0, 0.0))
    copy = pickle.loads(pickle.dumps(scene))
    assert copy.articulated.joints == ("lift", "proximal")


@pytest.mark.parametrize("thing", ["cylinder", None, Cylinder, 0.05])
def test_an_unknown_object_lists_the_known_ones(thing):
    with pytest.raises(InputError, match=r"unknown object .*Cylinder, Prism, Body"):
        Scene(object=thing)


def test_an_unknown_robot_is_refused_before_anything_is_compiled():
    with pytest.raises(InputError, match=r"unknown robot 'hook'.*bhand, .*umass_torso, wam_bhand"):
        Scene(robot="hook")


@pytest.mark.parametrize(
    "position",
    [(0.7, 0.0), (0.7, 0.0, 0.2, 0.0), 0.7, (0.7, np.nan, 0.2), (0.7, 0.0, np.inf), "abc",
     ("a", "b", "c")],
    ids=str,
)  # fmt: skip
def test_a_position_is_three_finite_numbers(position):
    with pytest.raises(InputError, match=r"Scene\.position must be 3 finite numbers"):
        Scene(position=position)


def test_a_robot_that_uses_the_objects_name_is_refused(tmp_path):
    xml = tiny_hand.XML.replace('name="distal"', 'name="object"').replace('"distal"', '"object"')
    with pytest.raises((InputError, ModelError), match=r"tiny\.xml.*'object'"):
        Scene(tiny_hand.write(tmp_path, xml), Cylinder(0.05)).model  # noqa: B018


@pytest.mark.parametrize("kind", [str, Path])
def test_a_robot_of_ones_own_is_saved_by_its_whole_path(tmp_path, monkeypatch, kind):
    (tmp_path / "mine").mkdir()
    tiny_hand.write(tmp_path / "mine")
    monkeypatch.chdir(tmp_path)
    scene = Scene(kind("./mine/../mine/"), Cylinder(0.02), (0.1, 0.2, 0.3), (1, 2, 3, 0, 1, 0, 0))
    if kind is str:
        scene = Scene("mine/robot.toml", scene.object, scene.position, scene.base)
    scene.save("scene.json")
    monkeypatch.chdir("/")
    loaded = Scene.load(tmp_path / "scene.json")
    assert (loaded.object, loaded.position, loaded.base, loaded.hand) == (
        (scene.object, scene.position, scene.base, scene.hand)
    )
    assert Path(loaded.robot).is_absolute()
    assert loaded.articulated.joints == ("lift", "proximal")


def test_a_scene_of_the_packages_robots_is_saved_by_name_with_its_hand(tmp_path):
    scene = Scene("umass_torso", Cylinder(0.02), (0.1, 0.2, 0.3), hand="left")
    scene.save(tmp_path / "scene.json")
    assert Scene.load(tmp_path / "scene.json") == scene


def test_a_base_that_is_moved_twice_is_moved_by_both(tmp_path):
    """x ↦ R x + p, the last one last; the object stays."""
    scene = Scene(tiny_hand.write(tmp_path), Cylinder(0.02), (0.5, 0.0, 0.0))
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # z by 90°
    S = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # x by 90°
    p, s = np.array([0.1, 0.2, 0.3]), np.array([-0.3, 0.0, 0.05])
    moved = scene.rebased(p, R).rebased(s, S)
    q = np.array([0.2, 0.4])
    expected = (scene.articulated.centers(q) @ R.T + p) @ S.T + s
    np.testing.assert_allclose(moved.articulated.centers(q), expected, atol=1e-12)
    palm = S @ R @ scene.articulated.palm(q)[1]
    np.testing.assert_allclose(moved.articulated.palm(q)[1], palm, atol=1e-12)
    assert np.linalg.norm(moved.base[3:]) == pytest.approx(1.0, abs=1e-12)
    assert moved.position == scene.position
    with pytest.raises(InputError, match="unit quaternion"):
        Scene(scene.robot, scene.object, scene.position, (0, 0, 0, 1, 1e-4, 0, 0))
