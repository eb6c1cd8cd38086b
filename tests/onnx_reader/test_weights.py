"""Where a model's weights may lie, and in what precision: each is the same policy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper

from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.onnx import proto
from export_model.converters.formats.onnx.reader import read_onnx
from export_model.converters.formats.onnx.vetted import safe_copy, self_contained_model
from export_model.signatures.errors import DamagedFileError, UnsupportedOpError
from tests.onnx_reader.models import constant, floats, model, node

W = floats(8, 256).astype(np.float16)
IN = {"obs": (np.float32, ["batch", 8])}


def with_weights(where: str, weights: np.ndarray) -> Any:
    """A product with weights that are an initializer, a constant, or a constant of a body or of a function."""
    dtype = weights.dtype
    given = {"obs": (dtype, ["batch", 8])}
    product = node("MatMul", ["obs", "w"], "action")
    held = node("Constant", [], "w", value=numpy_helper.from_array(weights))
    if where == "initializer":
        return model([product], given, ["action"], {"w": weights})
    if where == "constant":
        return model([held, product], given, ["action"])
    outputs = [helper.make_tensor_value_info("v", helper.np_dtype_to_tensor_dtype(dtype), [8, 256])]
    same = node("Identity", ["w"], "v")
    inner = [numpy_helper.from_array(weights, "w")] if where == "initializer of a body" else []
    body = helper.make_graph([same] if inner else [held, same], "body", [], outputs, inner)
    chosen = node("If", ["yes"], "v", then_branch=body, else_branch=body)
    product = node("MatMul", ["obs", "v"], "action")
    return model([constant("yes", True, np.bool_), chosen, product], given, ["action"])


PLACES = ["initializer", "constant", "initializer of a body", "constant of a body"]


@pytest.mark.parametrize("beside", [False, True])
@pytest.mark.parametrize("dtype", [np.float16, np.float32])
@pytest.mark.parametrize("where", PLACES)
def test_weights_are_the_same_wherever_they_lie(where: str, dtype: Any, beside: bool, tmp_path: Path) -> None:
    path, options = tmp_path / "m.onnx", {}
    if beside:
        options = {"save_as_external_data": True, "location": "m.data", "size_threshold": 0, "convert_attribute": True}
    onnx.save_model(with_weights(where, W.astype(dtype)), path, **options)
    graph = read_onnx(Fetched(path)).graph
    found = [n.value for n in graph.nodes if n.value is not None and n.value.size == W.size]
    assert found
    for value in found:
        np.testing.assert_array_equal(value, W.astype(np.float32))


def external(name: str, shape: list[int], location: str, length: int | None = None) -> Any:
    tensor = onnx.TensorProto(name=name, data_type=1, dims=shape, data_location=1)
    tensor.external_data.add(key="location", value=location)
    if length is not None:
        tensor.external_data.add(key="length", value=str(length))
    return tensor


def test_a_constant_whose_data_is_longer_than_its_shape_is_damaged(tmp_path: Path) -> None:
    """What stands for large data has 24 bytes, which are never numbers."""
    (tmp_path / "w.bin").write_bytes(bytes(8192))
    nodes = [
        node("Constant", [], "w", value=external("w", [1, 6], "w.bin")),
        node("Add", ["obs", "w"], "action"),
    ]
    message = model(nodes, {"obs": (np.float32, ["batch", 6])}, {"action": (np.float32, ["batch", 6])})
    (tmp_path / "m.onnx").write_bytes(message.SerializeToString())
    with pytest.raises(DamagedFileError, match="holds 8192 bytes where its shape needs 24"):
        read_onnx(Fetched(tmp_path / "m.onnx"))


def test_files_beside_a_model_are_bounded_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(proto, "MAX_WEIGHTS", 1 << 20)
    message = model([node("Add", ["obs", "w0"], "action")], {"obs": (np.float32, ["batch", 1])}, ["action"])
    for number in range(3):
        (tmp_path / f"{number}.bin").write_bytes(bytes(1 << 19))
        message.graph.initializer.append(external(f"w{number}", [1], f"{number}.bin", 4))
    (tmp_path / "m.onnx").write_bytes(message.SerializeToString())
    with pytest.raises(DamagedFileError, match="beside the model are"):
        read_onnx(Fetched(tmp_path / "m.onnx"))


def test_functions_that_name_one_file_hold_it_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "w.bin").write_bytes(bytes(1 << 14))
    message = model([node("Identity", ["obs"], "action")], IN, ["action"])
    opsets = [helper.make_opsetid("", 15)]
    for number in range(30):
        held = node("Constant", [], "w", value=external("w", [1 << 12], "w.bin"))
        message.functions.append(helper.make_function("own", f"f{number}", [], ["w"], [held], opsets))
    (tmp_path / "m.onnx").write_bytes(message.SerializeToString())
    with pytest.raises(DamagedFileError, match="again and again"):
        self_contained_model(tmp_path / "m.onnx")


@pytest.mark.parametrize("field", ["t", "tensors", "sparse_tensor"])
def test_a_default_of_a_functions_attribute_names_no_file_elsewhere(field: str, tmp_path: Path) -> None:
    """onnxruntime 1.20 reads it, wherever it lies; at "*/_ORT_MEM_ADDR_/*" any of its own memory."""
    message, default = with_default(tmp_path)
    held = external("w", [2], "../elsewhere.bin", 8)
    place = getattr(default, field)
    place.append(held) if field == "tensors" else (place if field == "t" else place.values).CopyFrom(held)
    (tmp_path / "m.onnx").write_bytes(message.SerializeToString())
    with pytest.raises(DamagedFileError, match=r"elsewhere\.bin"):
        self_contained_model(tmp_path / "m.onnx")


def test_a_default_of_a_functions_attribute_has_no_custom_operator(tmp_path: Path) -> None:
    message, default = with_default(tmp_path)
    default.g.node.append(node("Evil", ["obs"], "z", domain="evil.lib"))
    (tmp_path / "m.onnx").write_bytes(message.SerializeToString())
    with pytest.raises(UnsupportedOpError, match="evil"):
        self_contained_model(tmp_path / "m.onnx")


def with_default(folder: Path) -> tuple[Any, Any]:
    """A model with a function, and the default of its attribute."""
    message = model([node("Identity", ["obs"], "action")], IN, ["action"])
    body = [node("Identity", ["x"], "y")]
    message.functions.append(helper.make_function("own", "f", ["x"], ["y"], body, [helper.make_opsetid("", 15)]))
    return message, message.functions[0].attribute_proto.add(name="value", type=4)


def test_what_no_reader_knows_is_handed_to_no_runtime(tmp_path: Path) -> None:
    """An unknown group, which protobuf keeps, beside weights in another file."""
    (tmp_path / "w.bin").write_bytes(np.arange(2048, dtype="<f4").tobytes())
    message = model([node("MatMul", ["obs", "w"], "action")], IN, ["action"])
    message.graph.initializer.append(external("w", [8, 256], "w.bin"))
    group = b"\xc3\x3e\xc4\x3e"  # start and end of group 1000
    graph = message.graph.SerializeToString() + group
    message.ClearField("graph")
    path = tmp_path / "m.onnx"
    size = len(graph)
    path.write_bytes(message.SerializeToString() + b"\x3a" + bytes([size & 0x7F | 0x80, size >> 7]) + graph + group)
    (tmp_path / "copy").mkdir()
    copy = onnx.load(safe_copy(path, [], tmp_path / "copy"))
    np.testing.assert_array_equal(numpy_helper.to_array(copy.graph.initializer[0]).ravel(), np.arange(2048))
