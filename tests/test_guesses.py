"""What a user of other libraries tries first is there, or is answered by where it is."""

import copy
import pickle
from pathlib import Path

import pytest

import hqp_grasp as hg

HAND = Path(__file__).parents[1] / "robots" / "bhand"


@pytest.mark.parametrize(
    ("guess", "answer"),
    [
        ("FrameTask", "mink has it, and it goes into a stack as it is: stack >> mink.FrameTask"),
        ("ComTask", "stack >> mink.ComTask"),
        ("Configuration", "hg.Scene(…).articulated is the robot"),
        ("CollisionAvoidanceLimit", "hg.ClearanceLimit(robot) keeps a robot's own links apart"),
        ("Sphere", '<geom type="sphere" size="0.04"/>'),
        ("Box", "hg.Prism.box(x, y, z)"),
        ("Mesh", 'hg.Body("can.stl")'),
        ("ForceTasks", "did you mean hg.ForceTask?"),
    ],
)
def test_a_guessed_name_is_answered_by_where_it_is(guess, answer):
    with pytest.raises(AttributeError) as said:
        getattr(hg, guess)
    assert f"hqp_grasp has no {guess!r}; " in str(said.value) and answer in str(said.value)
    assert not hasattr(hg, guess)


def test_a_name_like_nothing_here_is_an_attribute_error_as_ever():
    with pytest.raises(AttributeError, match=r"hqp_grasp has no 'qwertz'$"):
        _ = hg.qwertz


def test_what_the_answers_name_is_there(tmp_path):
    import mink

    assert isinstance(hg.ForceTask() >> mink.ComTask(cost=1.0), hg.Stack)
    ball = tmp_path / "ball.xml"
    text = str(hg._ELSEWHERE["Sphere"])
    ball.write_text(text[text.index("<mujoco>") :])
    scene = hg.Scene(HAND, ball)
    assert scene.object == hg.Body(ball)
    assert hg.Prism.box(0.1, 0.1, 0.1).height == 0.1
    robot = scene.articulated
    assert robot.centers(robot.home).shape == (3, 3)
    assert isinstance(hg.ClearanceLimit(robot), hg.Limit)


def test_the_name_that_a_scene_was_given_says_where_the_robot_is():
    scene = hg.Scene("bhand")
    assert scene.robot == "bhand" and f"{scene.robot}" == "bhand"
    with pytest.raises(AttributeError, match=r"has no 'grasp'; the robot is scene\.art"):
        scene.robot.grasp(None, [])
    for again in (pickle.loads(pickle.dumps(scene)), copy.deepcopy(scene)):
        assert again == scene and type(again.robot) is type(scene.robot)


def test_an_object_may_be_the_path_of_its_file(tmp_path):
    can = tmp_path / "can.xml"
    geom = "<geom type='cylinder' size='0.04 0.06'/>"
    can.write_text(f"<mujoco><worldbody><body>{geom}</body></worldbody></mujoco>")
    for path in (can, str(can)):
        scene = hg.Scene("bhand", object=path)
        assert scene.object == hg.Body(path)
        scene.save(tmp_path / "scene.json")
        assert hg.Scene.load(tmp_path / "scene.json").object == scene.object
    with pytest.raises(hg.InputError, match=r"no file .*can\.stl"):
        hg.Scene(object="can.stl")
    with pytest.raises(hg.InputError, match="Cylinder, Prism, Body, or the path of a file"):
        hg.Scene(object=0.05)


def test_every_error_that_is_raised_can_be_caught_by_its_name():
    raised = {
        v.__name__
        for module in (hg.errors, hg.touch.driver_contract)
        for v in vars(module).values()
        if isinstance(v, type) and issubclass(v, hg.HqpGraspError)
    }
    assert raised <= set(hg.__all__)
