"""Policies with several kinds of sensors, and what Unity's players did with them (../shared/unity/r4).

The checker's words are Unity's own, so an original's are compared to the letter. What is written of the same sources
now must be accepted and played; where a form that Unity could not play was recorded, the form is made again here.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from export_model.converters.consumers.unity.channel_order import Order, channel_orders, keeps_last
from export_model.converters.consumers.unity.checker import UnityVerdict, check_file
from export_model.converters.consumers.unity.consumers import CONSUMERS
from export_model.converters.consumers.unity.onnx_file import OnnxFile
from export_model.converters.consumers.unity.settings import Brain, Sensor
from export_model.signatures.errors import ProfileError
from tests.exporting import export_model
from tests.unity.conftest import ABSENT, UNITY, lines

#: A ``.pt`` alone does not say which columns are whose sensor: ``--sensors`` has tests of its own.
ROWS = [r for r in lines("r4/played.jsonl") if not r["source"].endswith(".pt")] or [
    {"source": "", "profile": "", "runtime": ""}
]
RELEASES = {"R20": "R20", "R22": "R22", "3.0.0 code on Inference Engine 2.2.2": "R23"}


def agent(name: str) -> Brain:
    """The agent of a source, with the names that it had where it was recorded."""
    said = json.loads((UNITY / "r4" / f"{name}.json").read_text())
    sensors = tuple(Sensor("TSensor", f"s{i}", tuple(shape)) for i, shape in enumerate(said["sensors"]))
    vectors = sum(s.shape[0] for s in sensors if len(s.shape) == 1)
    return Brain(said["cont"], tuple(said["branches"]), vectors, 1, sensors)


def messages(verdict: UnityVerdict, mode: str = "stochastic") -> list[str]:
    return sorted(f"{f.severity.value.capitalize()}: {f.message}" for f in verdict.modes[mode].checks)


@pytest.mark.parametrize("row", ROWS, ids=lambda r: "-".join(r[k] for k in ("source", "profile", "runtime")))
def test_what_unity_said_of_several_sensors_is_said(row: dict[str, Any], tmp_path: Path) -> None:
    if not row["source"]:
        pytest.skip(ABSENT)
    path = UNITY / "r4" / Path(row["source"]).name
    brain, release = agent(path.stem), CONSUMERS[RELEASES[row["runtime"]]]
    if row["profile"] == "original":
        verdict = check_file(path, release, brain)
        assert messages(verdict) == sorted(row["checker"])
        assert verdict.plays["stochastic"] == (row["equal"] and not row["throws"])
        return
    profile, form = row["profile"].split()
    sensors = [s.shape for s in brain.sensors] if path.suffix == ".pt" else ()
    made = export_model(path, tmp_path, for_=profile, to=form, sensors=sensors, verify="none")
    (file,) = made[0].folder.glob(f"*.{form}")
    verdict = check_file(file, release, brain)
    assert verdict.accepted["stochastic"] and verdict.accepted["deterministic"], verdict.to_dict()


def test_pictures_that_are_turned_to_channels_last_turn_the_entities(tmp_path: Path) -> None:
    """As cam_buffer was written when it was recorded: a Transpose of one pixel, which a Reshape takes back."""
    path = UNITY / "r4" / "cam_buffer.onnx"
    if not path.is_file():
        pytest.skip(ABSENT)
    (row,) = (r for r in ROWS if r["source"] == "own/cam_buffer.onnx" and r["profile"] == "barracuda-3 onnx")
    (made,) = export_model(path, tmp_path, for_="barracuda-3", to="onnx", verify="none")
    file = made.folder / "cam_buffer.onnx"
    model = onnx.load(file)
    last = [n for n in model.graph.node if n.op_type == "Conv"][-1]
    position = list(model.graph.node).index(last) + 1
    for node in model.graph.node:
        node.input[:] = ["back" if name == last.output[0] else name for name in node.input]
    model.graph.initializer.append(numpy_helper.from_array(np.array([-1, 32, 1, 1]), "pixel"))
    model.graph.node.insert(position, helper.make_node("Reshape", ["turned", "pixel"], ["back"]))
    model.graph.node.insert(position, helper.make_node("Transpose", [last.output[0]], ["turned"], perm=[0, 2, 3, 1]))
    onnx.save(model, file)
    verdict = check_file(file, CONSUMERS["R20"], agent("cam_buffer"))
    assert messages(verdict) == row["checker"]
    assert row["throws"] and not verdict.plays["stochastic"]


def drawn(*nodes: Any) -> OnnxFile:
    """A camera and a list of entities, and what is made of them."""
    shapes = {"obs_0": ["N", 3, 9, 9], "obs_1": ["N", 4, 6]}
    inputs = [helper.make_tensor_value_info(n, TensorProto.FLOAT, shape) for n, shape in shapes.items()]
    kernel = numpy_helper.from_array(np.zeros((6, 3, 9, 9), np.float32), "kernel")
    sizes = {"flat": [-1, 6], "first": [-1, 6, 1, 1], "row": [-1, 1, 6], "last": [-1, 1, 1, 6]}
    constants = [kernel, *(numpy_helper.from_array(np.array(v), n) for n, v in sizes.items())]
    graph = helper.make_graph(
        [helper.make_node("Conv", ["obs_0", "kernel"], ["seen"]), *nodes],
        "policy",
        inputs,
        [helper.make_tensor_value_info("joined", TensorProto.FLOAT, None)],
        constants,
    )
    return OnnxFile(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 9)]))


JOIN = helper.make_node("Concat", ["line", "obs_1"], ["joined"], axis=1)
LINE = helper.make_node("Reshape", ["turned", "row"], ["line"])


@pytest.mark.parametrize(
    ("nodes", "kept"),
    [
        ([helper.make_node("Reshape", ["seen", "row"], ["line"]), JOIN], None),
        ([helper.make_node("Transpose", ["seen"], ["turned"], perm=[0, 2, 3, 1]), LINE, JOIN], {"obs_1"}),
        ([helper.make_node("Reshape", ["seen", "last"], ["turned"]), LINE, JOIN], {"obs_1"}),  # what comes to one
        ([helper.make_node("Transpose", ["seen"], ["turned"], perm=[0, 3, 2, 1]), LINE, JOIN], None),
        (
            [  # another way from the convolution, which turns nothing, goes before
                helper.make_node("Transpose", ["seen"], ["turned"], perm=[0, 2, 3, 1]),
                helper.make_node("Reshape", ["turned", "row"], ["half"]),
                helper.make_node("Reshape", ["seen", "row"], ["other"]),
                helper.make_node("Add", ["half", "other"], ["line"]),
                JOIN,
            ],
            None,
        ),
    ],
    ids=["as it is", "turned", "reshaped", "turned otherwise", "turned and not"],
)
def test_what_hangs_behind_a_turned_convolution_is_channels_last(nodes: list[Any], kept: set[str] | None) -> None:
    file = drawn(*nodes)
    assert keeps_last(file) == kept
    assert channel_orders(file)["seen"] is Order.NATIVE


def test_an_attention_whose_heads_lie_on_an_axis_of_their_own_is_refused_by_name(tmp_path: Path) -> None:
    """The twin of foreign/entity_attention: 3.0.0 did not import its file, nor was one of five axes ever read."""
    source = UNITY.parent / "foreign" / "entity_attention__legacy.onnx"
    if not source.is_file():
        pytest.skip(ABSENT)
    model = onnx.load(source)
    (node,) = (n for n in model.graph.node if n.name == "/a/Reshape_8")
    node.input[1] = "shape"  # the masks' shape as a constant, which the other writer of the module gives
    model.graph.initializer.append(numpy_helper.from_array(np.array([-1, 2, 1, 7]), "shape"))
    onnx.save(model, tmp_path / "twin.onnx")
    with pytest.raises(ProfileError) as refused:
        export_model(tmp_path / "twin.onnx", tmp_path / "out", for_="barracuda-3", to="onnx", verify="none")
    assert "more than four axes" in str(refused.value)
    assert export_model(tmp_path / "twin.onnx", tmp_path / "out", for_="unity6", verify="none")
    verdict = check_file(next((tmp_path / "out").rglob("*.onnx")), CONSUMERS["R20"])
    assert verdict.refused is not None and verdict.refused.exception == "ArgumentOutOfRangeException"
