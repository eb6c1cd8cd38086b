"""``export-model layout``: what weights tell of a layout, on small walkers whose layout is known (fixtures/layout)."""

from __future__ import annotations

import json
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.formats.source import ReadOptions
from export_model.converters.layouts.layouts import Layout, plausible_layouts
from export_model.converters.layouts.robots import ROBOTS
from export_model.exporter.export.sources import read_source
from export_model.exporter.layout.ranking import HIGHEST, MARGIN, rank_layouts
from export_model.exporter.layout.telling import AGREES, DISAGREES, tell_layout
from export_model.exporter.layout.trial import Trial
from fixtures.layout import FOLDER
from tests.commands import export_model, is_refused
from tests.layout.networks import Network

LAB, GYM = "robot_lab, unitree_rl_lab", "unitree_rl_gym"
#: file → robot, how the order begins, project, stacking
WALKERS = {
    "walker.pt": ("go2", "level", LAB, ""),
    "walker_history.pt": ("go2", "as", LAB, "5 frames, term by term"),
    "walker_lstm.pt": ("g1-legs", "as", GYM, ""),
    "walker_gru.pt": ("g1-legs", "as", GYM, ""),
    "walker_rsl_rl.pt": ("go2", "level", LAB, ""),
}


def trial_of(path: Path) -> Trial:
    (policy,) = read_source(path, ReadOptions(activation="elu" if "rsl_rl" in path.name else None)).policies()
    return Trial(policy)


def true_layout(name: str, trial: Trial) -> Layout:
    robot, order, project, stacking = WALKERS[name]
    (found,) = [
        layout
        for layout in plausible_layouts(trial.width, trial.actions)
        if (layout.robot.key, layout.project, layout.stacking) == (robot, project, stacking)
        and layout.order.startswith(order)
    ]
    return found


@pytest.mark.parametrize("name", WALKERS)
def test_the_true_class_is_decided(name: str) -> None:
    trial = trial_of(FOLDER / name)
    ranking = rank_layouts(trial, plausible_layouts(trial.width, trial.actions))
    assert ranking.best is not None
    assert true_layout(name, trial) in ranking.best.members
    assert not ranking.why_open
    assert ranking.best.score < 0.2 < MARGIN * ranking.next


@pytest.mark.parametrize("name", WALKERS)
def test_without_the_true_class_nothing_is_decided_of_joints_or_stacking_wrongly(name: str) -> None:
    """The right widths of wrong robots, and a project that is not known."""
    trial = trial_of(FOLDER / name)
    truth = true_layout(name, trial)
    _, acted = truth.mirrors()
    for others in (
        [m for m in plausible_layouts(trial.width, trial.actions) if m.mirrors() != truth.mirrors()],
        [m for m in plausible_layouts(trial.width, trial.actions) if m.mirrors()[1] != acted],
    ):
        assert rank_layouts(trial, others).why_open


def test_an_arm_without_a_mirror_stays_open() -> None:
    ran = export_model("layout", FOLDER / "arm.pt", "--json")
    assert ran.status == 3
    assert (ran.json["verdict"], ran.json["decided"], ran.json["layout"]) == ("open", {}, None)
    assert "above" in ran.json["why_open"]


@pytest.mark.parametrize("seed", range(40))
def test_random_networks_stay_open(seed: int) -> None:
    """200 were tried when the bounds were chosen: the best score was 0.82, the smallest share of the next 0.91."""
    width, actions = [(45, 12), (47, 12), (96, 29), (41, 10), (48, 12), (57, 16)][seed % 6]
    trial = Network(width, actions, seed)
    ranking = rank_layouts(trial, plausible_layouts(width, actions))
    assert ranking.why_open
    assert ranking.best is not None
    assert ranking.best.score > HIGHEST


def written(layout: Layout, joints: tuple[str, ...], path: Path, stacked: str = "") -> Path:
    """Isaac Lab's IO descriptors that state a layout with its joints in an order."""
    per_joint = ("joint_pos", "joint_vel", "last_action")
    rows = [
        {
            "name": name,
            "shape": [len(joints) if name in per_joint else 2 if name == "gait_phase" else 3],
            "overloads": {"history_length": layout.frames},
        }
        for name in layout.terms
    ]
    action = {"name": "action", "shape": [len(joints)], "joint_names": list(joints)}
    path.write_text(json.dumps({"observations": {"policy": rows}, "actions": [action]}))
    return path


@pytest.mark.parametrize("name", ["walker.pt", "walker_lstm.pt"])
def test_two_joints_of_one_side_exchanged_are_named(name: str, tmp_path: Path) -> None:
    """Of all pairs of one side that are no mirror image of each other's places, at least four in five."""
    pytest.importorskip("yaml")
    truth = true_layout(name, trial_of(FOLDER / name))
    side = [j for j in truth.joints if truth.robot.partner(j) > j]
    robots = [truth.robot]
    named = 0
    pairs = list(combinations(side, 2))
    for pair in pairs:
        swap = {pair[0]: pair[1], pair[1]: pair[0]}
        stated = written(truth, tuple(swap.get(j, j) for j in truth.joints), tmp_path / "mine.yaml")
        (policy,) = read_source(FOLDER / name, ReadOptions(interface=str(stated))).policies(CompileOptions())
        told = tell_layout(policy, robots)
        assert told.stated is not None
        assert told.verdict != AGREES, pair
        named += (
            told.verdict == DISAGREES and all(j in told.stated.says for j in pair) and "exchanged" in told.stated.says
        )
    assert named >= 0.8 * len(pairs), f"{named} of {len(pairs)}"


def test_what_is_right_agrees_and_other_stacking_does_not(tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    truth = true_layout("walker_history.pt", trial_of(FOLDER / "walker_history.pt"))
    right = written(truth, truth.joints, tmp_path / "right.yaml")
    ran = export_model("layout", FOLDER / "walker_history.pt", "--check", right)
    assert ran.status == 0
    assert "right.yaml: observations.policy[0] states agrees (0.0" in ran.out
    content = json.loads(right.read_text())
    rows = [
        {**row, "name": f"{row['name']} (frame {i} of 5)", "overloads": {}}
        for i in range(1, 6)
        for row in content["observations"]["policy"]
    ]
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(json.dumps({**content, "observations": {"policy": rows}}))
    ran = export_model("layout", FOLDER / "walker_history.pt", "--check", wrong)
    assert ran.status == 1
    assert "histories seem term by term" in ran.out


def test_what_was_written_is_read_and_agrees(tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    file = tmp_path / "interface.yaml"
    assert export_model("layout", FOLDER / "walker.pt", "--robot", "go2", "--write", file).status == 0
    ran = export_model("layout", FOLDER / "walker.pt", "--check", file, "--json")
    assert (ran.status, ran.json["verdict"]) == (0, "agrees")
    assert ran.json["stated"]["layout"]["joints"][:2] == ["FL_hip_joint", "FR_hip_joint"]
    ran = export_model("inspect", FOLDER / "walker.pt", "--interface", file)
    assert "joint_pos" in ran.out
    assert "FL_hip_joint" in ran.out


def test_nothing_is_written_where_nothing_is_decided(tmp_path: Path) -> None:
    file = tmp_path / "interface.yaml"
    is_refused(export_model("layout", FOLDER / "arm.pt", "--write", file), "nothing is written", "not decided")
    assert not file.exists()


def test_what_is_open_is_listed_with_its_members() -> None:
    found = export_model("layout", FOLDER / "walker.pt", "--json").json
    opened = {fact["what"]: fact for fact in found["open"] if fact["what"] != "which is which"}
    assert opened["robot"]["members"] == ["go2", "go1", "a1", "b2", "lite3", "anymal"]
    assert {"left and right as a whole", "scales"} <= opened.keys()
    alike = [fact["members"] for fact in found["open"] if fact["what"] == "which is which"]
    assert ["joint_pos", "joint_vel", "last_action"] in alike
    assert "robot, of those known" not in found["decided"]


def test_the_normaliser_tells_gravity() -> None:
    """Its mean is -1; what it says of positions and velocities is in test_forms.py."""
    found = export_model("layout", FOLDER / "walker.pt", "--json").json
    (gravity,) = [e for e in found["evidence"] if e["term"] == "projected_gravity"]
    assert (gravity["holds"], gravity["says"]) == (True, "the normaliser's mean of its last number is -1.00")


def test_an_onnx_and_a_bundle_are_told_alike(tmp_path: Path) -> None:
    assert export_model(FOLDER / "walker.pt", "-o", tmp_path, "--to", "onnx", "--verify", "none").status == 0
    scores = {
        export_model("layout", path, "--json").json["score"]
        for path in (FOLDER / "walker.pt", tmp_path / "walker", tmp_path / "walker/walker.onnx")
    }
    assert len(scores) == 1


def test_inspect_names_the_command_where_the_widths_are_those_of_a_known_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    """And runs nothing: it stays a reader."""
    monkeypatch.setattr("export_model.converters.graph.run.run_graph", None)
    said = " ".join(export_model("inspect", FOLDER / "walker.pt").out.split())
    assert (
        f"which number is which: export-model layout {FOLDER / 'walker.pt'} (these are widths of g1-legs, h1_2-legs"
        in said
    )
    assert "which number is which" not in export_model("inspect", "fixtures/continuous.bytes").out


def test_other_policies_are_refused_with_the_reason() -> None:
    is_refused(export_model("layout", "fixtures/visual.bytes"), "cannot be told", "a mirror is tried on one row")
    is_refused(export_model("layout", FOLDER / "walker.pt", "--check", "fixtures/manifest.json"))


def test_rows_have_sources_and_mirrors_are_their_own_inverse() -> None:
    keys = [robot.key for robot in ROBOTS]
    assert len(set(keys)) == len(keys)
    for robot in ROBOTS:
        assert "@" in robot.source or "metadata" in robot.source
        for joints in robot.all_orders().values():
            assert sorted(joints) == sorted(robot.joints)
            for joint in joints:
                assert robot.partner(robot.partner(joint)) == joint
                assert robot.sign(robot.partner(joint)) == robot.sign(joint)
    for width, actions in ((235, 12), (480, 29), (100, 29), (705, 12)):
        for layout in plausible_layouts(width, actions):
            for mirror in layout.mirrors():
                x = np.arange(1.0, len(mirror.places) + 1)
                assert np.array_equal(mirror.apply(mirror.apply(x)), x)
            assert replace(layout, joints=layout.joints).width == width


def test_a_deploy_yaml_of_any_name_is_one(tmp_path: Path) -> None:
    """Unitree's file states joints by numbers in the robot's own order; under another name it was read as rows."""
    pytest.importorskip("yaml")
    sizes = {
        "base_ang_vel": 3,
        "projected_gravity": 3,
        "velocity_commands": 3,
        "joint_pos_rel": 12,
        "joint_vel_rel": 12,
    }
    terms = {name: {"scale": [1.0] * size, "history_length": 1} for name, size in (*sizes.items(), ("last_action", 12))}
    places = [0, 3, 6, 9, 1, 4, 7, 10, 2, 5, 8, 11]
    right = {"joint_ids_map": places, "observations": terms, "actions": {"JointPositionAction": {"scale": [0.25] * 12}}}
    for name in ("deploy.yaml", "mine.yaml"):
        (tmp_path / name).write_text(json.dumps(right))
        assert export_model("layout", FOLDER / "walker.pt", "--check", tmp_path / name).status == 0
    slots = [place + 3 * (place > 4) for place in places]  # of a robot that has joints which nothing moves
    (tmp_path / "mine.yaml").write_text(json.dumps({**right, "joint_ids_map": slots}))
    assert export_model("layout", FOLDER / "walker.pt", "--check", tmp_path / "mine.yaml").status == 0
    (tmp_path / "mine.yaml").write_text(json.dumps({**right, "joint_ids_map": [0] * 12}))
    is_refused(export_model("layout", FOLDER / "walker.pt", "--check", tmp_path / "mine.yaml"), "states no layout")
    (tmp_path / "mine.yaml").write_text(json.dumps({**right, "joint_ids_map": list(range(12))}))
    ran = export_model("layout", FOLDER / "walker.pt", "--robot", "go2", "--check", tmp_path / "mine.yaml")
    assert ran.status == 1
    assert "level by level" in ran.out
