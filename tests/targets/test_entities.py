"""Observations of two axes (entities, histories, lidar) under the profiles for Barracuda.

ML-Agents writes their numbers one after the other, and Barracuda has [N, E, F] there with E and F exchanged
(../shared/unity/r3/minimal/rank2.jsonl): what is emitted has to undo that, and the player model has to say so.
"""

from __future__ import annotations

from pathlib import Path

import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

pytest.importorskip("onnxruntime")

import numpy as np

from export_model.converters.consumers.profiles import profile
from export_model.signatures.errors import ProfileError
from tests.targets.dressed import Pair, as_written, compiled

FOREIGN = Path(__file__).resolve().parents[3] / "shared" / "foreign"
BARRACUDA = ("barracuda-3", "barracuda-1.4")


def policy_file(folder: Path, form: str, count: int, width: int) -> Path:
    """A policy that takes [N, count, width] in one of the forms of rank2.jsonl, and a vector of 3 beside it."""
    rng = np.random.default_rng(count * width)
    size = {"flat": count * width, "per_entity": 5, "mul": count}[form]
    weights = {
        "kernel": rng.normal(size=(size + 3, 2)),
        "entity": rng.normal(size=(width, 5)),
        "scale": rng.normal(size=(1, count, width)),
    }
    constants = [numpy_helper.from_array(np.asarray(v, np.float32), k) for k, v in weights.items()]
    constants.append(numpy_helper.from_array(np.array([-1, size], np.int64), "row"))
    nodes = {
        "flat": [helper.make_node("Reshape", ["obs_0", "row"], ["seen"])],
        "per_entity": [
            helper.make_node("MatMul", ["obs_0", "entity"], ["entities"]),
            helper.make_node("ReduceMean", ["entities"], ["seen"], axes=[1], keepdims=0),
        ],
        "mul": [
            helper.make_node("Mul", ["obs_0", "scale"], ["scaled"]),
            helper.make_node("ReduceMean", ["scaled"], ["seen"], axes=[2], keepdims=0),
        ],
    }[form]
    nodes += [
        helper.make_node("Concat", ["seen", "obs_1"], ["joined"], axis=1),
        helper.make_node("MatMul", ["joined", "kernel"], ["sums"]),
        helper.make_node("Tanh", ["sums"], ["action"]),
    ]
    graph = helper.make_graph(
        nodes,
        "entities",
        [
            helper.make_tensor_value_info("obs_0", TensorProto.FLOAT, ["N", count, width]),
            helper.make_tensor_value_info("obs_1", TensorProto.FLOAT, ["N", 3]),
        ],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["N", 2])],
        constants,
    )
    path = folder / f"{form}.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 12)], ir_version=7), path)
    return path


@pytest.mark.parametrize("form", ["flat", "per_entity", "mul"])
@pytest.mark.parametrize(("count", "width"), [(3, 4), (4, 4), (1, 6), (6, 1), (7, 2)])
@pytest.mark.parametrize("wanted", BARRACUDA)
def test_an_onnx_acts_the_same_on_what_release_20_writes(
    wanted: str, count: int, width: int, form: str, tmp_path: Path
) -> None:
    (policy,) = compiled(policy_file(tmp_path, form, count, width))
    pair = Pair.of(policy, profile(wanted))
    for seed, rows in enumerate((1, 3, 16)):
        assert pair.difference(rows, seed) is None
    for name, verdict in pair.verdicts(tmp_path).items():
        said = verdict.accepted if name in pair.profile.players else verdict.checked
        assert all(said.values()), verdict.to_dict()


@pytest.mark.parametrize(("count", "width"), [(3, 4), (6, 1), (7, 2)])
@pytest.mark.parametrize("wanted", BARRACUDA)
def test_a_nn_acts_the_same_on_what_release_20_writes(wanted: str, count: int, width: int, tmp_path: Path) -> None:
    (policy,) = compiled(policy_file(tmp_path, "flat", count, width))
    pair = Pair.of(policy, profile(wanted), form="nn")
    for seed, rows in enumerate((1, 3, 16)):
        assert pair.difference(rows, seed) is None


def test_what_is_fed_here_is_what_ml_agents_writes() -> None:
    """The second row is the one that Barracuda shows where ML-Agents wrote 0 to 5 as [2, 3]: (f, e) at 2 f + e."""
    written = as_written(np.arange(6, dtype=np.float32).reshape(1, 2, 3))
    assert written.tolist() == [[[0, 2, 4], [1, 3, 5]]]


def test_unity_6_takes_them_as_they_are(tmp_path: Path) -> None:
    (policy,) = compiled(policy_file(tmp_path, "flat", 3, 4))
    pair = Pair.of(policy, profile("unity6"))
    assert "Transpose" not in {n.op_type for n in pair.made.graph.node}
    assert pair.difference(3, 0) is None


@pytest.mark.corpus
@pytest.mark.parametrize("wanted", BARRACUDA)
def test_a_stride_of_one_axis_alone_goes_into_a_nn(wanted: str) -> None:
    """Barracuda takes the stride of the height for that of the width: 116 numbers instead of 60 in cases/rank2_…."""
    path = FOREIGN / "lidar_conv1d__dynamo.onnx"
    if not path.is_file():
        pytest.skip("../shared/foreign is not beside this checkout")
    (policy,) = compiled(path)
    with pytest.raises(ProfileError, match="strides of lengths that differ by axis") as refused:
        Pair.of(policy, profile(wanted))
    assert "--to nn" in (refused.value.fix or "")
    pair = Pair.of(policy, profile(wanted), form="nn")
    for seed, rows in enumerate((1, 3, 8)):
        assert pair.difference(rows, seed) is None
