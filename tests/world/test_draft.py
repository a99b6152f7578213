"""A first description is written from a model alone, and grasps without a word more."""

import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

import hqp_grasp as hg
from hqp_grasp.__main__ import main
from hqp_grasp.errors import ModelError
from hqp_grasp.world.draft import draft, write_draft

PAGE = (Path(__file__).parents[2] / "docs" / "any-robot.md").read_text(encoding="utf-8")
TRIDENT = re.search(r'```text title="trident.xml"\n(.*?)```', PAGE, re.DOTALL)[1]
FINGER = """
<body name="{n}1" pos="{x} {y} 0" euler="0 0 {turn}">
  <joint name="{n}1"/><geom type="capsule" size="0.008" fromto="0 0 0 0 0 0.06"/>
  <body name="{n}2" pos="0 0 0.06">
    <joint name="{n}2"/><geom type="capsule" size="0.008" fromto="0 0 0.01 0 0 0.04"/>
  </body>
</body>"""


def hand(turns=(0, 120, 240), r=0.05, palm="", beside="", end="", compiler='angle="degree"'):
    """A hand of fingers of two joints around the z axis, on a palm."""
    from math import cos, radians, sin

    fingers = "".join(
        FINGER.format(n="abcdef"[i], x=r * cos(radians(t)), y=r * sin(radians(t)), turn=t)
        for i, t in enumerate(turns)
    )
    return (
        f'<mujoco model="own"><compiler {compiler}/>'
        '<default><joint axis="0 -1 0" range="-30 90"/></default>'
        f'<worldbody>{beside}<body name="palm">{palm}<geom type="sphere" size="0.02"/>{fingers}'
        f"</body></worldbody>{end}</mujoco>"
    )


URDF = """<robot name="claw">
<link name="base"/>
<link name="wrist"><inertial><mass value="1"/><inertia ixx="1e-3" iyy="1e-3" izz="1e-3"
  ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="mount" type="fixed"><parent link="base"/><child link="wrist"/></joint>
{fingers}</robot>"""
LINK = """<link name="{n}"><inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4"
  ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="{n} tip"><collision><origin xyz="0 0 0.09"/><geometry><capsule radius="0.009"
  length="0.03"/></geometry></collision></link>
<joint name="{n} joint" type="revolute"><parent link="wrist"/><child link="{n}"/>
  <origin xyz="{x} {y} 0" rpy="0 0 {turn}"/><axis xyz="0 -1 0"/>
  <limit lower="-0.5" upper="1.5" effort="1" velocity="1"/></joint>
<joint name="{n} end" type="fixed"><parent link="{n}"/><child link="{n} tip"/></joint>"""


def write(folder, text, name="own.xml"):
    (folder / name).write_text(text)
    return folder / name


def data(text):
    return tomllib.loads(text)


def tips(text):
    return [point["link"] for point in data(text)["contact_points"]]


def test_a_hand_alone_gets_a_carriage_its_fingertips_and_how_they_close_and_grasps(tmp_path):
    out = write_draft(write(tmp_path, TRIDENT, "trident.xml"))
    assert out == tmp_path / "trident.toml"
    text = out.read_text(encoding="utf-8")
    assert tips(text) == ["a2", "b2", "c2"] and data(text)["carriage"] is True
    assert [p["flexion"] for p in data(text)["contact_points"]] == [
        {f"{n}1": 1, f"{n}2": 1} for n in "abc"
    ]
    assert data(text)["palm"]["approach"] == pytest.approx([0.0, 0.0, 1.0], abs=1e-3)
    assert text.count("  # ") >= 9  # each with its reason
    robot = hg.Scene(out).articulated
    bare = "model = 'trident.xml'\ncarriage = true\n" + "".join(
        f"[[contact_points]]\nlink = '{n}2'\n" for n in "abc"
    )
    other = hg.Scene(write(tmp_path, bare, "bare.toml")).articulated
    assert robot.joints == other.joints and robot.closing == pytest.approx(other.closing)
    assert hg.Trial(hg.Scene(out), hg.stack_of("fmk"), probes=15).run(1).verdict == "good"


def test_a_urdf_with_capsule_tips_and_names_of_two_words_is_described(tmp_path):
    places = (("left", 0.05, 0.0, 0.0), ("right", -0.05, 0.0, 3.14159))
    fingers = "".join(LINK.format(n=n, x=x, y=y, turn=t) for n, x, y, t in places)
    path = write(tmp_path, URDF.format(fingers=fingers), "claw.urdf")
    text = draft(path)
    # The tip is welded to the link that its joint moves: the contact point is of that link.
    assert tips(text) == ["left", "right"]
    assert data(text)["contact_points"][0]["flexion"] == {"left joint": 1}
    assert data(text)["home"] == {"left joint": 0, "right joint": 0}
    assert hg.Scene(write_draft(path)).articulated.n == 8


def test_what_an_arm_carries_needs_no_carriage_and_what_a_wrist_carries_does(tmp_path):
    hinge = '<joint name="arm{i}" axis="{axis}" range="-90 90"/>'
    links = lambda count: "".join(  # noqa: E731
        f'<body name="link{i}" pos="0 0 0.2"><geom size="0.03" type="sphere"/>'
        + hinge.format(i=i, axis="0 1 0" if i % 2 else "0 0 1")
        for i in range(count)
    )
    for count in (2, 6):
        text = hand().replace('<body name="palm">', links(count) + '<body name="palm">')
        text = text.replace("</worldbody>", "</body>" * count + "</worldbody>")
        text = text.replace("<worldbody>", '<worldbody><body name="base">')
        text = text.replace("</worldbody>", "</body></worldbody>")
        said = data(draft(write(tmp_path, text)))
        assert said.get("carriage", False) is (count == 2)
        assert said.get("lock", []) == (["arm0", "arm1"] if count == 2 else [])


def test_of_five_fingertips_three_that_are_wide_apart_are_chosen_and_the_others_named(tmp_path):
    text = draft(write(tmp_path, hand((0, 20, 120, 220, 240))))
    assert tips(text) == ["a2", "c2", "e2"]
    assert "one of 5: the widest apart" in text and "# Left out: b2, d2" in text


def test_a_scene_s_floor_and_table_are_left_out(tmp_path):
    floor = (
        '<geom type="plane" size="1 1 1"/><body name="table"><geom type="sphere" size="1"/></body>'
    )
    path = write(tmp_path, hand(beside=floor))
    said = data(draft(path))
    assert said["model"] == [{"file": "own.xml", "root": "palm"}]
    assert hg.Scene(write_draft(path)).articulated.n == 12


def test_a_free_base_is_locked(tmp_path):
    path = write(tmp_path, hand(palm='<freejoint name="root"/>'))
    assert data(draft(path))["lock"] == ["root"]
    assert hg.Scene(write_draft(path)).articulated.n == 12


def test_a_file_that_lists_radians_and_does_not_say_so_is_taken_by_them(tmp_path):
    text = (
        hand(compiler="")
        .replace("-30 90", "-0.5 1.5")
        .replace('euler="0 0 120"', 'euler="0 0 2.1"')
    )
    text = text.replace('euler="0 0 240"', 'euler="0 0 4.2"')
    path = write(tmp_path, text)
    assert data(draft(path))["model"] == [{"file": "own.xml", "degrees": False}]
    robot = hg.Scene(write_draft(path)).articulated
    assert robot.q_upper[-1] == 1.5


def test_a_hand_with_tendons_is_described_and_told_of_them(tmp_path, capsys, monkeypatch):
    end = (
        '<tendon><fixed name="pull"><joint joint="a1" coef="1"/><joint joint="a2" coef="1"/>'
        '</fixed></tendon><actuator><motor tendon="pull"/></actuator>'
    )
    monkeypatch.setattr("sys.argv", ["hqp-grasp", "robot", str(write(tmp_path, hand(end=end)))])
    main()
    said = capsys.readouterr().out
    assert said.startswith("wrote    ") and "pull over a1, a2: an actuator drives it" in said


def test_what_is_not_accepted_as_it_stands_is_written_with_the_reason(tmp_path):
    end = '<equality><joint joint1="b1" joint2="a1"/><joint joint1="b2" joint2="a1"/></equality>'
    text = draft(write(tmp_path, hand(end=end)))
    assert tips(text) == ["a2", "b2", "c2"]
    assert "# Not accepted as it stands. " in text and "joints of its own" in " ".join(
        text.replace("\n# ", " ").split()
    )


def test_a_model_in_which_nothing_can_touch_is_refused_and_nothing_is_written(tmp_path):
    path = write(tmp_path, hand().replace("<geom ", '<geom contype="0" conaffinity="0" '))
    with pytest.raises(ModelError, match="nothing in it can touch"):
        write_draft(path)
    with pytest.raises(ModelError, match="not a valid MJCF"):
        write_draft(write(tmp_path, "<mujoco>", "torn.xml"))
    assert not list(tmp_path.glob("*.toml"))


def test_a_description_that_is_there_is_never_overwritten(tmp_path):
    path = write(tmp_path, hand())
    out = write_draft(path)
    out.write_text("mine")
    with pytest.raises(ModelError, match="is there already, and is left as it is"):
        write_draft(path)
    assert out.read_text() == "mine"


def test_a_model_in_the_place_of_a_description_is_told_how_to_get_one(tmp_path):
    path = write(tmp_path, hand())
    for given in (path, str(path)):
        with pytest.raises(ModelError, match=r"hqp-grasp robot .*own\.xml writes a first one"):
            hg.Scene(given)


def test_of_two_hands_the_one_with_more_fingers_is_described_and_they_are_not_mixed(tmp_path):
    two = hand((0, 180))
    two = two[two.index('<body name="palm">') : two.index("</worldbody>")]
    two = re.sub(r'name="([ab])', r'name="2\1', two.replace('"palm"', '"palm2"'))
    text = draft(write(tmp_path, hand(beside=two)))
    assert tips(text) == ["a2", "b2", "c2"] and "# Left out: 2a2, 2b2" in text
    assert data(text)["model"] == [{"file": "own.xml", "root": "palm"}]


@pytest.mark.parametrize(
    "name", ["allegro", "baxter", "fourier", "g1", "inspire", "robotiq", "shadow"]
)
def test_a_robot_by_name_whose_packages_are_missing_says_the_line_that_installs_them(
    name, monkeypatch
):
    monkeypatch.setattr("hqp_grasp.world.description.find_spec", lambda package: None)
    monkeypatch.setattr("hqp_grasp.world.description.metadata.distribution", absent)
    line = r"not installed; pip install --no-deps (robosuite|robopianist|example-robot-data| )+ is"
    with pytest.raises(ModelError, match=line) as said:
        hg.Scene(name)
    assert ("robosuite example-robot-data" in str(said.value)) is (name == "allegro")


def absent(package):
    raise metadata.PackageNotFoundError(package)
