"""What cannot be converted is refused with the node, the op and what to do; what is damaged is called damaged."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, numpy_helper

from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.onnx.reader import read_onnx
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import (
    DamagedFileError,
    ExportModelError,
    GraphError,
    NotAPolicyError,
    UnsupportedOpError,
)
from tests.onnx_reader.models import Array, constant, declared, floats, helper, model, node, read, save

X = {"x": (np.float32, ["batch", 4])}
SEQUENCE = {"x": (np.float32, [3, "batch", 4])}
KERNELS = {"w": floats(1, 8, 4), "r": floats(1, 8, 2), "b": floats(1, 16)}


def body(kind: str) -> Any:
    return helper.make_graph([node(kind, ["x"], "out")], "body", [], [declared("out", np.float32, ["batch", 4])])


REFUSED: Mapping[str, tuple[Sequence[Any], Mapping[str, Any], Mapping[str, Array], str]] = {
    "a copy of nothing": ([node("Identity", [])], X, {}, r"Identity \(node 'y'\): input 0 is missing"),
    "an unknown op": ([node("Det", ["x"])], X, {}, r"Det \(node 'y'\): no entry of the table of ONNX ops"),
    "another domain": (
        [node("Gelu", ["x"], domain="com.microsoft")], X, {}, r"Gelu of com\.microsoft \(node 'y'\): its domain",
    ),
    "an element of a sequence that is fed": (
        [node("SplitToSequence", ["x"], "s"), node("SequenceAt", ["s", "i"])], {**X, "i": (np.int64, [])}, {},
        r"SplitToSequence \(node 's'\): no entry of the table",
    ),
    "an element of a sequence far beyond": (
        [constant("n", 1 << 62), constant("i", 3), node("SplitToSequence", ["x", "n"], "s"),
         node("SequenceAt", ["s", "i"])], X, {}, r"SplitToSequence \(node 's'\): no entry of the table",
    ),
    "a branch that is not known": (
        [
            node("ReduceMax", ["x"], "m", keepdims=0), constant("zero", 0), node("Greater", ["m", "zero"], "c"),
            node("If", ["c"], "y", then_branch=body("Relu"), else_branch=body("Neg")),
        ], X, {}, "its condition is not known",
    ),
    "a layer over any number of steps": (
        [node("LSTM", ["x", "w", "r", "b"], hidden_size=2)], {"x": (np.float32, ["batch", 1, 4])}, KERNELS,
        "it runs over any number of steps",
    ),
    "two directions": (
        [node("LSTM", ["x", "w", "r"], hidden_size=2, direction="bidirectional")],
        {"x": (np.float32, [1, "batch", 4])}, {"w": floats(2, 8, 4), "r": floats(2, 8, 2)}, "bidirectional",
    ),
    "other activations": (
        [node("LSTM", ["x", "w", "r"], hidden_size=2, activations=["Relu", "Tanh", "Tanh"])],
        {"x": (np.float32, [1, "batch", 4])}, KERNELS, "its activations are relu",
    ),
    "statistics of the batch": (
        [node("BatchNormalization", ["x", "s", "b", "m", "v"], training_mode=1)], X,
        {k: np.ones(4, np.float32) for k in "sbmv"}, "training mode",
    ),
    "more of the best than there are": (
        [constant("k", [9], np.int64), node("TopK", ["x", "k"], ["y", "i"])], X, {}, "takes 9 of 4",
    ),
    "a padding of no kind": (
        [constant("p", [0, 1, 0, 1], np.int64), node("Pad", ["x", "p"], mode="best")], X, {}, "'best'",
    ),
    "where values decide how many": ([node("NonZero", ["x"])], X, {}, "computed while the graph runs"),
    "strings": ([node("Constant", [], "s", value_string="x"), node("Add", ["x", "s"])], X, {}, "no numbers"),
    "counting without end": (
        [
            constant("a", 0, np.int64), constant("b", 1 << 40, np.int64), constant("d", 1, np.int64),
            node("Range", ["a", "b", "d"], "r"), node("Shape", ["r"]),
        ], X, {}, "it counts from",
    ),
    "more parts than outputs": ([node("Split", ["x"], axis=1, num_outputs=1 << 40)], X, {}, "parts for 1 outputs"),
    "indices of the largest": (
        [node("MaxPool", ["x"], ["m", "i"], kernel_shape=[2]), node("Cast", ["i"], to=1)],
        {"x": (np.float32, ["batch", 2, 8])}, {}, "its output 'i' is not made",
    ),
    "a loop": (
        [
            constant("n", 3, np.int64), constant("c", True, np.bool_),
            node("Loop", ["n", "c", "x"], "y", body=helper.make_graph([], "body", [], [])),
        ], X, {}, "it is a loop",
    ),
    "an element behind the last": (
        [constant("i", 4, np.int64), node("Gather", ["x", "i"], axis=1)], X, {}, "an axis of 4 does not have",
    ),
    "elements before the first": (
        [constant("i", [0, -5], np.int64), node("Gather", ["x", "i"], axis=1)], X, {}, "an axis of 4 does not have",
    ),
    "an equation with traces": ([node("Einsum", ["x"], equation="bb->b")], {"x": (np.float32, [4, 4])}, {}, "plain"),
    "an equation that repeats a row": (
        [node("Einsum", ["x", "w"], equation="bi,bi->bi")], X, {"w": floats(1, 4)}, "'b' has length 1",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_refused(what: str, tmp_path: Path) -> None:
    nodes, inputs, constants, text = REFUSED[what]
    message = model(nodes, inputs, ["y"], constants, domains={"com.microsoft": 1})
    with pytest.raises(UnsupportedOpError, match=text) as caught:
        read(message, tmp_path)
    assert caught.value.issues
    assert caught.value.fix


def test_all_ops_that_are_not_known_are_named(tmp_path: Path) -> None:
    message = model([node("Det", ["x"], "a"), node("Unique", ["a"], "b"), node("Relu", ["b"])], X)
    with pytest.raises(UnsupportedOpError, match=r"also: Unique") as caught:
        read(message, tmp_path)
    assert [op for _, op in caught.value.issues] == ["Det", "Unique"]


def test_an_output_that_no_policy_needs_is_left_out(tmp_path: Path) -> None:
    message = model([node("Det", ["x"], "other"), node("Relu", ["x"], "action")], X, ["other", "action"])
    found = read(message, tmp_path)
    assert list(found.outputs) == ["action"]
    assert "Det" in found.left_out["other"]
    (policy,) = read_source(tmp_path / "model.onnx").policies()
    assert any("the output other is left out" in note for note in policy.signature.notes)


def test_a_memory_alone_is_no_policy_that_was_asked_for(tmp_path: Path) -> None:
    """The action was dropped with a note, and the file then had "no policy"; what is quantised says what to give."""
    nodes = [node("DynamicQuantizeLinear", ["x"], ["q", "s", "z"]), node("MatMulInteger", ["q", "q"], "moves")]
    message = model([*nodes, node("Relu", ["x"], "h_out")], X, ["moves", "h_out"])
    with pytest.raises(UnsupportedOpError, match=r"QuantizeLinear.*also: MatMulInteger") as caught:
        read(message, tmp_path)
    assert "the model is quantised" in str(caught.value)


def test_strings_that_no_policy_needs_are_no_matter(tmp_path: Path) -> None:
    text = helper.make_tensor("t", TensorProto.STRING, [1], [b"a name"])
    message = model([node("Constant", [], "label", value=text), node("Relu", ["x"], "action")], X, ["action"])
    assert list(read(message, tmp_path).outputs) == ["action"]


def test_an_old_opset_is_refused_with_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(UnsupportedOpError, match="opset 6") as caught:
        read(model([node("Relu", ["x"])], X, opset=6), tmp_path)
    assert "version_converter" in str(caught.value)


def test_doubles_in_between_are_narrowed(tmp_path: Path) -> None:
    message = model(
        [
            node("Cast", ["x"], "wide", to=TensorProto.DOUBLE),
            node("Mul", ["wide", "c"], "p"),
            node("Cast", ["p"], "action", to=1),
        ],
        X,
        ["action"],
        {"c": np.array([0.1], np.float64)},
    )
    assert read(message, tmp_path).doubles
    (policy,) = read_source(tmp_path / "model.onnx").policies()
    assert any("float64" in note for note in policy.signature.notes)


# ------------------------------------------------------------------ damage


def small() -> Any:
    return model(
        [node("Gemm", ["x", "w", "b"], "h"), node("Tanh", ["h"], "action")],
        {"x": (np.float32, ["batch", 4])},
        {"action": (np.float32, ["batch", 2])},
        {"w": floats(4, 2), "b": floats(2)},
    )


def test_a_file_cut_anywhere_is_refused(tmp_path: Path) -> None:
    data = small().SerializeToString()
    for length in range(0, len(data), 3):
        path = tmp_path / "cut.onnx"
        path.write_bytes(data[:length])
        with pytest.raises(ExportModelError):
            read_source(path).policies()


def test_bytes_changed_at_random_never_end_in_a_traceback(tmp_path: Path) -> None:
    data = small().SerializeToString()
    chance = random.Random(5)
    path = tmp_path / "changed.onnx"
    for _ in range(300):
        changed = bytearray(data)
        for _ in range(chance.randrange(1, 4)):
            changed[chance.randrange(len(data))] = chance.randrange(256)
        path.write_bytes(bytes(changed))
        try:
            read_source(path).policies()
        except ExportModelError as error:
            assert error.exit_status == 2


def changed(change: Any) -> Any:
    message = small()
    change(message.graph)
    return message


def dangling(graph: Any) -> None:
    graph.node[0].input[0] = "nowhere"


def twice(graph: Any) -> None:
    graph.node[0].output[0] = "action"
    graph.node[1].input[0] = "action"


def no_output(graph: Any) -> None:
    graph.output[0].name = "nowhere"


def two_inputs(graph: Any) -> None:
    graph.input.append(graph.input[0])


def short_data(graph: Any) -> None:
    graph.initializer[0].raw_data = graph.initializer[0].raw_data[:-4]


def huge_dims(graph: Any) -> None:
    graph.initializer[0].dims[:] = [1 << 40, 1 << 40]


def negative_dims(graph: Any) -> None:
    graph.initializer[0].dims[0] = -4


def large_halves(graph: Any) -> None:
    graph.initializer[0].data_type = TensorProto.FLOAT16
    graph.initializer[0].ClearField("raw_data")
    graph.initializer[0].int32_data[:] = [1 << 16] * 8


DAMAGE = (
    large_halves,
    dangling,
    twice,
    no_output,
    two_inputs,
    short_data,
    huge_dims,
    negative_dims,
)


@pytest.mark.parametrize("change", DAMAGE, ids=lambda change: change.__name__)
def test_damage_is_called_so(change: Any, tmp_path: Path) -> None:
    with pytest.raises(DamagedFileError):
        read(changed(change), tmp_path)


@pytest.mark.parametrize(("inputs", "outputs"), [([], ["copy"]), (["x"], [])])
def test_a_copy_of_or_into_nothing_that_no_output_needs_is_no_matter(
    inputs: list[str], outputs: list[str], tmp_path: Path
) -> None:
    message = changed(lambda graph: graph.node.append(helper.make_node("Identity", inputs, outputs)))
    assert [n.op for n in read(message, tmp_path).graph.nodes] == [n.op for n in read(small(), tmp_path).graph.nodes]


def test_a_small_file_cannot_ask_for_much_memory(tmp_path: Path) -> None:
    message = model(
        [
            constant("s", [1 << 20, 1 << 20], np.int64),
            node("ConstantOfShape", ["s"], "c"),
            node("MatMul", ["x", "c"], "action"),
        ],
        {"x": (np.float32, ["batch", 1 << 20])},
        ["action"],
    )
    with pytest.raises(GraphError, match="1099511627776 elements"):  # nothing that large is made
        read(message, tmp_path)


def test_no_nodes(tmp_path: Path) -> None:
    path = tmp_path / "empty.onnx"
    path.write_bytes(onnx.ModelProto(ir_version=8).SerializeToString())
    with pytest.raises(NotAPolicyError):
        read_onnx(Fetched(path))


# ------------------------------------------------------------------ external data


def external(folder: Path, location: str, offset: int = 0, length: int | None = None) -> Path:
    message = small()
    tensor = message.graph.initializer[0]
    data = numpy_helper.to_array(tensor).tobytes()
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("location", location), ("offset", offset), ("length", length or len(data))):
        tensor.external_data.add(key=key, value=str(value))
    (folder / "weights.data").write_bytes(bytes(offset) + data)
    return save(message, folder)


@pytest.mark.parametrize("offset", [0, 64])
def test_weights_beside_the_model_are_read(offset: int, tmp_path: Path) -> None:
    path = external(tmp_path, "weights.data", offset)
    source = read_source(path)
    weights = next(n for n in source.models[0].graph.nodes if n.origin == "w")
    np.testing.assert_array_equal(weights.value, floats(4, 2))
    assert set(source.models[0].files) == {path, tmp_path / "weights.data"}


@pytest.mark.parametrize(
    "location", ["../weights.data", "/etc/passwd", "", "sub/../../weights.data", ".", "missing.data", "a\0b"]
)
def test_weights_outside_of_the_folder_are_refused(location: str, tmp_path: Path) -> None:
    folder = tmp_path / "inner"
    folder.mkdir()
    (tmp_path / "weights.data").write_bytes(bytes(64))
    with pytest.raises(DamagedFileError, match=r"folder|not there"):
        read_onnx(Fetched(external(folder, location)))


def test_a_link_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "inner"
    folder.mkdir()
    (tmp_path / "secret").write_bytes(bytes(64))
    path = external(folder, "link.data")
    (folder / "link.data").symlink_to(tmp_path / "secret")
    with pytest.raises(DamagedFileError, match="outside"):
        read_onnx(Fetched(path))


@pytest.mark.parametrize(("offset", "length"), [(0, 4096), (4096, 32), (-8, 32)])
def test_weights_that_are_too_short_are_refused(offset: int, length: int, tmp_path: Path) -> None:
    path = external(tmp_path, "weights.data", 0, length)
    message = onnx.ModelProto.FromString(path.read_bytes())
    entry = next(e for e in message.graph.initializer[0].external_data if e.key == "offset")
    entry.value = str(offset)
    save(message, tmp_path)
    with pytest.raises(DamagedFileError):
        read_onnx(Fetched(path))
