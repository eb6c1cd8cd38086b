"""What the cases of the zoo are made with: nodes that act, graphs, SavedModels and ONNX models around them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from export_model.converters.files import tensorflow_messages as schema
from tests.handmade import constant, graph_bytes, graph_def, node, placeholder

Maker = Callable[[Path, Path], Path]


@dataclass(frozen=True)
class Case:
    """One file: ``source`` is read as a source, ``candidate`` compared, ``bundle`` verified, served, snipped."""

    make: Maker
    kind: str = "source"


CASES: dict[str, Case] = {}


def case(name: str, kind: str = "source") -> Callable[[Maker], Maker]:
    """Register a maker."""

    def registered(make: Maker) -> Maker:
        assert name not in CASES, name
        CASES[name] = Case(make, kind)
        return make

    return registered


def writer(marker: Path, name: str = "write_file", op: str = "WriteFile", prefix: str = "") -> list[Any]:
    """A node that writes the marker when it runs."""
    path, text = f"{prefix}{name}/path", f"{prefix}{name}/text"
    return [constant(path, str(marker).encode()), constant(text, b"x"), node(f"{prefix}{name}", op, path, text)]


def saving(marker: Path, name: str = "write_file") -> list[Any]:
    """SaveV2, which writes a checkpoint."""
    strings = [("prefix", [str(marker).encode()]), ("names", [b"w"]), ("slices", [b""])]
    nodes = [constant(f"{name}/{key}", value) for key, value in strings]
    nodes[0] = constant(f"{name}/prefix", str(marker).encode())
    save = node(name, "SaveV2", *(n.name for n in nodes), f"{name}/w", dtypes=(np.float32,))
    return [*nodes, constant(f"{name}/w", 1.0), save]


def printing(marker: Path, name: str = "write_file") -> list[Any]:
    """PrintV2 into a file."""
    text = constant(f"{name}/text", b"x")
    return [text, node(name, "PrintV2", text.name, output_stream=f"file://{marker}", end="\n")]


def python(marker: Path, name: str = "write_file") -> list[Any]:
    """A function of the loader's own process."""
    return [node(name, "PyFunc", token=f"open({str(marker)!r}, 'w')", Tin=(), Tout=())]


ACTING: dict[str, Callable[[Path], list[Any]]] = {
    "WriteFile": writer,
    "SaveV2": saving,
    "PrintV2": printing,
    "PyFunc": python,
}


def controlled(nodes: Sequence[Any], at: str, by: str = "write_file") -> list[Any]:
    """``by`` as a control input of the node ``at``."""
    next(n for n in nodes if n.name == at).input.append(f"^{by}")
    return list(nodes)


def frozen(folder: Path, nodes: Sequence[Any]) -> Path:
    path = folder / "policy.bytes"
    path.write_bytes(graph_bytes(nodes))
    return path


def function(
    graph: Any,
    name: str,
    takes: Sequence[tuple[str, int]],
    gives: Sequence[tuple[str, int, str]],
    nodes: Sequence[Any],
    effects: Sequence[str] = (),
) -> None:
    """A function in a graph's library: (argument, DataType), (result, DataType, the tensor that it is)."""
    made = graph.library.function.add()
    made.signature.name = name
    for argument, kind in takes:
        made.signature.input_arg.add(name=argument, type=kind)
    for result, kind, tensor in gives:
        made.signature.output_arg.add(name=result, type=kind)
        made.ret[result] = tensor
    made.node_def.extend(nodes)
    for effect in effects:
        made.control_ret[effect] = effect


def call(name: str, called: str, *inputs: str, results: int = 1) -> Any:
    made = node(name, "StatefulPartitionedCall", *inputs, Tin=(np.float32,) * len(inputs), Tout=(np.float32,) * results)
    made.attr["f"].func.name = called
    return made


def saved(folder: Path, graph: Any, output: str, extra: Callable[[Any], None] = lambda meta: None) -> Path:
    """A SavedModel of a graph, with ``serving_default``."""
    message = schema.SavedModel(saved_model_schema_version=1)
    meta = message.meta_graphs.add()
    meta.meta_info_def.tags.append("serve")
    meta.graph_def.CopyFrom(graph)
    entry = meta.signature_def["serving_default"]
    entry.method_name = "tensorflow/serving/predict"
    for side, key, tensor in (
        (entry.inputs, "vector_observation", "vector_observation:0"),
        (entry.outputs, "action", output),
    ):
        side[key].name, side[key].dtype = tensor, 1
        side[key].tensor_shape.dim.add(size=-1)
        side[key].tensor_shape.dim.add(size=3 if side is entry.inputs else 2)
    extra(meta)
    path = folder / "saved"
    path.mkdir()
    (path / "saved_model.pb").write_bytes(schema.serialise(message))
    return path


def calling(body: Sequence[Any], effects: Sequence[str] = ("write_file",), result: str = "y:y:0") -> Any:
    """A graph whose policy is a call of a function with this body beside a dense layer's head."""
    graph = graph_def([placeholder("vector_observation"), call("called", "policy", "vector_observation")])
    head = [
        constant("kernel", np.ones((3, 2), np.float32)),
        node("product", "MatMul", "x", "kernel:output:0", T=np.float32),
        node("y", "Tanh", "product:product:0", T=np.float32),
    ]
    function(graph, "policy", [("x", 1)], [("r", 1, result)], [*head, *body], effects)
    return graph


def inner_writer(marker: Path) -> list[Any]:
    """``writer`` as a function's nodes name one another."""
    nodes = writer(marker)
    nodes[-1].input[:] = [f"{i}:output:0" for i in nodes[-1].input]
    return nodes


def elsewhere(data: bytes, location: str) -> bytes:
    """An ONNX model whose first weights are said to lie in another file."""
    import onnx

    model = onnx.ModelProto.FromString(data)
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.ClearField("float_data")
    tensor.data_location = 1
    for key, value in (("location", location), ("offset", "0"), ("length", "4")):
        entry = tensor.external_data.add()
        entry.key, entry.value = key, value
    result: bytes = model.SerializeToString()
    return result


def onnx_policy(nodes: Sequence[Any] | None = None, weights: Sequence[Any] = (), domains: Sequence[str] = ()) -> bytes:
    from onnx import helper, numpy_helper

    kernel = numpy_helper.from_array(np.ones((3, 2), np.float32), "kernel")
    graph = helper.make_graph(
        list(nodes) if nodes is not None else [helper.make_node("MatMul", ["obs_0", "kernel"], ["continuous_actions"])],
        "policy",
        [helper.make_tensor_value_info("obs_0", 1, ["batch", 3])],
        [helper.make_tensor_value_info("continuous_actions", 1, ["batch", 2])],
        [kernel, *weights],
    )
    imports = [helper.make_opsetid("", 13), *(helper.make_opsetid(d, 1) for d in domains)]
    result: bytes = helper.make_model(graph, opset_imports=imports, ir_version=8).SerializeToString()
    return result
