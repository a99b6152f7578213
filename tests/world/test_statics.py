"""Torques at rest: of contacts on any link, of the robot's own weight, and of its motors."""

import mujoco
import numpy as np
import pytest
import tiny_hand
from tiny_hand import change

import hqp_grasp as hg
from hqp_grasp.errors import InputError, ModelError
from hqp_grasp.grasp import Contact, Grasp
from hqp_grasp.world.description import RobotDescription
from hqp_grasp.world.robot import compiled
from hqp_grasp.world.second_opinion import second_opinion
from hqp_grasp.world.statics import contact_jacobian, torque_limits, weight_torque

STEP = 1e-6  # [rad, m]
MOTORS = """
  <actuator>
    <position joint="lift" kp="100" forcerange="-50 80"/>
    <motor joint="proximal" gear="3" forcerange="-2 2"/>
  </actuator>
</mujoco>"""


def tiny(folder, xml):
    tiny_hand.write(folder, xml)
    about = RobotDescription.load(folder)
    return hg.Robot(about, compiled(about))


def with_motors(motors=MOTORS, xml=tiny_hand.XML):
    return xml.replace("</mujoco>", motors)


def alone(name):
    about = RobotDescription.load(name)
    return hg.Robot(about, compiled(about))


def drawn(robot, rng):
    low, high = np.maximum(robot.q_lower, -2.0), np.minimum(robot.q_upper, 2.0)
    return rng.uniform(low, high)


@pytest.mark.parametrize("name", ["bhand", "wam_bhand"])
def test_pinocchio_and_mujoco_hold_the_same_weight(name):
    (part,) = RobotDescription.load(name).files
    both = second_opinion(part)
    assert both.reason == "" and both.weight < 1e-9
    assert weight_torque(alone("wam_bhand"), np.zeros(11)).any()


@pytest.mark.parametrize("name", ["bhand", "wam_bhand", "umass_torso"])
def test_the_torque_that_holds_the_weight_is_the_slope_of_its_energy(name):
    """All masses count, also of bodies whose weight the model compensates."""
    robot, rng = alone(name), np.random.default_rng(0)
    model = robot.model
    assert model.body_gravcomp.any()
    data = mujoco.MjData(model)

    def energy(q):
        data.qpos[:] = robot.coupling @ q + robot.offset
        mujoco.mj_kinematics(model, data)
        return -(model.body_mass * (data.xipos @ model.opt.gravity)).sum()

    q = drawn(robot, rng)
    slopes = [(energy(q + d) - energy(q - d)) / (2 * STEP) for d in STEP * np.eye(robot.n)]
    np.testing.assert_allclose(weight_torque(robot, q), slopes, atol=1e-6)


def test_contacts_on_any_link_move_as_that_link_does():
    robot, rng = alone("wam_bhand"), np.random.default_rng(1)
    links = ["f1_tip", "f2_proximal", "bhand_palm", "wam_link4", "f1_tip"]
    q = drawn(robot, rng)
    x = robot.centers(q).mean(axis=0) + 0.05 * rng.normal(size=(5, 3))
    contacts = tuple(Contact(p, [0.0, 0.0, 1.0], body=b) for p, b in zip(x, links, strict=True))
    grasp = Grasp(q, contacts, np.zeros((15, robot.n)))
    data, model = mujoco.MjData(robot.model), robot.model
    ids = [model.body(link).id for link in links]

    robot.place(data, q)
    local = [data.xmat[b].reshape(3, 3).T @ (p - data.xpos[b]) for b, p in zip(ids, x, strict=True)]

    def moved(turned):
        """Where the points are after the joints have moved."""
        robot.place(data, q + turned)
        R = data.xmat[ids].reshape(-1, 3, 3)
        return (data.xpos[ids] + (R @ np.array(local)[:, :, None])[..., 0]).ravel()

    slopes = [(moved(d) - moved(-d)) / (2 * STEP) for d in STEP * np.eye(robot.n)]
    np.testing.assert_allclose(contact_jacobian(robot, grasp), np.transpose(slopes), atol=1e-6)


def test_a_contact_on_a_link_that_the_robot_lacks_is_refused():
    robot = alone("bhand")
    grasp = Grasp(robot.home, (Contact(np.zeros(3), [0.0, 0, 1.0]),), np.zeros((3, robot.n)))
    with pytest.raises(InputError, match=r"contact 0 touches with body '', which bhand lacks"):
        contact_jacobian(robot, grasp)


def test_limits_are_the_actuators_with_their_gear(tmp_path):
    low, high = torque_limits(tiny(tmp_path, with_motors()))
    np.testing.assert_allclose(low, [-50.0, -6.0])
    np.testing.assert_allclose(high, [80.0, 6.0])


def test_a_motor_on_a_coupled_joint_drives_the_one_that_it_follows(tmp_path):
    motors = change(MOTORS, '<motor joint="proximal" gear="3"', '<motor joint="distal" gear="-3"')
    low, high = torque_limits(tiny(tmp_path, with_motors(motors)))
    np.testing.assert_allclose([low[1], high[1]], [-3.0, 3.0])  # at half the speed


def test_two_motors_of_a_joint_add_up_and_the_joints_own_limit_caps_them(tmp_path):
    two = change(MOTORS, "<motor", '<motor joint="proximal" forcerange="-1 2"/><motor')
    low, high = torque_limits(tiny(tmp_path, with_motors(two)))
    np.testing.assert_allclose([low[1], high[1]], [-7.0, 8.0])
    joint = 'name="proximal" axis="0 0 1" range="0 3"'
    capped = change(tiny_hand.XML, joint, f'{joint} actuatorfrcrange="-5 4"')
    low, high = torque_limits(tiny(tmp_path, with_motors(two, capped)))
    np.testing.assert_allclose([low[1], high[1]], [-5.0, 4.0])


def test_a_motors_control_limits_it_and_a_servos_does_not(tmp_path):
    motor = change(MOTORS, 'forcerange="-2 2"', 'ctrlrange="-1 3"')
    low, high = torque_limits(tiny(tmp_path, with_motors(motor)))
    np.testing.assert_allclose([low[1], high[1]], [-3.0, 9.0])
    both = change(MOTORS, 'forcerange="-2 2"', 'ctrlrange="-1 3" forcerange="-2 2"')
    low, high = torque_limits(tiny(tmp_path, with_motors(both)))
    np.testing.assert_allclose([low[1], high[1]], [-3.0, 6.0])
    servo = change(MOTORS, 'kp="100" forcerange="-50 80"', 'kp="100" ctrlrange="-0.5 0.5"')
    with pytest.raises(ModelError, match="no force limit for the motors of: lift; give"):
        torque_limits(tiny(tmp_path, with_motors(servo)))


TENDON = """
  <tendon><fixed name="pull"><joint joint="proximal" coef="0.5"/>{more}</fixed></tendon>
  <actuator>
    <position joint="lift" kp="100" forcerange="-50 80"/>
    <motor tendon="pull" gear="2" forcerange="0 2"/>
  </actuator>
</mujoco>"""


def test_a_motor_on_a_fixed_tendon_gives_what_its_lever_makes_of_it(tmp_path):
    low, high = torque_limits(tiny(tmp_path, with_motors(TENDON.format(more=""))))
    np.testing.assert_allclose([low[1], high[1]], [0.0, 2.0])


def test_a_motor_of_two_joints_and_a_joint_without_a_limit_are_told(tmp_path):
    both = TENDON.format(more='<joint joint="lift" coef="1"/>')
    with pytest.raises(ModelError, match=r"actuator .* drives 'lift', 'proximal' at once"):
        torque_limits(tiny(tmp_path, with_motors(both)))
    with pytest.raises(ModelError, match=r"no force limit for the motors of: lift, proximal; give"):
        torque_limits(tiny(tmp_path, tiny_hand.XML))
    for ends in ("-inf 2", "-2 inf"):
        with pytest.raises(ModelError, match=r"no force limit for the motors of: proximal; give"):
            torque_limits(tiny(tmp_path, with_motors(change(MOTORS, "-2 2", ends))))
    unlimited = change(MOTORS, ' gear="3" forcerange="-2 2"', "")
    with pytest.raises(ModelError, match=r"no force limit for the motors of: proximal; give"):
        torque_limits(tiny(tmp_path, with_motors(unlimited)))


def test_the_other_arm_of_a_torso_needs_no_limits():
    robot = alone("umass_torso")
    idle = [robot.model.joint(robot.joints[j]).id for j in np.flatnonzero(robot.idle)]
    robot.model.actuator_forcelimited[np.isin(robot.model.actuator_trnid[:, 0], idle)] = 0
    low, _ = torque_limits(robot)
    assert np.isfinite(low[~robot.idle]).all()
