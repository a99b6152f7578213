"""The simulated scene: what stands on what, weighs what, and which joints are driven."""

import mujoco
import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.world.physics import CONTACTS, SUPPORT, SUPPORTS, foot, servos, simulated_model

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
