"""Each kind of source is read as what it states, in the forms that their exporters write."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from export_model.converters.formats.source import ReadOptions
from export_model.converters.interfaces.registry import FILES as KINDS
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import DamagedFileError
from export_model.signatures.interface import Interface, Period, Term
from export_model.signatures.spec import PolicySignature
from tests.commands import export_model
from tests.interfaces.made import FILES, MJLAB, mjlab, run_with, write_onnx


def signature_of(path: Path, interface: str | None = None) -> PolicySignature:
    (policy,) = read_source(path, ReadOptions(interface=interface)).policies()
    return policy.signature


def interface_with(path: Path, file: Path) -> Interface:
    found = signature_of(path, str(file)).interface
    assert found is not None
    return found


def interface_of(path: Path) -> Interface:
    found = signature_of(path).interface
    assert found is not None
    return found


def test_mjlab_metadata_states_terms_scales_and_gains(tmp_path: Path) -> None:
    known = MJLAB["Mjlab-Velocity-Flat-Unitree-G1"]["metadata"]
    found = interface_of(mjlab(tmp_path, "Mjlab-Velocity-Flat-Unitree-G1"))
    terms = found.observations["state"]
    assert [t.name for t in terms] == known["observation_names"].split(",")
    assert {t.history for t in terms} == {1}
    assert all(t.size is None and not t.clip for t in terms)  # it writes neither sizes nor, here, a bound
    (action,) = found.actions
    joints = known["joint_names"].split(",")
    assert action.size == len(joints) == 29
    assert list(action.elements) == joints
    assert action.scale == tuple(map(float, known["action_scale"].split(",")))
    assert not action.offset  # the default position is stated, and not that the action is added to it
    names = {q.name: q.values for q in found.quantities}
    assert names["default position"] == tuple(map(float, known["default_joint_pos"].split(",")))
    assert {"stiffness", "damping"} <= names.keys()
    assert dict(found.metadata) == known


def test_joints_that_are_not_the_actions_do_not_name_them(tmp_path: Path) -> None:
    (action,) = interface_of(mjlab(tmp_path, "Mjlab-Lift-Cube-Yam")).actions
    assert (action.size, action.elements) == (7, ())  # the gripper has two joints and one actuator


@pytest.mark.parametrize(
    "metadata",
    [
        {"action_scale": "0.250,0.500", "joint_names": "hip,knee", "observation_history_lengths": "1.0,1.0"},
        {
            "action_scale": "[0.25, 0.5]",
            "joint_names": '["hip","knee"]',
            "observation_history_lengths": '{"a": 1, "b": 1}',
        },
    ],
    ids=["csv", "json"],
)
def test_other_exporters_write_csv_or_json(tmp_path: Path, metadata: dict[str, str]) -> None:
    given = {"observation_names": "a,b" if "," in metadata["joint_names"][:4] else '["a", "b"]', **metadata}
    found = interface_of(write_onnx(tmp_path / "p.onnx", metadata=given))
    assert found.actions == (
        Term(name="action", source=found.actions[0].source, size=2, elements=("hip", "knee"), scale=(0.25, 0.5)),
    )
    assert [(t.name, t.history) for t in found.observations["state"]] == [("a", 1), ("b", 1)]


def test_io_descriptors_state_all(tmp_path: Path) -> None:
    found = interface_of(run_with(tmp_path, "IO_descriptors.yaml", place="io_descriptors"))
    turn, joints = found.observations["state"]
    assert (turn.size, turn.elements, turn.unit) == (3, ("X", "Y", "Z"), "rad/s")
    assert (turn.scale, turn.clip, turn.history) == ((0.25,), ((-10.0, 10.0),), 1)
    assert (joints.elements, joints.unit) == (("hip", "knee"), "rad")
    assert joints.offset == pytest.approx((0.4, -0.8))
    (action,) = found.actions
    assert (action.scale, action.elements) == ((0.5,), ("hip", "knee"))
    assert action.offset == pytest.approx((0.4, -0.8))
    assert found.period == Period(0.02, "IO_descriptors.yaml: scene.dt")
    assert found.limits[0].clip == ((-0.75, 0.5), (-9.5, 9.5))
    assert "IO_descriptors.yaml: observations.critic" in {s.source for s in found.kept}


def test_names_of_elements_are_labels(tmp_path: Path) -> None:
    path = run_with(tmp_path, "IO_descriptors.yaml", place="io_descriptors")
    labels = signature_of(path).labels
    assert labels["actions"] == ["hip", "knee"]
    assert labels["observations"]["state"][:2] == ["base_ang_vel X", "base_ang_vel Y"]


def test_env_yaml_states_terms_in_order_and_the_period(tmp_path: Path) -> None:
    found = interface_of(run_with(tmp_path, "env.yaml"))
    turn, joints = found.observations["state"]
    assert (turn.name, turn.scale, turn.clip, turn.history, turn.size) == (
        *("base_ang_vel", (0.25,), ((-100.0, 100.0),), 5),
        None,
    )
    assert (joints.name, joints.history) == ("joint_pos_rel", 1)
    assert found.period == Period(0.02, "env.yaml: sim.dt × decimation")
    (action,) = found.actions
    assert (action.scale, action.offset) == ((0.5,), ())  # the default pose is added, which only the robot states
    assert [s.text for s in found.resets] == ["an episode lasts at most 20 s", "an episode ends at time_out"]


def test_agent_yaml_states_the_bounds_of_the_raw_action(tmp_path: Path) -> None:
    (limit,) = interface_of(run_with(tmp_path, "agent.yaml")).limits
    assert (limit.name, limit.clip, limit.source) == ("raw action", ((-4.0, 4.0),), "agent.yaml: clip_actions")


def test_deploy_yaml_states_sizes_by_its_lists(tmp_path: Path) -> None:
    found = interface_of(run_with(tmp_path, "deploy.yaml"))
    turn, joints = found.observations["state"]
    assert (turn.size, turn.scale, turn.clip) == (3, (0.2, 0.2, 0.2), ((-100.0, 100.0),))
    assert joints.size == 2
    (action,) = found.actions
    assert (action.scale, action.offset, action.elements) == ((0.25, 0.5), (0.4, -0.8), ())  # ".*" names no joint
    assert action.clip == ((-1.0, 1.0), (-2.5, 1.0))
    assert found.period == Period(0.02, "deploy.yaml: step_dt")


def test_leapp_states_names_by_tensor(tmp_path: Path) -> None:
    import onnx
    from onnx import TensorProto, helper

    ports = {
        n: helper.make_tensor_value_info(n, TensorProto.FLOAT, ["b", 2]) for n in ("joint_pos", "joint_vel", "target")
    }
    graph = helper.make_graph(
        [helper.make_node("Sub", ["joint_pos", "joint_vel"], ["d"]), helper.make_node("Tanh", ["d"], ["target"])],
        "p",
        [ports["joint_pos"], ports["joint_vel"]],
        [ports["target"]],
    )
    folder = tmp_path / "arm"
    folder.mkdir()
    onnx.save(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 15)], ir_version=8), folder / "policy.onnx"
    )
    shutil.copy(FILES / "arm.yaml", folder / "arm.yaml")
    found = interface_of(folder / "policy.onnx")
    assert {n: t[0].elements for n, t in found.observations.items()} == dict.fromkeys(
        ("state", "state_1"), ("shoulder", "elbow")
    )
    assert found.actions[0].elements == ("shoulder", "elbow")
    assert found.period == Period(0.02, "arm.yaml: pipeline.configs.frequency")


def test_configuration_yaml_states_the_memory_of_its_behavior(tmp_path: Path) -> None:
    write_onnx(tmp_path / "Walker.onnx")
    shutil.copy(FILES / "configuration.yaml", tmp_path / "configuration.yaml")
    (reset,) = interface_of(tmp_path / "Walker.onnx").resets
    assert reset.text == "trained with a memory of 128 numbers over sequences of 64 steps"


def test_labels_may_state_an_interface(tmp_path: Path) -> None:
    stated = {"actions": [{"name": "joints", "size": 2, "unit": "rad", "scale": [0.5]}], "period": {"seconds": 0.01}}
    (tmp_path / "labels.json").write_text(json.dumps({"interface": stated}))
    write_onnx(tmp_path / "p.onnx")
    ran = export_model(
        tmp_path / "p.onnx",
        "-o",
        tmp_path / "out",
        "--labels",
        tmp_path / "labels.json",
        "--verify",
        "none",
        "--to",
        "onnx",
    )
    assert ran.status == 0, ran.err
    found = interface_of(tmp_path / "out" / "p")
    assert found.actions == (Term(name="joints", source="labels.json", size=2, unit="rad", scale=(0.5,)),)
    assert found.period == Period(0.01, "labels.json")


def test_several_files_are_one_interface_and_contradictions_are_said(tmp_path: Path) -> None:
    path = run_with(tmp_path, "deploy.yaml", "env.yaml", "agent.yaml")
    signature = signature_of(path)
    assert signature.interface is not None
    assert signature.interface.observations["state"][0].scale == (0.2, 0.2, 0.2)  # deploy.yaml's
    assert signature.interface.limits[0].name == "raw action"
    assert any("differ in scale of base_ang_vel" in note for note in signature.notes)
    assert any("differ in history of base_ang_vel" in note for note in signature.notes)


def test_terms_that_do_not_add_up_are_kept_as_text(tmp_path: Path) -> None:
    run_with(tmp_path, "deploy.yaml")
    signature = signature_of(write_onnx(tmp_path / "exported" / "policy.onnx", seen=48))
    assert signature.interface is not None
    assert "state" not in signature.interface.observations
    assert any("states 5 numbers where state has 48" in note for note in signature.notes)
    assert any("base_ang_vel" in s.text for s in signature.interface.kept)


def test_a_file_that_cannot_be_read_is_a_note_and_one_that_was_named_an_error(tmp_path: Path) -> None:
    path = run_with(tmp_path)
    bad = tmp_path / "params" / "deploy.yaml"
    bad.write_text("actions: {a\n")
    assert any("deploy.yaml beside the source is left out" in note for note in signature_of(path).notes)
    with pytest.raises(DamagedFileError, match="YAML"):
        signature_of(path, str(bad))
    bad.write_text("a: 1\n")
    assert signature_of(path).interface is None
    with pytest.raises(DamagedFileError, match="states no interface"):
        signature_of(path, str(bad))


@pytest.mark.parametrize(
    ("name", "content", "nearest"),
    [
        ("mine.yaml", {"observation": {"a": 1}}, "observation may be observations"),
        ("mine.yaml", {"anchor_body": "torso"}, "the keys of ONNX metadata: anchor_body may be anchor_body_name"),
        ("mine.yaml", {"behaviours": {}}, "ML-Agents' configuration.yaml: behaviours may be behaviors"),
        ("mine.yaml", {"observations": {"policy": 3}}, "it has observations, but nothing in the form of that kind"),
        ("deploy2.yaml", {"q": 1}, "by its name it is nearest to Unitree's deploy.yaml"),
        ("mine.json", [1], "has none of the keys of the known kinds"),
    ],
)
def test_a_file_of_no_kind_is_an_error_that_names_the_nearest(
    name: str, content: object, nearest: str, tmp_path: Path
) -> None:
    path = write_onnx(tmp_path / "policy.onnx")
    (tmp_path / name).write_text(json.dumps(content))
    with pytest.raises(DamagedFileError, match="states no interface") as caught:
        signature_of(path, str(tmp_path / name))
    assert nearest in str(caught.value)


def test_keys_that_loaders_ask_for_are_kept_and_written(tmp_path: Path) -> None:
    """HybridRobotics/motion_tracking_controller#25: a model without anchor_body_name is not loaded."""
    onnx = pytest.importorskip("onnx")
    path = write_onnx(tmp_path / "policy.onnx")
    alone, both = tmp_path / "keys.yaml", tmp_path / "mine.yaml"
    alone.write_text(json.dumps({"anchor_body_name": "torso_link", "body_names": ["pelvis", "torso_link"], "fps": 50}))
    scales = {"observations": {}, "actions": {"Joint": {"scale": [0.5, 0.5]}}}
    both.write_text(json.dumps({**scales, "anchor_body_name": "torso_link"}))
    for file, more in ((alone, {"body_names": "pelvis,torso_link"}), (both, {})):
        wanted = {"anchor_body_name": "torso_link", **more}
        assert interface_with(path, file).metadata == wanted
        assert (
            export_model(
                path, "-o", tmp_path / file.stem, "--interface", file, "--to", "onnx", "--verify", "none"
            ).status
            == 0
        )
        made = onnx.load(tmp_path / file.stem / "policy" / "policy.onnx")
        assert wanted.items() <= {p.key: p.value for p in made.metadata_props}.items()
        assert (
            json.loads((tmp_path / file.stem / "policy" / "policy.json").read_text())["interface"]["metadata"] == wanted
        )
    assert [s.source for s in interface_with(path, alone).kept] == ["keys.yaml: fps"]
    assert interface_with(path, both).actions[0].scale == (0.5, 0.5)


def test_a_models_own_metadata_goes_before_keys_that_are_added(tmp_path: Path) -> None:
    task = next(iter(MJLAB))
    path = mjlab(tmp_path, task)
    (tmp_path / "keys.yaml").write_text(json.dumps({"anchor_body_name": "torso_link", "joint_names": ["a", "b"]}))
    signature = signature_of(path, str(tmp_path / "keys.yaml"))
    assert signature.interface is not None
    assert signature.interface.metadata == {**MJLAB[task]["metadata"], "anchor_body_name": "torso_link"}
    assert any("metadata joint_names is kept as the model has it" in note for note in signature.notes)


def test_what_lies_beside_may_be_left_out(tmp_path: Path) -> None:
    path = run_with(tmp_path, "deploy.yaml")
    assert signature_of(path, "none").interface is None
    assert "interface of" not in export_model("inspect", path, "--interface", "none").out
    elsewhere = (tmp_path / "params").rename(tmp_path / "elsewhere")
    assert "interface of" not in export_model("inspect", path).out
    assert "interface of action" in export_model("inspect", path, "--interface", elsewhere / "deploy.yaml").out


def test_every_kind_is_tested_here() -> None:
    names = {p.name for p in FILES.glob("*.yaml")}
    assert len(KINDS) == len(names) == 6


def test_a_link_that_leads_elsewhere_is_not_followed(tmp_path: Path) -> None:
    path = run_with(tmp_path / "run")
    secret = tmp_path / "secret.yaml"
    shutil.copy(FILES / "deploy.yaml", secret)
    (tmp_path / "run" / "params" / "deploy.yaml").symlink_to(secret)
    assert signature_of(path).interface is None


def test_descriptors_may_have_the_name_of_their_task(tmp_path: Path) -> None:
    path = run_with(tmp_path, "IO_descriptors.yaml", place="io_descriptors")
    folder = tmp_path / "io_descriptors"
    (folder / "IO_descriptors.yaml").rename(folder / "isaac_velocity_IO_descriptors.yaml")
    assert interface_of(path).period == Period(0.02, "isaac_velocity_IO_descriptors.yaml: scene.dt")


def test_a_behavior_in_a_folder_of_its_own_has_the_settings_of_its_run(tmp_path: Path) -> None:
    write_onnx(tmp_path / "Walker" / "Walker-500.onnx")
    shutil.copy(FILES / "configuration.yaml", tmp_path / "configuration.yaml")
    assert interface_of(tmp_path / "Walker" / "Walker-500.onnx").resets
