"""Files of more nodes than any policy has, and of one node with very many inputs: refused or read, at once."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.compiler import compile
from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.barracuda import format as nn
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.formats.saved_model import signature
from export_model.converters.graph.ops.barracuda import builder
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import MAX_LINE, DamagedFileError, GraphError, NotAPolicyError, UnsupportedOpError
from tests.barracuda.nn_files import write_nn
from tests.barracuda.nn_running import nn_model
from tests.handmade import constant, continuous_policy, graph_bytes, graph_def, node
from tests.hostile import zoo

MANY = 60


def frozen(folder: Path) -> Path:
    return zoo.frozen(folder, [*continuous_policy(), *(constant(f"c{i}", 1.0) for i in range(MANY))])


def functions(folder: Path) -> Path:
    return zoo.saved(folder, zoo.calling([constant(f"c{i}", 1.0) for i in range(MANY)], ()), "called:0")


def onnx(folder: Path) -> Path:
    from onnx import helper

    path = folder / "policy.onnx"
    path.write_bytes(zoo.onnx_policy([helper.make_node("Relu", ["obs_0"], [f"o{i}"]) for i in range(MANY)]))
    return path


def web(folder: Path) -> Path:
    nodes = [{"name": f"n{i}", "op": "Placeholder"} for i in range(MANY)]
    (folder / "model.json").write_text(json.dumps({"modelTopology": {"node": nodes}, "weightsManifest": []}))
    return folder


@pytest.mark.parametrize("make", [frozen, functions, onnx, web])
def test_more_nodes_than_any_file_has_are_refused(
    make: Callable[[Path], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = make(tmp_path)
    monkeypatch.setattr(schema, "MAX_GRAPHDEF_NODES", MANY - 1)
    with pytest.raises(NotAPolicyError, match=f"no more than {MANY - 1} are read"):
        read_source(path)


def test_more_layers_than_any_nn_has_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    layers = tuple(nn.Layer(f"l{i}", 50) for i in range(MANY))
    data = write_nn(nn.NnModel(16, (), (), (), layers, np.zeros(0, np.float32)))
    assert len(nn.parse(data).layers) == MANY
    monkeypatch.setattr(nn, "MAX_LAYERS", MANY - 1)
    with pytest.raises(DamagedFileError, match=f"no more than {MANY - 1} are read"):
        nn.parse(data)


def test_a_node_of_many_inputs_is_put_in_order_once() -> None:
    """What was looked through again at every input took minutes for these."""
    count = 60_000
    graph = read_graph(graph_bytes([*continuous_policy(), node("sum", "AddN", *["mu"] * count)]))
    assert len(graph["sum"].inputs) == count


def test_a_name_of_an_onnx_that_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "policy.onnx"
    path.write_bytes(zoo.onnx_policy().replace(b"obs_0", b"ob\xff_0"))
    with pytest.raises(DamagedFileError, match="must be text"):
        read_source(path)


def test_a_shard_that_is_named_twice_is_refused(tmp_path: Path) -> None:
    manifest = [{"paths": ["w.bin", "./w.bin"], "weights": []}]
    (tmp_path / "w.bin").write_bytes(b"1234")
    (tmp_path / "model.json").write_text(json.dumps({"modelTopology": {"node": []}, "weightsManifest": manifest}))
    with pytest.raises(DamagedFileError, match="named twice"):
        read_source(tmp_path)


@pytest.mark.parametrize("manifest", [7, [None], [{"paths": 7, "weights": []}], [{"paths": ["w.bin"], "weights": [1]}]])
def test_a_manifest_of_another_form_is_refused(manifest: object, tmp_path: Path) -> None:
    (tmp_path / "w.bin").write_bytes(b"1234")
    for topology in ({"node": []}, {"model_config": {}}):
        (tmp_path / "model.json").write_text(json.dumps({"modelTopology": topology, "weightsManifest": manifest}))
        with pytest.raises(DamagedFileError, match="weightsManifest"):
            read_source(tmp_path)


@pytest.mark.parametrize("attribute", ['{"i": 1e999}', '{"shape": {"dim": [{"size": 1e999}]}}'])
def test_an_endless_number_in_a_model_json_is_damage(attribute: str, tmp_path: Path) -> None:
    one = f'{{"name": "a", "op": "Placeholder", "attr": {{"shape": {attribute}}}}}'
    (tmp_path / "model.json").write_text(f'{{"modelTopology": {{"node": [{one}]}}, "weightsManifest": []}}')
    with pytest.raises(DamagedFileError, match=r"not in TensorFlow\.js's form"):
        read_source(tmp_path)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (node("odd", "Switch", "mu"), "does not belong to a loop"),
        (node("odd", "Mean", "mu", "mu", keep_dims="yes"), "must be true or false"),
        (node("odd", "Tanh", "mu", "mu"), "it takes 1 inputs"),
        (node("odd", "BiasAdd", "mu", "mu/bias", "mu/bias"), "it takes 2 inputs"),
        (node("odd", "StridedSlice", *["mu"] * 5), "it takes 4 inputs"),
        (node("odd", "OneHot", "mu", "mu", "mu"), "it takes 4 inputs"),
        (node("odd", "Squeeze", "mu", squeeze_dims=1.5), "must be an integer"),
        (node("odd", "LeakyRelu", "mu", alpha="x"), "must be a number|does not allow"),
    ],
)
def test_a_node_that_is_not_as_its_op_has_it_is_named(made: object, said: str, tmp_path: Path) -> None:
    nodes = continuous_policy()
    nodes[-1].input[0] = "odd"
    path = zoo.frozen(tmp_path, [*nodes, made])
    with pytest.raises(GraphError, match=said) as caught:
        read_source(path).policies()
    assert "odd" in str(caught.value)


def test_an_attribute_of_an_onnx_node_of_another_kind_is_named(tmp_path: Path) -> None:
    from onnx import helper

    path = tmp_path / "policy.onnx"
    path.write_bytes(zoo.onnx_policy([helper.make_node("LeakyRelu", ["obs_0"], ["continuous_actions"], alpha="much")]))
    with pytest.raises(UnsupportedOpError, match="its attribute alpha is 'much'"):
        read_source(path)


def test_a_sum_that_names_one_tensor_again_and_again_is_refused(tmp_path: Path) -> None:
    """200,000 names of five bytes took 26 s and 900 MB."""
    nodes = [*continuous_policy(), node("total", "AddN", *["mu"] * (compile.MAX_READ + 1))]
    next(n for n in nodes if n.name == "action").input[0] = "total"
    with pytest.raises(NotAPolicyError, match="tensors that its nodes read"):
        read_source(zoo.frozen(tmp_path, nodes)).policies()


def test_a_signature_of_more_outputs_than_any_policy_has_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = zoo.saved(tmp_path, graph_def(continuous_policy()), "action:0")
    assert read_source(path).policies()
    monkeypatch.setattr(signature, "MAX_PORTS", 0)
    with pytest.raises(NotAPolicyError, match="its signature has"):
        read_source(path)


def test_a_tensor_of_no_number_is_refused_by_its_dtype() -> None:
    """A signature may name a variable's handle, whose dtype is numpy's object: a KeyError of the last net's."""
    with pytest.raises(DamagedFileError, match="a tensor of object"):
        schema.dtype_number(np.dtype(object))


def constant_of_a_graph(model: Any) -> None:
    made = model.graph.node.add(op_type="Constant", name="odd", output=["odd"]).attribute.add(name="value", type=5)
    made.t.data_type, made.t.raw_data = 1, bytes(4)


def half_of_three_bytes(model: Any) -> None:
    model.graph.initializer.add(name="odd", data_type=10, raw_data=b"123", dims=[1])


def opset_beyond_int32(model: Any) -> None:
    model.opset_import[0].version = 1 << 40
    model.graph.node[-1].op_type = "CenterCropPad"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (constant_of_a_graph, "it holds no numbers"),
        (half_of_three_bytes, "are no 16-bit numbers"),
        (opset_beyond_int32, "CenterCropPad"),
    ],
)
def test_an_onnx_that_is_not_as_onnx_has_it_is_refused_by_a_check(
    change: Callable[[Any], None], said: str, tmp_path: Path
) -> None:
    import onnx
    from onnx import helper

    nodes = [
        helper.make_node("MatMul", ["obs_0", "kernel"], ["product"]),
        helper.make_node("Add", ["product", "odd"], ["continuous_actions"]),
    ]
    model = onnx.ModelProto.FromString(zoo.onnx_policy(nodes))
    change(model)
    model.graph.node.sort(key=lambda n: n.op_type != "Constant")
    (tmp_path / "policy.onnx").write_bytes(model.SerializeToString())
    with pytest.raises((UnsupportedOpError, DamagedFileError), match=said):
        read_source(tmp_path / "policy.onnx").policies()


@pytest.mark.parametrize("what", ["inputs", "outputs"])
def test_more_inputs_or_outputs_than_any_policy_has_are_refused(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import onnx
    from onnx import helper

    more = [helper.make_tensor_value_info(f"x{i}", 1, ["batch", 2]) for i in range(MANY)]
    read = helper.make_node("Sum", ["product", *(v.name for v in more)], ["continuous_actions"])
    if what == "outputs":
        read = helper.make_node("Relu", ["product"], ["continuous_actions"])
    made = [helper.make_node("Relu", ["product"], [v.name]) for v in more if what == "outputs"]
    product = helper.make_node("MatMul", ["obs_0", "kernel"], ["product"])
    model = onnx.ModelProto.FromString(zoo.onnx_policy([product, read, *made]))
    getattr(model.graph, "input" if what == "inputs" else "output").extend(more)
    path = tmp_path / "policy.onnx"
    path.write_bytes(model.SerializeToString())
    assert read_source(path).policies()
    monkeypatch.setattr(compile, "MAX_PORTS", MANY)
    with pytest.raises(NotAPolicyError, match=f"the policy has {MANY + 1} {what}"):
        read_source(path).policies()


def test_a_nn_of_more_joined_tensors_than_any_policy_has_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    join = node("join", "ConcatV2", *["mu"] * MANY, "axis", N=MANY, T=np.float32, Tidx=np.int32)
    nodes = [*continuous_policy()[:-1], constant("axis", 1), join, node("action", "Tanh", "join", T=np.float32)]
    (policy,) = read_source(zoo.frozen(tmp_path, nodes)).policies()
    assert nn_model(policy)
    monkeypatch.setattr(builder, "MAX_PIECES", MANY - 1)
    with pytest.raises(UnsupportedOpError, match=f"{MANY} tensors are joined"):
        nn_model(policy)


def test_what_a_layer_is_called_is_a_text(tmp_path: Path) -> None:
    """A tree of lists there was written out into the message, which took seconds."""
    for wrong in ({"class_name": [["x"]]}, {"class_name": "Dense", "config": {"name": [["x"]]}}):
        layers = {"class_name": "Sequential", "config": {"name": "s", "layers": [{"config": {}, **wrong}]}}
        content = {"modelTopology": {"model_config": layers}, "weightsManifest": []}
        (tmp_path / "model.json").write_text(json.dumps(content))
        with pytest.raises(DamagedFileError, match="a name is a list"):
            read_source(tmp_path)


def test_a_message_holds_no_name_of_any_length() -> None:
    said = str(DamagedFileError("a" * 100_000, why=f"it is so\n{'b' * 100_000}"))
    assert "(100000 characters)" in said
    assert "it is so\n" in said
    assert len(said) < 4 * MAX_LINE
