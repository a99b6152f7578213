"""The simulated scene: what stands on what, weighs what, and which joints are driven."""

import mujoco
import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.world.physics import (
    CONTACTS,
    SUPPORT,
    SUPPORTS,
    foot,
    palm_sensors,
    servos,
    simulated_model,
)

OBJECT = "object"


@pytest.fixture(scope="module")
def scene():
    return hg.Scene(object=hg.Cylinder(0.05))


@pytest.mark.parametrize("support", SUPPORTS)
def test_an_object_at_rest_stays_where_it_was_put(scene, support):
    model = simulated_model(scene, hg.Physics("stiff", support))
    data = mujoco.MjData(model)
    robot = scene.articulated
    q = robot.opened(robot.home)
    q[1] -= 0.6  # the hand is out of the way
    data.qpos[: robot.model.njnt] = robot.coupling @ q + robot.offset
    data.ctrl[servos(model, robot.joints)] = q
    mujoco.mj_step(model, data, 250)
    np.testing.assert_allclose(data.body(OBJECT).xpos, scene.position, atol=1e-4)
    np.testing.assert_allclose(data.qpos[: robot.model.njnt], robot.coupling @ q, atol=2e-3)


@pytest.mark.parametrize("support", ["pedestal", "table"])
def test_a_free_object_weighs_what_it_is_told_and_stands_on_its_foot(scene, support):
    model = simulated_model(scene, hg.Physics(support=support, mass=0.37))
    assert model.body(OBJECT).mass[0] == pytest.approx(0.37)
    assert model.body_subtreemass[model.body(OBJECT).id] == pytest.approx(0.37)
    bottom, width = foot(scene)
    ground = model.geom(SUPPORT)
    half = ground.size[1] if support == "pedestal" else ground.size[2]
    assert ground.pos[2] + half == pytest.approx(bottom)
    assert width == pytest.approx(0.05)


@pytest.mark.parametrize("contact", CONTACTS)
def test_the_object_decides_how_a_contact_yields_and_rubs(scene, contact):
    model = simulated_model(scene, hg.Physics(contact, friction=0.33))
    thing = np.flatnonzero(model.geom_bodyid == model.body(OBJECT).id)
    others = np.flatnonzero(model.geom_bodyid != model.body(OBJECT).id)
    assert model.geom_priority[thing].min() > model.geom_priority[others].max()
    np.testing.assert_allclose(model.geom_friction[thing, 0], 0.33)
    np.testing.assert_allclose(model.geom_solref[thing], [CONTACTS[contact][0]] * len(thing))


def test_joints_that_move_no_tip_stand_fixed_where_home_has_them():
    scene = hg.Scene(robot="umass_torso", object=hg.Cylinder(0.065))
    robot = scene.articulated
    model = simulated_model(scene, hg.Physics())
    names = {model.joint(j).name for j in range(model.njnt)}
    for joint, idle in zip(robot.joints, robot.idle, strict=True):
        assert (joint in names) is not idle
    data, there = mujoco.MjData(model), mujoco.MjData(scene.model)
    robot.place(there, robot.home)
    for j in range(model.njnt):
        at = scene.model.joint(model.joint(j).name).qposadr[0]
        data.qpos[model.jnt_qposadr[j]] = there.qpos[at]
    mujoco.mj_kinematics(model, data)
    for body in range(model.nbody):
        name = model.body(body).name
        np.testing.assert_allclose(data.body(name).xpos, there.body(name).xpos, atol=1e-9)


# ---------------------------------------------------------------- an object and a hand, turned

TILTED = """
<mujoco><compiler angle="radian"/><worldbody><body name="thing" euler="0.3 0.2 0.5">
  <geom type="box" size="0.02 0.03 0.05" pos="0.01 0.02 0" euler="0.4 0 0.7"/>
  <body pos="0 0.01 0.04" euler="0 1 0">
    <geom type="ellipsoid" size="0.01 0.02 0.03" pos="0 0 0.02" rgba="0.1 0.2 0.3 1"/>
  </body>
  <geom type="sphere" size="0.2" contype="0" conaffinity="0"/>
</body></worldbody></mujoco>"""


def corners(model, data, name):
    """Of the box around a geom, in its own frame; world."""
    geom = model.geom(name).id
    middle, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
    return data.geom_xpos[geom] + (middle + signs * half) @ data.geom_xmat[geom].reshape(3, 3).T


@pytest.fixture(scope="module")
def tilted(tmp_path_factory):
    path = tmp_path_factory.mktemp("tilted") / "thing.xml"
    path.write_text(TILTED)
    return hg.Scene("bhand", hg.Body(path), (0.1, 0.2, 0.3), hand_above())


def hand_above():
    return (0.1, 0.2, 0.9, 1.0, 0.0, 0.0, 0.0)


def test_a_foot_is_the_lowest_and_narrowest_of_what_is_felt_as_it_is_turned(tilted):
    model, data = tilted.model, mujoco.MjData(tilted.model)
    mujoco.mj_kinematics(model, data)
    points = np.concatenate([corners(model, data, n) for n in (OBJECT, f"{OBJECT}_1")])
    low, high = points.min(axis=0), points.max(axis=0)
    np.testing.assert_allclose((low + high) / 2, tilted.position, atol=1e-9)
    bottom, width = foot(tilted)
    assert bottom == pytest.approx(low[2])
    assert width == pytest.approx(min(high[0] - low[0], high[1] - low[1]) / 2)


def test_a_foot_of_a_mesh_is_that_of_its_corners_wherever_its_own_frame_is(tmp_path):
    """MuJoCo keeps a flat pyramid in a frame of its own: about its centroid, z along x."""
    corners = ((0.06, 0.04, 0), (-0.06, 0.04, 0), (-0.06, -0.04, 0), (0.06, -0.04, 0), (0, 0, 0.04))
    faces = ((1, 3, 2), (1, 4, 3), (1, 2, 5), (2, 3, 5), (3, 4, 5), (4, 1, 5))
    lines = ["v {} {} {}".format(*c) for c in corners] + ["f {} {} {}".format(*f) for f in faces]
    (tmp_path / "pyramid.obj").write_text("\n".join(lines) + "\n")
    scene = hg.Scene("bhand", hg.Body(tmp_path / "pyramid.obj"), (0.1, 0.2, 0.5), hand_above())
    np.testing.assert_allclose(foot(scene), (0.48, 0.04), atol=1e-6)


@pytest.mark.parametrize("support", ["pedestal", "table"])
def test_a_support_is_below_the_object_and_carries_it(tilted, support):
    model = simulated_model(tilted, hg.Physics(support=support, mass=0.37))
    ground, (bottom, width) = model.geom(SUPPORT), foot(tilted)
    np.testing.assert_allclose(ground.pos[:2], tilted.position[:2])
    if support == "pedestal":
        assert ground.size[0] == pytest.approx(width / 2)
        assert ground.pos[2] - ground.size[1] == pytest.approx(0.0, abs=1e-9)  # from the floor up
        assert ground.pos[2] + ground.size[1] == pytest.approx(bottom)
    else:
        np.testing.assert_allclose(ground.size, [0.3, 0.3, 0.02])
        assert ground.pos[2] + ground.size[2] == pytest.approx(bottom)


def test_a_pedestal_under_what_stands_on_the_floor_goes_below_it():
    scene = hg.Scene("bhand", hg.Cylinder(0.03, 0.1), (0.0, 0.0, 0.055), hand_above())
    ground = simulated_model(scene, hg.Physics(support="pedestal")).geom(SUPPORT)
    assert ground.size[1] == pytest.approx(0.02)
    assert ground.pos[2] + 0.02 == pytest.approx(0.005)


def test_a_free_objects_inertia_is_that_of_its_felt_shapes_at_one_density(tilted):
    light, heavy = (
        simulated_model(tilted, hg.Physics(support="table", mass=mass)) for mass in (0.2, 0.6)
    )
    body = light.body(OBJECT).id
    np.testing.assert_allclose(heavy.body_inertia[body], 3.0 * light.body_inertia[body])
    assert heavy.body_mass[body] == pytest.approx(0.6)
    np.testing.assert_allclose(heavy.body_ipos[body], light.body_ipos[body])
    # Without what is only drawn, a ball of 0.2 m, the inertia is that of a few centimetres.
    assert light.body_inertia[body].max() < 0.2 * 0.06**2
    box, ellipsoid = 8 * 0.02 * 0.03 * 0.05, 4 / 3 * np.pi * 0.01 * 0.02 * 0.03
    at = [light.geom(n).pos for n in (OBJECT, f"{OBJECT}_1")]
    middle = (box * at[0] + ellipsoid * at[1]) / (box + ellipsoid)
    np.testing.assert_allclose(light.body_ipos[body], middle, atol=1e-6)


@pytest.mark.parametrize("error", [0.0, 0.03, -0.02])
def test_motors_carry_all_of_the_links_weight_but_the_error(scene, error):
    about = hg.Imperfections(gravity_error=error)
    model = simulated_model(scene, hg.Physics(support="table", imperfections=about))
    thing = model.body(OBJECT).id
    links = [b for b in range(1, model.nbody) if b != thing]
    np.testing.assert_allclose(model.body_gravcomp[links], 1.0 + error)
    assert model.body_gravcomp[thing] == 0.0


def test_contacts_are_solved_as_the_page_says(scene):
    model = simulated_model(scene, hg.Physics("default", timestep=0.001, friction=0.4))
    thing = model.geom(OBJECT).id
    assert model.opt.timestep == 0.001 and model.opt.impratio == 10.0
    assert model.opt.tolerance == 1e-10 and model.opt.noslip_iterations == 0
    assert model.opt.cone == int(mujoco.mjtCone.mjCONE_ELLIPTIC)
    assert model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    np.testing.assert_allclose(model.geom_friction[thing], [0.4, 0.02, 1e-4])
    np.testing.assert_allclose(model.geom_solref[thing], [0.02, 1.0])  # MuJoCo's own, by its name
    np.testing.assert_allclose(model.geom_solimp[thing], [0.9, 0.95, 0.001, 0.5, 2.0])
    assert model.geom_condim[thing] == 4  # friction, and torque about the normal
    stiffness = [CONTACTS[name][0][0] for name in ("stiff", "medium", "default")]
    np.testing.assert_allclose(stiffness, [0.005, 0.01, 0.02])


def test_what_may_pass_is_all_but_the_links_that_bear_the_tips(scene):
    model = simulated_model(scene, hg.Physics(), links="pass")
    thing, robot = model.body(OBJECT).id, scene.articulated
    out = {tuple(sorted((s >> 16, s & 0xFFFF))) for s in model.exclude_signature.tolist()}
    tips = {int(model.geom(name).bodyid[0]) for name in ("f1_tip", "f2_tip", "f3_tip")}
    for body in range(1, model.nbody):
        if body != thing:
            assert (tuple(sorted((body, thing))) in out) == (body not in tips)
    assert len(tips) == 3 == len(robot.geoms)
    plain = simulated_model(scene, hg.Physics(), feeling=False)
    assert plain.nexclude == scene.model.nexclude
    assert plain.nsensor < model.nsensor


def test_the_palms_sensors_say_where_the_object_is_in_its_frame(scene):
    model = simulated_model(scene, hg.Physics(support="table"))
    data, robot = mujoco.MjData(model), scene.articulated
    data.qpos[: robot.model.njnt] = robot.coupling @ robot.home + robot.offset
    at = model.joint(OBJECT).qposadr[0]
    data.qpos[at : at + 7] = [0.7, 0.1, 0.3, np.cos(0.3), 0, np.sin(0.3), 0]
    mujoco.mj_forward(model, data)
    read = data.sensordata[palm_sensors(model)]
    body = robot.model.body(robot.groups[0].palm_body).name
    R, p = data.body(body).xmat.reshape(3, 3), data.body(body).xpos
    np.testing.assert_allclose(read[:3], R.T @ (data.qpos[at : at + 3] - p), atol=1e-9)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, read[3:])
    np.testing.assert_allclose(
        R @ turn.reshape(3, 3), data.body(OBJECT).xmat.reshape(3, 3), atol=1e-9
    )


IDLE = """
<mujoco><compiler angle="radian" autolimits="true"/><worldbody>
  <body name="trunk" pos="0.1 0.2 0.3" euler="0.3 0.5 0.7">
    <geom size="0.01" mass="1"/>
    <body name="still" pos="0.1 0 0" euler="0.2 0 0.4">
      <joint name="still" axis="0 0.6 0.8" pos="0.02 0.01 0" range="-2 2"/>
      <joint name="along" type="slide" axis="1 0 0" range="-1 1"/>
      <geom size="0.01" mass="1" contype="0" conaffinity="0"/>
      <body name="further" pos="0.1 0.05 0" euler="0 0.3 0">
        <joint name="further" axis="1 0 0" range="-2 2"/>
        <geom size="0.01" mass="1" contype="0" conaffinity="0"/>
      </body>
    </body>
    <body name="finger" pos="-0.1 0 0">
      <joint name="finger" axis="0 1 0" range="-2 2"/>
      <geom name="tip" size="0.01" pos="0 0 0.1" mass="1"/><site name="tip" pos="0 0 0.1"/>
    </body>
  </body>
</worldbody>
<equality><joint joint1="further" joint2="still" polycoef="0.1 0.5 0 0 0"/></equality>
<actuator><position joint="finger" kp="1" forcerange="-1 1"/>
<position joint="still" kp="1" forcerange="-1 1"/></actuator></mujoco>"""


def test_braked_links_stand_turned_as_home_has_them(tmp_path):
    (tmp_path / "idle.xml").write_text(IDLE)
    (tmp_path / "idle.toml").write_text(
        'model = "idle.xml"\nhome = { still = 0.7, along = 0.3, finger = 0.2 }\n'
        'workspace = [0, 0, 1]\n[[contact_points]]\nname = "tip"\nsite = "tip"\ngeom = "tip"\n'
    )
    scene = hg.Scene(tmp_path / "idle.toml", hg.Cylinder(0.02))
    model, robot = simulated_model(scene, hg.Physics()), scene.articulated
    assert [model.joint(j).name for j in range(model.njnt)] == ["finger"]
    assert model.neq == 0 and model.nu == 1
    data, there = mujoco.MjData(model), mujoco.MjData(scene.model)
    robot.place(there, robot.home)
    data.qpos[:] = 0.2
    mujoco.mj_kinematics(model, data)
    for b in range(model.nbody):
        np.testing.assert_allclose(data.xpos[b], there.body(model.body(b).name).xpos, atol=1e-9)
        np.testing.assert_allclose(data.xmat[b], there.body(model.body(b).name).xmat, atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "many"),
    [
        ('joint="finger" kp="1" forcerange="-1 1"', 'joint="finger" kp="1"', 0),
        ('<position joint="finger" kp="1"', '<motor joint="finger" gear="1"', 0),
        ("<actuator>", '<actuator><position joint="finger" kp="2" forcerange="-1 1"/>', 2),
    ],
)
def test_a_joint_has_one_servo_with_a_limit_or_is_refused(old, new, many):
    assert IDLE.count(old) == 1
    model = mujoco.MjModel.from_xml_string(IDLE.replace(old, new))
    with pytest.raises(hg.ModelError, match=f"'finger' needs one position .*; it has {many}"):
        servos(model, ("still", "finger"))
    plain = mujoco.MjModel.from_xml_string(IDLE)
    np.testing.assert_array_equal(servos(plain, ("still", "finger")), [1, 0])
