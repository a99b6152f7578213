"""The comparison with Pinocchio: it finds what is apart, by how much, and says why it cannot."""

import pinocchio as pin
import pytest
import tiny_hand
from tiny_hand import XML, change

from hqp_grasp.world.description import ModelFile
from hqp_grasp.world.second_opinion import second_opinion

EXACT = 1e-9
HEAVY = change(
    change(XML, "</keyframe>", '</keyframe>\n<option gravity="1 -2 -9"/>'),
    '<geom name="tip" type="sphere" size="0.01" pos="0.04 0 0" mass="0"/>',
    '<geom name="tip" type="sphere" size="0.01" pos="0.04 0 0" mass="0"/><body name="nail" '
    'pos="0.05 0.01 0.02"><inertial mass="0.5" pos="0.01 0 0" diaginertia="1 1 1"/></body>',
)
# Leaning axes, so that weight acts on every joint; the second slide is without range.
HEAVY = change(HEAVY, 'axis="0 0 1" range="0 3"', 'axis="0 0.6 0.8" pos="0.01 0 0" range="0 3"')
HEAVY = change(HEAVY, 'axis="0 0 1" range="-0.1 0.8"', 'axis="0.8 0 0.6"')
PLACED = change(HEAVY, '<body name="palm">', '<body name="palm" pos="0.3 -0.2 0.5" euler="1 2 3">')
ON_A_FOOT = change(
    change(
        HEAVY,
        '<body name="palm">',
        '<body name="foot" pos="0.3 -0.2 0.5" euler="1 2 3"><inertial mass="1" pos="0 0 0" '
        'diaginertia="1 1 1"/><body name="palm" pos="0.1 0 0">',
    ),
    "</worldbody>",
    "</body></worldbody>",
)
FILES = {"at the origin": HEAVY, "moving, elsewhere": PLACED, "on a foot elsewhere": ON_A_FOOT}


def part(folder, xml=HEAVY, **about):
    tiny_hand.write(folder, xml)
    return ModelFile(folder / "tiny.xml", **about)


@pytest.mark.parametrize("name", FILES)
def test_both_read_a_file_alike_wherever_its_root_stands(tmp_path, name):
    both = second_opinion(part(tmp_path, FILES[name]))
    assert (both.file, both.reason) == ("tiny.xml", "")
    assert both.position < EXACT and both.jacobian < EXACT and both.weight < EXACT


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize(
    ("old", "new", "what", "by"),
    [
        ('pos="0.05 0.01 0.02"', 'pos="0.05 0.01 0.023"', "position", 0.003),
        ('pos="0.01 0 0" range', 'pos="0.012 0 0" range', "jacobian", None),
        ('inertial mass="0.5"', 'inertial mass="0.7"', "weight", None),
        ('gravity="1 -2 -9"', 'gravity="1 -2 -9.5"', "", None),  # each in the other's own
    ],
)
def test_what_is_read_otherwise_shows_in_its_own_measure(
    tmp_path, monkeypatch, name, old, new, what, by
):
    (tmp_path / "other").mkdir()
    other = part(tmp_path / "other", change(FILES[name], old, new)).file
    build = pin.buildModelFromMJCF
    monkeypatch.setattr(pin, "buildModelFromMJCF", lambda file: build(str(other)))
    both = second_opinion(part(tmp_path, FILES[name]))
    assert both.reason == ""
    if what == "":
        assert max(both.position, both.jacobian, both.weight) < EXACT
    elif by is not None:
        # of one coordinate: the body that carries it is turned
        assert 0.5 * by < both.position <= by + EXACT
    else:
        assert getattr(both, what) > 1e-4
    if what == "weight":
        assert max(both.position, both.jacobian) < EXACT
        if name == "at the origin":  # at the lift, which stands upright
            assert both.weight == pytest.approx(0.2 * 9.0)


@pytest.mark.parametrize(
    ("xml", "about", "reason"),
    [
        (HEAVY, {"degrees": True}, "reads its angles as the file says"),
        (HEAVY, {"root": "palm"}, "reads all of its root bodies"),
        ("<mujoco><worldbody><body/></worldbody></mujoco>", {}, "nothing in it moves"),
        (
            "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>",
            {},
            "a joint is neither hinge nor slide",
        ),
    ],
)
def test_what_is_not_compared_says_why_and_shows_no_difference(tmp_path, xml, about, reason):
    both = second_opinion(part(tmp_path, xml, **about))
    assert reason in both.reason
    assert (both.position, both.jacobian, both.weight) == (0.0, 0.0, 0.0)


def test_joints_that_pinocchio_does_not_find_are_counted(tmp_path, monkeypatch):
    build = pin.buildModelFromMJCF
    (tmp_path / "other").mkdir()
    other = part(tmp_path / "other", HEAVY.replace('"proximal"', '"knuckle"')).file
    monkeypatch.setattr(pin, "buildModelFromMJCF", lambda file: build(str(other)))
    assert second_opinion(part(tmp_path)).reason == "Pinocchio finds 3 joints, MuJoCo 3"


def test_what_pinocchio_raises_is_told_in_a_line(tmp_path, monkeypatch):
    def broken(file):
        raise RuntimeError("no\nidea")

    monkeypatch.setattr(pin, "buildModelFromMJCF", broken)
    assert second_opinion(part(tmp_path)).reason == "Pinocchio does not read it: no"
