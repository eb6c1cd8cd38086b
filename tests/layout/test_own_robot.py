"""``layout --robot FILE``: a robot of one's own from YAML, from its URDF and from its MJCF."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from export_model.converters.layouts.own_robot import read_robot
from export_model.converters.layouts.robots import ROBOTS, Robot
from export_model.converters.layouts.xml_data import MAX_DEPTH
from export_model.signatures.errors import DamagedFileError, UsageError
from fixtures.layout import FOLDER
from tests.commands import export_model, is_refused

GO2 = next(r for r in ROBOTS if r.key == "go2")


def urdf_of(robot: Robot, axes: dict[str, str] | None = None, move: str = "") -> str:
    """A URDF of a dog: four legs of three joints, hips about x, the others about y; ``move`` is put elsewhere."""
    rows = []
    for chain in robot.chains:
        leg, link = chain.joints[0][:2], "base"
        places = {
            0: f"{0.2 if leg[0] == 'F' else -0.2} {0.05 if leg[1] == 'L' else -0.05} 0",
            1: "0 0 0",
            2: "0 0 -0.2",
        }
        for i, joint in enumerate(chain.joints):
            axis = (axes or {}).get(joint, "1 0 0" if i == 0 else "0 1 0")
            place = "0.5 0.5 0" if joint == move else places[i]
            rows.append(
                f'<joint name="{joint}" type="revolute"><parent link="{link}"/><child link="{joint}_link"/>'
                f'<origin xyz="{place}" rpy="0 0 0"/><axis xyz="{axis}"/></joint>'
            )
            link = f"{joint}_link"
        rows.append(f'<joint name="{leg}_foot" type="fixed"><parent link="{link}"/><child link="{leg}_sole"/></joint>')
    return f'<?xml version="1.0"?><robot name="dog"><link name="base"/>{"".join(rows)}</robot>'


MJCF = """<mujoco><compiler angle="radian"/><default><default class="leg"><joint axis="0 1 0"/>
<default class="roll"><joint axis="1 0 0"/></default></default></default>
<worldbody><body name="floor" pos="9 9 9"/><body name="base" pos="1 2 3" childclass="leg"><freejoint/>
<body pos="0 0.1 0" euler="0.2 0 0"><joint name="left_hip" class="roll"/>
  <body pos="0 0 -0.4"><joint name="left_knee"/><body><joint name="left_toe"/></body></body></body>
<body pos="0 -0.1 0" euler="-0.2 0 0"><joint name="right_hip" class="roll" axis="-1 0 0"/>
  <body pos="0 0 -0.4"><joint name="right_knee"/><body><joint name="right_toe"/></body></body></body>
<body pos="0 0 0.1" quat="1 0 0 0"><joint name="waist" axis="0 0 1"/></body></body></worldbody>
<actuator><position joint="left_hip"/><position joint="left_knee"/><position joint="right_hip"/>
<position joint="right_knee"/><position joint="waist"/></actuator></mujoco>"""


def test_a_yaml_names_joints_pairs_and_signs(tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    joints = GO2.all_orders()["level by level (Isaac Sim)"]
    file = tmp_path / "dog.yaml"
    pairs = [[j, GO2.partner(j)] for j in joints if GO2.partner(j) > j]
    file.write_text(json.dumps({"joints": joints, "pairs": pairs, "turned": [j for j in joints if "hip" in j]}))
    ran = export_model("layout", FOLDER / "walker.pt", "--robot", file, "--json")
    assert (ran.status, ran.json["decided"]["robot, of those known"]) == (0, "dog")
    file.write_text(json.dumps({"joints": joints, "pairs": [[*joints[:1], "tail"]]}))
    is_refused(export_model("layout", FOLDER / "walker.pt", "--robot", file), "is not a robot's file", "pairs:")
    is_refused(export_model("layout", FOLDER / "walker.pt", "--robot", "go3"), "no robot of that name", "did you mean")


def test_a_urdf_gives_joints_pairs_and_signs(tmp_path: Path) -> None:
    """As the row of the same robot has them; the walker is decided by it."""
    file = tmp_path / "dog.urdf"
    file.write_text(urdf_of(GO2))
    found = read_robot(file)
    assert found.joints == GO2.joints
    assert found.all_orders()["level by level (Isaac Sim)"] == GO2.all_orders()["level by level (Isaac Sim)"]
    assert all((found.partner(j), found.sign(j)) == (GO2.partner(j), GO2.sign(j)) for j in GO2.joints)
    ran = export_model("layout", FOLDER / "walker.pt", "--robot", file, "--json")
    assert (ran.status, ran.json["decided"]["robot, of those known"]) == (0, "dog")


def test_an_axis_that_points_the_other_way_changes_the_sign(tmp_path: Path) -> None:
    """As XBot-L's do: what a name says of roll and pitch is not asked."""
    file = tmp_path / "dog.urdf"
    file.write_text(urdf_of(GO2, {"FL_hip_joint": "-1 0 0", "RR_calf_joint": "0 -1 0"}))
    found = read_robot(file)
    turned = {j for j in GO2.joints if found.sign(j) == -1}
    assert turned == {"RL_hip_joint", "RR_hip_joint", "RL_calf_joint", "RR_calf_joint"}


def test_an_mjcf_gives_the_joints_that_have_an_actuator(tmp_path: Path) -> None:
    """Classes of defaults, the base's own place and angles are read as MuJoCo does."""
    file = tmp_path / "biped.xml"
    file.write_text(MJCF)
    found = read_robot(file)
    assert found.joints == ("left_hip", "left_knee", "right_hip", "right_knee", "waist")
    assert {j: found.sign(j) for j in found.joints} == {
        "left_hip": 1,
        "left_knee": 1,
        "right_hip": 1,
        "right_knee": 1,
        "waist": -1,
    }
    assert found.partner("left_knee") == "right_knee"
    assert found.partner("waist") == "waist"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (urdf_of(GO2, move="FR_thigh_joint"), "FL_thigh_joint: FR_thigh_joint is 0."),
        (urdf_of(GO2, {"FR_thigh_joint": "0 0 1"}), "FR_thigh_joint has another axis than its image"),
        (urdf_of(GO2).replace("FR_", "front_"), "FL_hip_joint: no name says a side, and it is beside the middle"),
        (MJCF.replace("left_", "l1_"), "no name says a side"),
    ],
    ids=["place", "axis", "name", "mjcf"],
)
def test_what_is_unclear_is_named_and_not_guessed(content: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / ("dog.urdf" if "<robot" in content else "dog.xml")
    file.write_text(content)
    with pytest.raises(UsageError, match="is unclear of") as caught:
        read_robot(file)
    assert said in str(caught.value)
    is_refused(
        export_model("layout", FOLDER / "walker.pt", "--robot", file), "is unclear of", "pairs and turned as YAML"
    )


BOMB = '<?xml version="1.0"?><!DOCTYPE robot [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]><robot>&b;</robot>'


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (BOMB.encode(), "has a document type"),
        (BOMB.encode("utf-16"), "has a document type"),
        (b"<robot>" * (MAX_DEPTH + 1), "more than"),
        (b"<robot>" + b"<a/>" * 100_001 + b"</robot>", "more than"),
        (b"<robot", "is not XML"),
        (b"<sdf/>", "not <robot> .URDF. or <mujoco>"),
        (b'<robot><joint name="a" type="revolute"><parent link="x"/></joint></robot>', "has no <child"),
        (b'<mujoco><include file="a.xml"/><worldbody/></mujoco>', "mj_saveLastXML"),
        (MJCF.replace("0 0.1 0", "0 nan 0").encode(), "is not 3 numbers"),
        (MJCF.replace('angle="radian"', 'eulerseq="zyx"').encode(), "eulerseq"),
        (MJCF.replace('name="left_knee"', 'name="left_knee" type="ball"').encode(), "is a ball"),
        (
            b'<robot><joint name="a" type="revolute"><parent link="x"/><child link="y"/></joint>'
            b'<joint name="b" type="revolute"><parent link="y"/><child link="x"/></joint></robot>',
            "0 base links",
        ),
    ],
)
def test_files_of_strangers_are_refused_with_the_reason(content: bytes, said: str, tmp_path: Path) -> None:
    file = tmp_path / "robot.xml"
    file.write_bytes(content)
    with pytest.raises(DamagedFileError, match=said):
        read_robot(file)
