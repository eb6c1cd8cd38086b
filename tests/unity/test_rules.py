"""The rules on policies made here: the order of checks, how outputs are looked up, what a wrong type does.

What is expected was recorded with Unity's own code on files of the same kind; it stands here as text, so that the
tests hold without ../shared.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto, helper

from export_model.converters.consumers.unity.checker import ModeVerdict, UnityVerdict, check_file
from export_model.converters.consumers.unity.consumers import CONSUMERS
from export_model.converters.consumers.unity.rules import culture_key
from export_model.converters.consumers.unity.settings import Brain, sensors_of
from export_model.signatures.errors import SourceError, UsageError
from tests.unity.policies import Draft

BRAIN = Brain(continuous=2, sensors=sensors_of([[5]]))
RELEASES = tuple(CONSUMERS)
LATER = ("R22", "R23", "R23-2.4")
NULL = ("NullReferenceException", "Object reference not set to an instance of an object.")
OLDER = "Model was trained with a older version of the trainer than is supported."


def verdict(draft: Draft, folder: Path, release: str, brain: Brain = BRAIN) -> UnityVerdict:
    return check_file(draft.write(folder), CONSUMERS[release], brain)


def stochastic(draft: Draft, folder: Path, release: str, brain: Brain = BRAIN) -> ModeVerdict:
    found = verdict(draft, folder, release, brain)
    assert found.refused is None
    return found.modes["stochastic"]


def messages(found: ModeVerdict) -> list[str]:
    return [f.message for f in found.checks]


@pytest.mark.parametrize("release", RELEASES)
def test_a_complete_policy_is_accepted(tmp_path: Path, release: str) -> None:
    assert verdict(Draft(), tmp_path, release).accepted == {"stochastic": True, "deterministic": True}


@pytest.mark.parametrize("release", RELEASES)
def test_only_the_first_missing_thing_is_told(tmp_path: Path, release: str) -> None:
    draft = Draft(constants={})
    told = ['Required constant "version_number" was not found in the model file.']
    assert messages(stochastic(draft, tmp_path, release)) == told


def test_a_missing_version_is_null_in_release_20_and_an_old_one_later(tmp_path: Path) -> None:
    draft = Draft(constants={"memory_size": 0.0, "continuous_action_output_shape": 2.0})
    load = stochastic(draft, tmp_path, "R20").load
    assert load is not None and (load.exception, load.message) == NULL
    load = stochastic(draft, tmp_path, "R22").load
    assert (
        load is not None and load.message.startswith(OLDER) and load.message.endswith("-1 Minimum supported version: 2")
    )


def test_a_missing_memory_size_stops_release_20_only(tmp_path: Path) -> None:
    draft = Draft(constants={"version_number": 3.0, "continuous_action_output_shape": 2.0})
    assert stochastic(draft, tmp_path, "R20").load is not None
    for release in LATER:
        found = stochastic(draft, tmp_path, release)
        assert found.load is None
        assert messages(found) == ['Required constant "memory_size" was not found in the model file.']


@pytest.mark.parametrize("name", ["version_number", "memory_size", "continuous_action_output_shape"])
def test_an_integer_constant_is_cast_wrongly_from_release_22_on(tmp_path: Path, name: str) -> None:
    draft = Draft(types={name: np.int64})
    assert stochastic(draft, tmp_path, "R20").accepted
    for release, space in (("R22", "Unity.Sentis"), ("R23", "Unity.InferenceEngine")):
        load = stochastic(draft, tmp_path, release).load
        assert load is not None and load.exception == "InvalidCastException"
        assert load.message == (
            f"Unable to cast object of type '{space}.Tensor`1[System.Int32]' to type '{space}.Tensor`1[System.Single]'."
        )


@pytest.mark.parametrize("kind", [TensorProto.INT32, TensorProto.INT64])
def test_an_input_of_integers_fails_in_the_editor_from_release_22_on(tmp_path: Path, kind: int) -> None:
    draft = Draft(inputs={"obs_0": (kind, ["N", 5])})
    assert stochastic(draft, tmp_path, "R20").accepted
    found = stochastic(draft, tmp_path, "R22")
    assert found.load is not None and found.load == found.check_throws
    assert found.load.message.endswith(
        "Cannot set input tensor 0 as data types do not match, expected Int received Float"
    )


@pytest.mark.parametrize("kind", [np.float16, np.float64])
def test_a_constant_of_another_width_is_a_float(tmp_path: Path, kind: Any) -> None:
    draft = Draft(types={"version_number": kind})
    for release in RELEASES:
        assert stochastic(draft, tmp_path, release).accepted, release


def test_outputs_are_found_by_a_part_of_their_name_from_release_22_on(tmp_path: Path) -> None:
    draft = Draft(actions={"Brain/continuous_actions": 2})
    assert messages(stochastic(draft, tmp_path, "R20")) == ["The model does not contain any Action Output Node."]
    for release in LATER:
        assert stochastic(draft, tmp_path, release).checked, release


def test_a_constant_may_be_computed(tmp_path: Path) -> None:
    draft = Draft(constants={"two": 2.0, "one": 1.0, "memory_size": 0.0, "continuous_action_output_shape": 2.0})
    model = draft.model()
    model.graph.node.append(helper.make_node("Add", ["two/value", "one/value"], ["version_number"]))
    model.graph.output.append(helper.make_tensor_value_info("version_number", TensorProto.FLOAT, [1]))
    path = tmp_path / "sum.onnx"
    path.write_bytes(model.SerializeToString())
    for release in RELEASES:
        assert check_file(path, CONSUMERS[release], BRAIN).accepted["stochastic"], release


def test_a_constant_that_would_be_huge_is_not_computed(tmp_path: Path) -> None:
    model = Draft(constants={"memory_size": 0.0, "continuous_action_output_shape": 2.0}).model()
    model.graph.initializer.append(helper.make_tensor("huge", TensorProto.INT64, [2], [1 << 20, 1 << 20]))
    model.graph.node.append(helper.make_node("ConstantOfShape", ["huge"], ["version_number"]))
    model.graph.output.append(helper.make_tensor_value_info("version_number", TensorProto.FLOAT, None))
    path = tmp_path / "huge.onnx"
    path.write_bytes(model.SerializeToString())
    assert not check_file(path, CONSUMERS["R22"], BRAIN).accepted["stochastic"]


def test_integers_of_version_2_are_the_other_way_round(tmp_path: Path) -> None:
    constants = {"version_number": 2.0, "memory_size": 0.0, "is_continuous_control": 1, "action_output_shape": 2}
    draft = Draft({"vector_observation": (TensorProto.FLOAT, ["N", 5])}, {"action": 2}, constants)
    brain = Brain(2, vector_observation_size=5, sensors=sensors_of([[5]]))
    load = stochastic(draft, tmp_path, "R22", brain).load
    assert stochastic(draft, tmp_path, "R20", brain).accepted
    assert load is not None and load.exception == "InvalidCastException" and "Single]' to" in load.message
    draft.types = {"is_continuous_control": np.int32, "action_output_shape": np.int32}
    for release in RELEASES:
        assert stochastic(draft, tmp_path, release, brain).accepted, release


def test_version_2_with_memory_is_an_error_that_also_throws(tmp_path: Path) -> None:
    draft = Draft(constants={"version_number": 2.0, "memory_size": 16.0, "continuous_action_output_shape": 2.0})
    for release in RELEASES:
        found = stochastic(draft, tmp_path, release, Brain(2))
        assert found.load is not None and found.load.exception == "UnityAgentsException"
        assert messages(found)[0] == found.load.message
        assert messages(found)[1] == "The model does not contain a Recurrent Input Node but has memory_size."


def test_sensors_are_compared_by_their_index(tmp_path: Path) -> None:
    draft = Draft(inputs={"obs_0": (TensorProto.FLOAT, ["N", 5]), "obs_1": (TensorProto.FLOAT, ["N", 3, 20, 24])})
    brain = Brain(2, sensors=sensors_of([[4], [3, 24, 20], [7]]))
    told = [
        "The model does not contain an Observation Placeholder Input for sensor component 2 (VectorSensor).",
        "An Observation of the model does not match. Received TensorProxy of shape [?x4] but was expecting [?x5] "
        "for the VectorSensor_size4 Sensor.",
        "The visual Observation of the model does not match. Received TensorProxy of shape [?x20x24x3] but was "
        "expecting [?x24x20x3] for the CameraSensor Sensor.",
    ]
    for release in RELEASES:
        assert messages(stochastic(draft, tmp_path, release, brain)) == told, release


def test_a_picture_that_the_file_turns_itself_is_taken_by_barracuda_alone(tmp_path: Path) -> None:
    inputs: Any = {"obs_0": (TensorProto.FLOAT, ["N", 5]), "obs_1": (TensorProto.FLOAT, ["N", 20, 24, 3])}
    turned = helper.make_node("Transpose", ["obs_1"], ["nchw"], perm=[0, 3, 1, 2])
    brain = Brain(2, sensors=sensors_of([[5], [3, 20, 24]]))
    alone = Draft(inputs=inputs, extra=[turned])
    assert len(messages(stochastic(alone, tmp_path, "R20", brain))) == 1
    model = Draft(inputs=inputs, extra=[turned, helper.make_node("Conv", ["nchw", "k"], ["seen"])]).model()
    model.graph.initializer.append(helper.make_tensor("k", TensorProto.FLOAT, [1, 3, 1, 1], [1.0, 1.0, 1.0]))
    path = tmp_path / "convolved.onnx"
    path.write_bytes(model.SerializeToString())
    assert check_file(path, CONSUMERS["R20"], brain).accepted["stochastic"]
    later = check_file(path, CONSUMERS["R22"], brain).modes["stochastic"]
    assert "was expecting [?x3x24x20]" in messages(later)[0]


def test_free_lengths_are_ones_in_the_run_on_zeros(tmp_path: Path) -> None:
    draft = Draft(inputs={"obs_0": (TensorProto.FLOAT, ["N", "features"])})
    assert "was expecting [?x0]" in messages(stochastic(draft, tmp_path, "R20"))[0]
    load = stochastic(draft, tmp_path, "R22").load
    assert load is not None and load.message.endswith("dimension does not match for matmul (1, 1), (5, 2)")


def test_a_batch_of_nothing_has_no_memory(tmp_path: Path) -> None:
    draft = Draft(inputs={"obs_0": (TensorProto.FLOAT, [0, 5])})
    load = stochastic(draft, tmp_path, "R22").load
    assert load is not None and (load.exception, load.message) == NULL


def test_unknown_operators_end_the_import(tmp_path: Path) -> None:
    draft = Draft(extra=[helper.make_node("GRU", ["obs_0", "w", "r"], ["all", "last"], hidden_size=2)])
    refused = verdict(draft, tmp_path, "R20").refused
    assert refused is not None and refused.message.startswith("Unknown type GRU encountered while parsing layer all.")
    assert verdict(draft, tmp_path, "R22").accepted["stochastic"], "nothing reads it, and it is left out"
    draft.extra.append(helper.make_node("Relu", ["last"], ["read"]))
    refused = verdict(draft, tmp_path, "R22").refused
    assert refused is not None and refused.message == "The given key 'last' was not present in the dictionary."


def test_an_attribute_of_another_type_is_not_found_by_sentis(tmp_path: Path) -> None:
    draft = Draft(extra=[helper.make_node("RandomNormalLike", ["obs_0"], ["noise"], seed=134)])
    assert verdict(draft, tmp_path, "R20").refused is None
    refused = verdict(draft, tmp_path, "R22").refused
    assert refused is not None and refused.message == "Couldn't find attribute seed of type Float"


def test_one_engine_trips_over_an_output_of_a_reshaped_output(tmp_path: Path) -> None:
    model = Draft().model()
    model.graph.initializer.append(helper.make_tensor("shape", TensorProto.INT64, [2], [-1, 2]))
    model.graph.node[0].output[0] = "mean"
    model.graph.node.append(helper.make_node("Reshape", ["mean", "shape"], ["continuous_actions"]))
    model.graph.node[1].CopyFrom(
        helper.make_node("Identity", ["continuous_actions"], ["deterministic_continuous_actions"])
    )
    node = model.graph.node.pop()
    model.graph.node.insert(1, node)
    path = tmp_path / "reshaped.onnx"
    path.write_bytes(model.SerializeToString())
    assert check_file(path, CONSUMERS["R23"], BRAIN).accepted["stochastic"]
    refused = check_file(path, CONSUMERS["R23-2.4"], BRAIN).refused
    assert refused is not None and (refused.exception, refused.message) == NULL


def test_the_zero_of_a_name_stays_in_the_newest_engine(tmp_path: Path) -> None:
    draft = Draft(inputs={"obs_0:0": (TensorProto.FLOAT, ["N", 5])})
    assert verdict(draft, tmp_path, "R23").accepted["stochastic"]
    assert "unexpected input named : obs_0:0" in messages(stochastic(draft, tmp_path, "R23-2.4"))[1]


def test_names_are_sorted_as_the_invariant_culture_does() -> None:
    names = ["obs_1", "Goal", "goal", "b/x", "obs_10", "_a", "obs_2", "-a", "7"]
    assert sorted(names, key=culture_key) == ["_a", "-a", "7", "b/x", "goal", "Goal", "obs_1", "obs_10", "obs_2"]


def test_nn_of_another_format_version_is_refused_with_its_number(tmp_path: Path) -> None:
    path = tmp_path / "old.nn"
    path.write_bytes((15).to_bytes(8, "little") + bytes(40))
    refused = check_file(path, CONSUMERS["R20"], BRAIN).refused
    assert refused is not None and refused.message == "Format version not supported: 15"
    later = check_file(path, CONSUMERS["R22"], BRAIN).refused
    assert later is not None and not later.worded


def test_other_files_are_refused_by_us(tmp_path: Path) -> None:
    path = tmp_path / "policy.txt"
    path.write_text("no model")
    with pytest.raises(SourceError, match=r"must be an \.onnx or a \.nn"):
        check_file(path, CONSUMERS["R22"], BRAIN)


@pytest.mark.parametrize("entry", [{"continuous": -1}, {"sensors": [{"shape": [1, 2, 3, 4]}]}, {"actions": 2}])
def test_behavior_parameters_are_checked(entry: dict[str, Any], tmp_path: Path) -> None:
    import json

    from export_model.converters.consumers.unity.settings import read_brain

    path = tmp_path / "brain.json"
    path.write_text(json.dumps(entry))
    with pytest.raises(UsageError, match="Behavior Parameters"):
        read_brain(path)
