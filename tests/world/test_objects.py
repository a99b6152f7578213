"""Objects from files: outlines and bodies, where their surface is, and what is refused."""

import pickle
import struct

import mujoco
import numpy as np
import pytest

from hqp_grasp.errors import InputError, ResultsError
from hqp_grasp.experiments.fingerprint import Fingerprint
from hqp_grasp.grasp import Grasp
from hqp_grasp.touch.geometric import GeometricProbe
from hqp_grasp.world.objects import OBJECT, Body, Cylinder, Prism, centroid, read_corners
from hqp_grasp.world.scene import Scene

MESH_TOL = 1e-7  # [m] meshes are kept in single precision
SQUARE = "0.03,-0.03\n0.03,0.03\n-0.03,0.03\n-0.03,-0.03\n"
# Outward triangles of a box's faces, over its corners in binary order of x, y, z.
BOX_FACES = (
    (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
    (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
)  # fmt: skip
# From this posture of the wam_bhand [rad] every finger touches a 5 cm cylinder.
POSTURE = (0.62, 1.12, -0.73, 1.96, 0.63, -0.41, 0.49, 0.21, 1.01, 0.99, 0.98)
TALL = 0.4  # [m] so that only the sides are met


def write(folder, text, name="corners.csv"):
    path = folder / name
    path.write_text(text)
    return path


def box_corners(size, at=(0.0, 0.0, 0.0)):
    unit = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]) - 0.5
    return np.asarray(at) + unit * size


def write_obj(folder, vertices, faces, name="mesh.obj"):
    lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in vertices]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    return write(folder, "\n".join(lines) + "\n", name)


def write_stl(folder, vertices, faces, name="mesh.stl"):
    path = folder / name
    triangles = b"".join(
        struct.pack("<12fH", 0, 0, 0, *vertices[a], *vertices[b], *vertices[c], 0)
        for a, b, c in faces
    )
    path.write_bytes(bytes(80) + struct.pack("<I", len(faces)) + triangles)
    return path


def mjcf(geoms, assets=""):
    return (
        f"<mujoco><asset>{assets}</asset><worldbody><body pos='1 2 3' name='thing'>{geoms}</body>"
        "</worldbody></mujoco>"
    )


def felt(scene):
    """The geoms of the object that a finger can feel."""
    model = scene.model
    mine = np.flatnonzero(model.geom_bodyid == model.body(OBJECT).id)
    return [int(g) for g in mine if model.geom_contype[g] or model.geom_conaffinity[g]]


def corners_of(scene, geom):
    """Vertices of a mesh geom (v, 3), from the scene's position."""
    model, data = scene.model, mujoco.MjData(scene.model)
    mujoco.mj_kinematics(model, data)
    mesh = model.geom_dataid[geom]
    first, many = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    R = data.geom_xmat[geom].reshape(3, 3)
    return data.geom_xpos[geom] + model.mesh_vert[first : first + many] @ R.T - scene.position


def sorted_rows(points):
    return np.array(sorted(np.round(points, 6).tolist()))


# ---------------------------------------------------------------- outlines


@pytest.mark.parametrize("header", ["", "x,y\n", "x [m], y [m]\n", "\ufeffx,y\n"])
def test_an_outline_is_read_with_or_without_a_header(tmp_path, header):
    corners = read_corners(write(tmp_path, header + SQUARE))
    np.testing.assert_array_equal(corners[:2], [(0.03, -0.03), (0.03, 0.03)])
    assert len(corners) == 4


def test_the_files_unit_is_the_scale(tmp_path):
    corners = read_corners(write(tmp_path, "0,0\n60,0\n60,50\n0,50\n"), scale=0.001)
    np.testing.assert_allclose(corners[2], (0.06, 0.05))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        pytest.param("", "holds 0 corners", id="empty"),
        pytest.param("x,y\n0,0\n0.1,0\n", "holds 2 corners", id="two corners"),
        pytest.param("0,0\n0.1,b\n0.1,0.1\n", r"line 2: '0\.1,b' is no corner x,y", id="a letter"),
        pytest.param("0,b\n0.1,0\n0,0.1\n0,0\n", "line 1: '0,b'", id="half a header"),
        pytest.param("0,0\n0.1,0,0\n0,0.1\n", "line 2: '0.1,0,0' is no corner", id="3 columns"),
        pytest.param("x,y\nx,y\n0,0\n", "line 2: 'x,y' is no corner", id="two headers"),
        pytest.param("0,0\n0.1,nan\n0.1,0.1\n", "line 2.*not finite", id="NaN"),
        pytest.param("0,0\n0,0.1\n0.1,0.1\n0.1,0\n", "runs clockwise", id="clockwise"),
        pytest.param(SQUARE + "0.03,-0.03\n", "line 1 in line 5.*leave the last", id="closed"),
        pytest.param("0,0\n0.1,0\n0.1,0\n0,0.1\n", "corner of line 2 in line 3", id="repeated"),
        pytest.param("0,0\n0.1,0\n0.03,0.03\n0,0.1\n", r"\(0\.03, 0\.03\).*line 3", id="dent"),
        pytest.param("0,0\n0.05,0\n0.1,0\n0,0.1\n", "not strictly convex.*line 2", id="straight"),
        pytest.param("0,0\n60,0\n60,60\n", r"60 × 60 m .*--scale 0\.001", id="millimetres"),
        pytest.param("0,0\n1e-3,0\n0,1e-3\n", "too small .*--scale", id="tiny"),
    ],
)
def test_a_bad_outline_is_told_with_its_line(tmp_path, text, message):
    with pytest.raises(InputError, match=message) as told:
        read_corners(write(tmp_path, text))
    assert str(tmp_path) in str(told.value) and "\n" not in str(told.value)


def test_a_missing_outline_is_named(tmp_path):
    with pytest.raises(InputError, match=r"cannot read .*gone\.csv: no such file"):
        read_corners(tmp_path / "gone.csv")


def test_a_centred_prism_has_its_centroid_in_the_middle():
    triangle = np.array([(0.5, 0.2), (0.56, 0.2), (0.5, 0.29)])
    np.testing.assert_allclose(centroid(triangle), (0.52, 0.23))
    np.testing.assert_allclose(Prism.centred(triangle).polygon, triangle - (0.52, 0.23))
    notched = np.array([(0.0, 0.0), (0.04, 0.0), (0.04, 0.04), (0.02, 0.06), (0.0, 0.04)])
    areas, middles = (16e-4, 4e-4), ((0.02, 0.02), (0.02, 0.04 + 0.02 / 3))
    np.testing.assert_allclose(centroid(notched), np.average(middles, axis=0, weights=areas))


# ---------------------------------------------------------------- bodies


@pytest.mark.parametrize("writer", [write_obj, write_stl])
def test_a_meshs_corners_are_found_where_the_file_has_them_about_its_middle(tmp_path, writer):
    size = (0.06, 0.04, 0.12)
    body = Body(writer(tmp_path, box_corners(size, (0.3, -0.2, 0.5)), BOX_FACES))
    scene = Scene(object=body)
    (geom,) = felt(scene)
    np.testing.assert_allclose(
        sorted_rows(corners_of(scene, geom)), sorted_rows(box_corners(size)), atol=MESH_TOL
    )


def test_a_mesh_in_millimetres_is_refused_and_scaled(tmp_path):
    path = write_obj(tmp_path, box_corners((60.0, 40.0, 120.0)), BOX_FACES)
    with pytest.raises(InputError, match=r"60 × 40 × 120 m .*--scale 0\.001"):
        Body(path)
    scene = Scene(object=Body(path, scale=0.001))
    np.testing.assert_allclose(np.ptp(corners_of(scene, *felt(scene)), axis=0), (0.06, 0.04, 0.12))


@pytest.mark.parametrize(
    ("shape", "same"),
    [
        (f"<geom type='cylinder' size='0.05 {TALL / 2}'/>", Cylinder(0.05, TALL)),
        (f"<geom type='box' size='0.04 0.04 {TALL / 2}' euler='0 0 45'/>",
         Prism.regular(4, 0.08, TALL)),
        # Two bodies and two geoms, one within the other where they meet.
        ("<geom type='cylinder' size='0.05 0.15' pos='0 0 -0.05'/>"
         "<body pos='0 0 0.15'><geom type='cylinder' size='0.05 0.05'/></body>",
         Cylinder(0.05, TALL)),
    ],
)  # fmt: skip
def test_a_body_feels_like_the_object_of_the_same_shape(tmp_path, shape, same):
    body = Body(write(tmp_path, mjcf(shape), "thing.xml"))
    grasps = [GeometricProbe(Scene(object=o)).touch(POSTURE) for o in (body, same)]
    assert all(isinstance(grasp, Grasp) for grasp in grasps)
    np.testing.assert_allclose(grasps[0].positions, grasps[1].positions, atol=MESH_TOL)
    np.testing.assert_allclose(grasps[0].normals, grasps[1].normals, atol=1e-5)


def test_the_nearest_of_several_geoms_is_felt_and_gives_the_normal(tmp_path):
    """A thin column beside a cylinder is met by one finger; the others meet the cylinder."""
    core = "<geom type='cylinder' size='0.05 0.2'/>"
    plain = GeometricProbe(Scene(object=Body(write(tmp_path, mjcf(core), "a.xml")))).touch(POSTURE)
    rib = plain.positions[0] - (0.72, 0.0, 0.2)
    x, y = 0.049 * rib[:2] / np.linalg.norm(rib[:2])
    # The mirrored rib, out of the fingers' way, keeps the middle where it is.
    both = "".join(
        f"<geom type='cylinder' size='0.005 0.2' pos='{s * x} {s * y} 0'/>" for s in (1, -1)
    )
    probe = GeometricProbe(Scene(object=Body(write(tmp_path, mjcf(core + both), "b.xml"))))
    found = probe.touch(POSTURE)
    assert isinstance(found, Grasp) and len(felt(probe.scene)) == 3
    away = found.positions[0, :2] - (0.72 + x, 0.0 + y)
    assert np.linalg.norm(away) == pytest.approx(0.005, abs=1e-7)
    np.testing.assert_allclose(found.normals[0, :2], away / 0.005, atol=1e-5)
    np.testing.assert_allclose(found.positions[1:], plain.positions[1:], atol=MESH_TOL)


def test_geoms_that_collide_with_nothing_are_drawn_not_felt(tmp_path):
    halo = "<geom type='sphere' size='0.2' contype='0' conaffinity='0' rgba='1 0 0 1'/>"
    core = f"<geom type='cylinder' size='0.05 {TALL / 2}'/>"
    scene = Scene(object=Body(write(tmp_path, mjcf(halo + core), "thing.xml")))
    model = scene.model
    assert [model.geom(g).name for g in felt(scene)] == [OBJECT]
    drawn = model.geom(f"{OBJECT}_drawn_0")
    assert drawn.size[0] == 0.2 and (drawn.rgba == (1, 0, 0, 1)).all()
    grasp = GeometricProbe(scene).touch(POSTURE)
    around = grasp.positions[:, :2] - scene.position[:2]
    np.testing.assert_allclose(np.linalg.norm(around, axis=1), 0.05, atol=MESH_TOL)
    with pytest.raises(InputError, match="collide with nothing"):
        Body(write(tmp_path, mjcf(halo), "halo.xml"))


def test_a_mesh_far_from_its_hull_warns_with_its_share_of_the_volume(tmp_path):
    """An L of three cubes out of a hull of three and a half."""
    outline = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
    bottom, top = np.array([(*p, 0) for p in outline]), np.array([(*p, 1) for p in outline])
    caps = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
    faces = [(a, c, b) for a, b, c in caps] + [(a + 6, b + 6, c + 6) for a, b, c in caps]
    for i in range(6):
        j = (i + 1) % 6
        faces += [(i, j, j + 6), (i, j + 6, i + 6)]
    path = write_obj(tmp_path, 0.04 * np.concatenate([bottom, top]), faces)
    with pytest.warns(UserWarning, match="fills 86% of its convex hull"):
        Body(path)


@pytest.mark.parametrize("writer", [write_obj, write_stl])
def test_a_mesh_that_is_not_closed_is_refused(tmp_path, writer):
    path = writer(tmp_path, box_corners((0.06, 0.04, 0.12)), BOX_FACES[:-1])
    with pytest.raises(InputError, match="not closed: 3 of its edges"):
        Body(path)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("thing.ply", "ply", r"thing\.ply: an object is an MJCF .*\.obj, \.stl"),
        ("thing.xml", "<mujoco>", "MuJoCo cannot read"),
        ("thing.obj", "v 0 0\n", "MuJoCo cannot read"),
        ("thing.stl", "solid thing\nendsolid\n", "MuJoCo cannot read"),
        ("thing.xml", mjcf("<geom type='plane' size='1 1 1'/>"), "must be one of: sphere"),
        ("thing.xml", mjcf("<geom size='0.1'/><body><joint name='lid'/><geom size='0.1'/></body>"),
         "rigid piece; joint 'lid'"),
        ("thing.xml", mjcf("<geom size='0.1'/></body><body name='b'><geom size='0.1'/>"),
         "one object; the bodies in it that have geoms: 'thing', 'b'"),
        ("thing.xml", "<mujoco/>", "one object.*none"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_object_is_told_in_one_line(tmp_path, name, text, message):
    with pytest.raises(InputError, match=message) as told:
        Body(write(tmp_path, text, name))
    assert "\n" not in str(told.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"no file .*gone\.xml"):
        Body(tmp_path / "gone.xml")


def test_a_free_joint_makes_no_difference(tmp_path):
    core = "<geom type='sphere' size='0.05'/>"
    loose = write(tmp_path, mjcf("<freejoint/>" + core), "loose.xml")
    assert Body(loose).content == Body(write(tmp_path, mjcf(core), "fixed.xml")).content


def test_a_body_is_a_value_that_knows_its_content(tmp_path, monkeypatch):
    path = write(tmp_path, mjcf("<geom type='sphere' size='0.05'/>"), "thing.xml")
    monkeypatch.chdir(tmp_path)
    body = Body("thing.xml")
    assert body.file == str(path) and body == Body(path) and hash(body) == hash(Body(path))
    assert eval(repr(body)) == body
    Scene(object=body).save(tmp_path / "scene.json")
    assert Scene.load(tmp_path / "scene.json") == Scene(object=body)
    copy = pickle.loads(pickle.dumps(Scene(object=body)))
    path.write_text(mjcf("<geom type='sphere' size='0.04'/>"))
    assert copy.model.geom(OBJECT).size[0] == 0.05  # it travels without its file
    assert Body(path) != body
    assert Fingerprint(Body(path)).parts != Fingerprint(body).parts
    with pytest.raises(ResultsError, match=r"thing\.xml has changed"):
        Scene.load(tmp_path / "scene.json")
    with pytest.raises(InputError, match=r"thing\.xml has changed"):
        eval(repr(body))


TURNED = mjcf(
    "<geom type='box' size='0.02 0.03 0.05' pos='0.01 0.02 0' euler='20 0 40'/>"
    "<body pos='0 0.01 0.04' euler='0 60 0'><geom type='capsule' size='0.01 0.02' pos='0 0 0.02'/>"
    "</body>"
)


def test_geoms_stand_as_they_are_turned_in_the_file_whatever_the_scale(tmp_path):
    """Seen from the middle of the box around all of them, the body's own turn is the file's."""
    path = write(tmp_path, TURNED, "thing.xml")
    spec = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(spec)
    mujoco.mj_kinematics(spec, data)
    for scale in (1.0, 0.5):
        scene = Scene(object=Body(path, scale=scale))
        model, there = scene.model, mujoco.MjData(scene.model)
        mujoco.mj_kinematics(model, there)
        apart = []
        for g, name in enumerate((OBJECT, f"{OBJECT}_1")):
            geom = model.geom(name).id
            np.testing.assert_allclose(there.geom_xmat[geom], data.geom_xmat[g], atol=1e-9)
            np.testing.assert_allclose(model.geom_size[geom], scale * spec.geom_size[g])
            apart.append(there.geom_xpos[geom] - scale * data.geom_xpos[g])
        np.testing.assert_allclose(apart[0], apart[1], atol=1e-9)
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for name in (OBJECT, f"{OBJECT}_1"):
            geom = model.geom(name).id
            signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
            box = model.geom_aabb[geom, :3] + signs * model.geom_aabb[geom, 3:]
            points = there.geom_xpos[geom] + box @ there.geom_xmat[geom].reshape(3, 3).T
            low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
        np.testing.assert_allclose((low + high) / 2, scene.position, atol=1e-9)


GEOM = "<geom type='box' size='0.02 0.03 0.05' pos='0 0 {z}' euler='0 0 {turn}' {more}/>"
PLAIN = {"z": 0, "turn": 0, "more": ""}


@pytest.mark.parametrize(
    "other",
    [
        {"z": 0.01},
        {"turn": 10},
        {"more": "rgba='1 0 0 1'"},
        {"more": "contype='0' conaffinity='0'"},
    ],
)
def test_content_tells_shapes_that_differ_in_place_turn_look_or_touch(tmp_path, other):
    core = "<geom type='sphere' size='0.04'/>"
    plain = Body(write(tmp_path, mjcf(core + GEOM.format(**PLAIN)), "a.xml"))
    differs = Body(write(tmp_path, mjcf(core + GEOM.format(**PLAIN | other)), "b.xml"))
    same = Body(write(tmp_path, mjcf(core + GEOM.format(**PLAIN)), "c.xml"))
    assert plain.content == same.content != differs.content
    assert plain.content.startswith("sha256:")


@pytest.mark.parametrize(
    ("size", "message"),
    [(0.9, ""), (1.1, "--scale 0.001"), (0.006, ""), (0.004, "too small to be grasped")],
)
def test_a_body_is_between_half_a_centimetre_and_a_metre_large(tmp_path, size, message):
    path = write(tmp_path, mjcf(f"<geom type='sphere' size='{size / 2}'/>"), "thing.xml")
    if not message:
        assert Body(path).content
        return
    with pytest.raises(InputError, match=message):
        Body(path)


def test_the_side_of_an_upright_object_is_steep_and_a_rounded_one_leans_by_thirty_degrees():
    assert Body.steepest == pytest.approx(np.sin(np.radians(30)))
    assert np.degrees(np.arcsin([Cylinder.steepest, Prism.steepest])).max() < 3.0
    assert Cylinder(0.05).height == Prism(((1, 0), (0, 1), (-1, -1))).height == 0.12


@pytest.mark.parametrize(("notch", "warns"), [(0.08, False), (0.3, True)])
def test_a_mesh_that_fills_nine_tenths_of_its_hull_is_taken_without_a_word(tmp_path, notch, warns):
    """A square with a corner cut inwards, extruded: it fills 1 − notch/2 of its hull."""
    outline = [(0, 0), (1, 0), (1, 1), (0.5, 1 - notch), (0, 1)]
    bottom, top = np.array([(*p, 0) for p in outline]), np.array([(*p, 1) for p in outline])
    caps = [(0, 1, 3), (1, 2, 3), (0, 3, 4)]
    faces = [(a, c, b) for a, b, c in caps] + [(a + 5, b + 5, c + 5) for a, b, c in caps]
    for i in range(5):
        j = (i + 1) % 5
        faces += [(i, j, j + 5), (i, j + 5, i + 5)]
    path = write_obj(tmp_path, 0.08 * np.concatenate([bottom, top]), faces)
    if not warns:
        assert Body(path).content
        return
    with pytest.warns(UserWarning, match=f"fills {1 - notch / 2:.0%} of its convex hull"):
        Body(path)
