"""Axes of ONNX operators are held to the rank before anything is made of them (the ops': tests/graph/test_axes.py)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.onnx.reader import read_onnx
from export_model.converters.formats.source import ReadOptions
from export_model.exporter.export.sources import read_source
from tests.graph.test_axes import HUGE, ROOM, peak


def onnx_file(op: str, operands: list[str], outputs: int = 1, **attributes: Any) -> bytes:
    """One operator over [N, 3, 4], with the constants that it may name."""
    constants = {
        "depth": np.array(5, np.int64),
        "values": np.array([0, 1], np.float32),
        "ones": np.ones(4, np.float32),
        "index": np.array([0], np.int64),
        "axes": np.array(attributes.pop("of", [0]), np.int64),
        "axis": np.array(attributes.pop("at", 0), np.int64),
        "size": np.array([1], np.int64),
        "halves": np.array([1, 2], np.int64),
    }
    made = helper.make_graph(
        [helper.make_node(op, operands, [f"y{i}" for i in range(outputs)], **attributes)],
        "axes",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["N", 3, 4])],
        [helper.make_tensor_value_info(f"y{i}", TensorProto.FLOAT, None) for i in range(outputs)],
        [numpy_helper.from_array(v, n) for n, v in constants.items() if n in operands],
    )
    return helper.make_model(made, opset_imports=[helper.make_opsetid("", 17)], ir_version=8).SerializeToString()


BY_ATTRIBUTE = {
    "Flatten": ["x"],
    "Concat": ["x", "x"],
    "Gather": ["x", "index"],
    "GatherElements": ["x", "x"],
    "OneHot": ["x", "depth", "values"],
    "ArgMax": ["x"],
    "ArgMin": ["x"],
    "Softmax": ["x"],
    "LogSoftmax": ["x"],
    "Hardmax": ["x"],
    "Split": ["x"],
    "TopK": ["x", "size"],
    "LpNormalization": ["x"],
    "LayerNormalization": ["x", "ones"],
}
BY_OPERAND = {
    "Squeeze": ["x", "axes"],
    "Unsqueeze": ["x", "axes"],
    "ReduceSum": ["x", "axes"],
    "CumSum": ["x", "axis"],
    "Slice": ["x", "index", "size", "axes"],
}
BY_LIST = ("ReduceMean", "ReduceMax", "ReduceL2", "ReduceLogSumExp", "Transpose")


def _files(axis: int) -> dict[str, bytes]:
    files = {op: onnx_file(op, list(names), axis=axis) for op, names in BY_ATTRIBUTE.items()}
    files |= {op: onnx_file(op, list(names), of=[axis], at=axis) for op, names in BY_OPERAND.items()}
    files |= {op: onnx_file(op, ["x"], axes=[axis]) for op in BY_LIST[:-1]}
    files["Transpose"] = onnx_file("Transpose", ["x"], perm=[axis, 1, 2])
    files["Unsqueeze, twice"] = onnx_file("Unsqueeze", ["x", "axes"], of=[1, 1])
    files["Transpose, twice"] = onnx_file("Transpose", ["x"], perm=[1, 1, 2])
    return files


@pytest.mark.parametrize("axis", [*HUGE, 9, -9])
def test_an_axis_outside_the_rank_is_refused_for_little(axis: int, tmp_path: Path) -> None:
    for op, data in _files(axis).items():
        path = tmp_path / "model.onnx"
        path.write_bytes(data)
        most, refused = peak(lambda path=path: read_onnx(Fetched(path)))  # type: ignore[misc]
        assert refused is not None, op
        assert most < ROOM, op


def test_a_small_file_with_a_huge_axis_is_refused_by_inspect(tmp_path: Path) -> None:
    path = tmp_path / "hot.onnx"
    path.write_bytes(onnx_file("OneHot", ["x", "depth", "values"], axis=60_000_000))
    most, refused = peak(lambda: list(read_source(path, ReadOptions()).compile_models()))
    assert refused is not None and "60000000" in f"{refused.what} {refused.why}"
    assert most < ROOM
