"""mink's limits as ours: what one of them says of itself."""

import mink
import numpy as np
import pytest

from hqp_grasp.tasks import MinkLimit
from hqp_grasp.world.scene import Scene


@pytest.fixture(scope="module")
def model():
    return Scene().model


def velocity(model, speed=0.5, joint="wam_j1"):
    return MinkLimit(mink.VelocityLimit(model, {joint: speed}))


def clearance(model, link="f3_distal", distance=0.01):
    pairs = [([link], ["object"])]
    limit = mink.CollisionAvoidanceLimit(model, pairs, collision_detection_distance=distance)
    return MinkLimit(limit)


def ranges(model, gain=0.5):
    return MinkLimit(mink.ConfigurationLimit(model, gain))


@pytest.mark.parametrize("limit", [velocity, clearance, ranges])
def test_equal_limits_read_alike_and_name_no_address(model, limit):
    assert repr(limit(model)) == repr(limit(Scene().model))
    assert " at 0x" not in repr(limit(model))


def test_limits_that_differ_in_anything_read_otherwise(model):
    """To the last digit, and in the names that were turned into numbers."""
    limits = [
        *(velocity(model, speed) for speed in (0.5, np.nextafter(0.5, 1.0))),
        velocity(model, joint="wam_j2"),
        MinkLimit(velocity(model).limit, dt=0.5),
        clearance(model),
        clearance(model, link="f2_distal"),
        clearance(model, distance=0.02),
        ranges(model),
        ranges(model, gain=0.6),
    ]
    assert len({repr(limit) for limit in limits}) == len(limits)


def test_ranges_are_told_joint_by_joint(model):
    upper = model.jnt_range[:, 1].tolist()
    assert f"upper={upper}" in repr(ranges(model))
