"""What is read is what is on disk: files written again within a second, emptied, or cut off."""

import os
import struct
import zlib

import mujoco
import numpy as np
import pytest
import tiny_hand

from hqp_grasp.errors import InputError
from hqp_grasp.experiments.fingerprint import Fingerprint
from hqp_grasp.world.description import RobotDescription
from hqp_grasp.world.objects import OBJECT, Body
from hqp_grasp.world.robot import compiled
from hqp_grasp.world.scene import Scene

CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
FACES = np.array([
    (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
    (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
])  # fmt: skip
TOL = 1e-8  # [m] meshes are kept in single precision
SMALL, LARGE = 0.02, 0.03  # [m] half an edge


def obj(half):
    lines = [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in half * CORNERS]
    return "\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in FACES + 1)]).encode() + b"\n"


def stl(half):
    triangles = (struct.pack("<12fH", 0, 0, 0, *t.ravel(), 0) for t in half * CORNERS[FACES])
    return bytes(80) + struct.pack("<I", len(FACES)) + b"".join(triangles)


def msh(half):
    return struct.pack("<4i", 8, 0, 0, 0) + (half * CORNERS).astype("<f4").tobytes()


WRITERS = {".obj": obj, ".stl": stl, ".msh": msh}
MESH = (
    '<mujoco><compiler meshdir="{folder}"/><asset><mesh name="m" file="{file}"/></asset>'
    '<worldbody><body name="thing"><geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
)
URDF = """<robot name="one"><link name="palm"><inertial><mass value="1"/>
<inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="finger"><inertial><mass value="1"/>
<inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><mesh filename="{file}"/></geometry></collision></link>
<joint name="bend" type="revolute"><parent link="palm"/><child link="finger"/>
<axis xyz="0 0 1"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint></robot>"""
POINT = '[[contact_points]]\nname = "finger"\nlink = "{link}"\n'


def object_mesh(folder, mesh):
    return Body(folder / mesh)


def object_mjcf(folder, mesh, meshdir="."):
    (folder / "thing.xml").write_text(MESH.format(folder=meshdir, file=mesh))
    return Body(folder / "thing.xml")


def object_that_includes(folder, mesh):
    whole = MESH.format(folder=".", file=mesh)
    start, end = whole.index("<asset>"), whole.index("<worldbody>")
    part = f"<mujocoinclude>{whole[start:end]}</mujocoinclude>"
    (folder / "part.xml").write_text(part)
    (folder / "thing.xml").write_text(whole[:start] + '<include file="part.xml"/>' + whole[end:])
    return Body(folder / "thing.xml")


def robot_mjcf(folder, mesh):
    xml = tiny_hand.change(
        tiny_hand.XML,
        '<geom name="tip" type="sphere" size="0.01" pos="0.04 0 0" mass="0"/>',
        '<geom name="tip" type="mesh" mesh="m" mass="0"/>',
    ).replace("<worldbody>", f'<asset><mesh name="m" file="{mesh}"/></asset><worldbody>')
    toml = tiny_hand.change(tiny_hand.TOML, 'site = "tip_center"\n', "")
    return robot(tiny_hand.write(folder, xml, toml))


def robot_urdf(folder, mesh):
    (folder / "one.urdf").write_text(URDF.format(file=mesh))
    (folder / "robot.toml").write_text('model = "one.urdf"\n' + POINT.format(link="finger"))
    return robot(folder)


def robot_on_a_carriage(folder, mesh):
    (folder / "one.urdf").write_text(URDF.format(file=mesh))
    toml = 'model = "one.urdf"\ncarriage = true\npalm = { body = "palm" }\nworkspace = [0, 0, 0]\n'
    (folder / "robot.toml").write_text(toml + POINT.format(link="finger"))
    return robot(folder)


def robot(folder):
    return compiled(RobotDescription.load(folder))


def half_edge(thing):
    """Of the cube that was read [m]."""
    model = Scene(object=thing).model if isinstance(thing, Body) else thing
    geoms = [g for g in range(model.ngeom) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH]
    half = model.geom_aabb[geoms[-1], 3:]
    assert np.ptp(half) < TOL
    return float(half[0])


def stamped(path, data):
    """Write `path` and leave its time stamp as it was."""
    before = path.stat()
    path.write_bytes(data)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


EVERY = [
    (reader, suffix)
    for reader in (object_mesh, object_mjcf, object_that_includes, robot_mjcf, robot_urdf)
    for suffix in WRITERS
    if (reader, suffix) != (object_mesh, ".msh")  # no object
] + [(robot_on_a_carriage, ".obj")]


@pytest.fixture(autouse=True)
def kept_by_mujoco():
    """MuJoCo keeps assets unless it is told not to, also after someone else asked for that."""
    mujoco.mj_setCacheCapacity(mujoco.mj_getCache(), 500 * 2**20)


@pytest.mark.parametrize(("reader", "suffix"), EVERY)
def test_a_mesh_written_again_with_the_same_time_stamp_is_read_again(tmp_path, reader, suffix):
    mesh, write = tmp_path / f"m{suffix}", WRITERS[suffix]
    mesh.write_bytes(write(SMALL))
    first = reader(tmp_path, mesh.name)
    assert abs(half_edge(first) - SMALL) < TOL
    stamped(mesh, write(LARGE))
    second = reader(tmp_path, mesh.name)
    assert abs(half_edge(second) - LARGE) < TOL
    assert Fingerprint(first).parts != Fingerprint(second).parts
    stamped(mesh, write(SMALL))
    assert Fingerprint(reader(tmp_path, mesh.name)).parts == Fingerprint(first).parts


@pytest.mark.parametrize("length", [0.0, 0.3, 0.5, 0.75])
@pytest.mark.parametrize(("reader", "suffix"), EVERY)
def test_a_mesh_that_was_emptied_or_cut_off_is_refused_by_its_file(
    tmp_path, reader, suffix, length
):
    mesh = tmp_path / f"m{suffix}"
    whole = WRITERS[suffix](SMALL)
    mesh.write_bytes(whole)
    reader(tmp_path, mesh.name)
    stamped(mesh, whole[: int(length * len(whole))])
    with pytest.raises(InputError, match=rf"m\{suffix}") as told:
        reader(tmp_path, mesh.name)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("ending", "message"),
    [
        (b"", "has no faces"),
        (b"f 1 2 4\nf 5 8 6\nf 1 4", "ends amid the line 'f 1 4'"),
        (b"f 1 2 4\nf 1 8 6\n", "has 8 vertices, of which its faces use 5"),
        (b"f 1 2 4\nf 1 8 6\nf -8 -7 -5\nf -8 -1 -3\n", "has 8 vertices, of which its faces use 5"),
        (b"f 1 2 4\nf 1/1 8/1 6/7\n\n", "has 8 vertices, of which its faces use 5"),
        (b"f 1 2 4\nf 5 8 6\nf 3 1 4", "has 8 vertices, of which its faces use 7"),
    ],
)
def test_an_obj_that_ends_early_is_refused_for_what_shows_it(tmp_path, ending, message):
    (tmp_path / "m.obj").write_bytes(obj(SMALL).partition(b"f ")[0] + ending)
    with pytest.raises(InputError, match=f"m.obj {message}; was it cut off"):
        robot_mjcf(tmp_path, "m.obj")


@pytest.mark.parametrize(
    "same",
    [
        lambda text: text.replace(b"\n", b"\r\n"),
        lambda text: text.rstrip(),
        lambda text: text.replace(b"f ", b"  f\t").replace(b"v ", b" v "),
        lambda text: b"# a cube\ng cube\ns off\n" + text + b"# end\n\n",
        lambda text: b"\n".join(  # the last vertex is −1
            b"f %d %d %d" % tuple(int(i) - 9 for i in line.split()[1:])
            if line.startswith(b"f")
            else line
            for line in text.splitlines()
        ),
    ],
)
def test_a_whole_obj_is_read_however_it_is_written(tmp_path, same):
    (tmp_path / "m.obj").write_bytes(same(obj(SMALL)))
    assert abs(half_edge(robot_mjcf(tmp_path, "m.obj")) - SMALL) < TOL


def test_an_include_written_again_with_the_same_time_stamp_is_read_again(tmp_path):
    part = "<mujocoinclude><geom type='sphere' size='{}'/></mujocoinclude>"
    whole = "<mujoco><worldbody><body><include file='part.xml'/></body></worldbody></mujoco>"
    (tmp_path / "thing.xml").write_text(whole)
    (tmp_path / "part.xml").write_text(part.format(SMALL))
    first = Body(tmp_path / "thing.xml")
    stamped(tmp_path / "part.xml", part.format(LARGE).encode())
    second = Body(tmp_path / "thing.xml")
    assert second != first
    assert Scene(object=second).model.geom(OBJECT).size[0] == LARGE


def test_a_link_to_another_mesh_of_the_same_time_is_another_mesh(tmp_path):
    for name, half in (("small.stl", SMALL), ("large.stl", LARGE)):
        (tmp_path / name).write_bytes(stl(half))
        os.utime(tmp_path / name, (1e9, 1e9))
    for name, half in (("small.stl", SMALL), ("large.stl", LARGE)):
        (tmp_path / "m.stl").unlink(missing_ok=True)
        (tmp_path / "m.stl").symlink_to(name)
        assert abs(half_edge(object_mesh(tmp_path, "m.stl")) - half) < TOL


def test_meshes_of_one_name_in_two_folders_are_two(tmp_path):
    for folder, half in (("a", SMALL), ("b", LARGE)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "m.stl").write_bytes(stl(half))
        os.utime(tmp_path / folder / "m.stl", (1e9, 1e9))
        assert abs(half_edge(object_mjcf(tmp_path, "m.stl", folder)) - half) < TOL


def test_links_whose_meshes_have_one_name_in_two_folders_keep_their_own(tmp_path):
    second = URDF[URDF.index('<link name="finger">') :].replace("finger", "thumb")
    second = second.replace('"bend"', '"oppose"')
    urdf = URDF.format(file="a/m.stl").removesuffix("</robot>") + second.format(file="b/m.stl")
    (tmp_path / "one.urdf").write_text(urdf)
    points = [POINT.format(link=link).replace('"finger"\nlink', f'"{link}"\nlink')
              for link in ("finger", "thumb")]  # fmt: skip
    (tmp_path / "robot.toml").write_text('model = "one.urdf"\n' + "".join(points))
    for folder, half in (("a", SMALL), ("b", LARGE)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "m.stl").write_bytes(stl(half))
        os.utime(tmp_path / folder / "m.stl", (1e9, 1e9))
    half = robot(tmp_path).geom_aabb[:, 3]
    np.testing.assert_allclose(half, [SMALL, LARGE], atol=TOL)


def test_the_same_meshes_elsewhere_are_the_same_robot(tmp_path):
    prints = []
    for folder, half in (("a", SMALL), ("longer", SMALL), ("c", LARGE)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "m.stl").write_bytes(stl(half))
        prints.append(Fingerprint(robot_urdf(tmp_path / folder, "m.stl")).parts["trial"])
    assert prints[0] == prints[1] != prints[2]


def test_a_texture_written_again_with_the_same_time_stamp_is_read_again(tmp_path):
    """A robot's look is part of its model, and so of its fingerprint."""
    xml = tiny_hand.XML.replace(
        "<worldbody>",
        '<asset><texture name="t" type="2d" file="t.png"/></asset><worldbody>',
    )
    prints = []
    for grey in (0, 255):
        (tmp_path / "t.png").write_bytes(png(grey))
        os.utime(tmp_path / "t.png", (1e9, 1e9))
        model = robot(tiny_hand.write(tmp_path, xml))
        assert set(model.tex_data) == {grey}
        prints.append(Fingerprint(model).parts["trial"])
    assert prints[0] != prints[1]


def test_a_user_who_compiles_a_scene_reads_what_is_on_disk(tmp_path):
    (tmp_path / "m.obj").write_bytes(obj(SMALL))
    robot_urdf(tmp_path, "m.obj")
    spec = RobotDescription.load(tmp_path).spec()
    for half in (SMALL, LARGE):
        stamped(tmp_path / "m.obj", obj(half))
        assert abs(half_edge(spec.compile()) - half) < TOL


def png(grey):
    """2 × 2 pixels of one grey."""

    def chunk(kind, data):
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">2I5B", 2, 2, 8, 2, 0, 0, 0)
    rows = (b"\0" + bytes([grey] * 6)) * 2
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)
