"""Files of many nodes, layers and entries: what each reader takes of time and memory.

``python -m tests.hostile.large [COUNT [NAME…]]`` makes each with COUNT (a million) of them, and prints a table.
"""

from __future__ import annotations

import io
import itertools
import json
import os
import pickle
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.barracuda.format import Layer, NnInput, NnModel
from export_model.converters.formats.litert.flatbuffer import encode
from tests.barracuda.nn_files import write_nn
from tests.checkpoint.writing import bundle as write_checkpoint
from tests.checkpoint.writing import policy as training_policy
from tests.handmade import continuous_policy, graph_def, node

Maker = Callable[[Path, int], Path]
MAKERS: dict[str, Maker] = {}


def maker(name: str) -> Callable[[Maker], Maker]:
    """Register a kind of file."""

    def registered(made: Maker) -> Maker:
        MAKERS[name] = made
        return made

    return registered


def _written(path: Path, data: bytes | str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return path


def _chain(count: int, last: str = "mu") -> Any:
    """A policy with so many Identities before its action."""
    definition = graph_def(continuous_policy())
    single = node("x", "Identity", last, T=np.float32)
    for number in range(count):
        single.name, single.input[0] = f"x{number}", last
        definition.node.append(single)
        last = single.name
    next(n for n in definition.node if n.name == "action").input[0] = last
    return definition


def _wide(count: int) -> Any:
    """A policy whose action is the sum of so many copies of one tensor."""
    definition = graph_def(continuous_policy())
    total = definition.node.add(name="total", op="AddN")
    total.CopyFrom(node("total", "AddN", "mu", T=np.float32, N=count))
    total.input.extend(["mu"] * (count - 1))
    next(n for n in definition.node if n.name == "action").input[0] = "total"
    return definition


def _saved(definition: Any, folder: Path) -> Path:
    message = schema.SavedModel(saved_model_schema_version=1)
    meta = message.meta_graphs.add()
    meta.meta_info_def.tags.append("serve")
    meta.graph_def.CopyFrom(definition)
    for side, name in (("inputs", "vector_observation"), ("outputs", "action")):
        entry = getattr(meta.signature_def["serving_default"], side)[name]
        entry.name, entry.dtype = f"{name}:0", 1
    meta.signature_def["serving_default"].method_name = "tensorflow/serving/predict"
    _written(folder / "saved_model.pb", message.SerializeToString())
    return folder


@maker("frozen graph, a chain")
def _(folder: Path, count: int) -> Path:
    return _written(folder / "policy.bytes", _chain(count).SerializeToString())


@maker("frozen graph, a sum of one tensor")
def _(folder: Path, count: int) -> Path:
    return _written(folder / "policy.bytes", _wide(count).SerializeToString())


@maker("SavedModel, a chain")
def _(folder: Path, count: int) -> Path:
    return _saved(_chain(count), folder / "saved")


@maker("SavedModel, a function of a chain")
def _(folder: Path, count: int) -> Path:
    definition = graph_def(continuous_policy())
    function = definition.library.function.add()
    function.signature.name = "f"
    function.signature.input_arg.add(name="x", type=1)
    function.signature.output_arg.add(name="y", type=1)
    last = "x"
    for number in range(count):
        function.node_def.add(name=f"n{number}", op="Identity", input=[last]).attr["T"].type = 1
        last = f"n{number}:output:0"
    function.ret["y"] = last
    definition.node.add(name="call", op="PartitionedCall", input=["mu"]).attr["f"].func.name = "f"
    next(n for n in definition.node if n.name == "action").input[0] = "call"
    return _saved(definition, folder / "saved")


@maker("SavedModel, outputs of a signature")
def _(folder: Path, count: int) -> Path:
    message = schema.SavedModel.FromString(
        (_saved(graph_def(continuous_policy()), folder / "saved") / "saved_model.pb").read_bytes()
    )
    outputs = message.meta_graphs[0].signature_def["serving_default"].outputs
    for number in range(count):
        outputs[f"o{number}"].name, outputs[f"o{number}"].dtype = "action:0", 1
    _written(folder / "saved" / "saved_model.pb", message.SerializeToString())
    return folder / "saved"


@maker("checkpoint, variables")
def _(folder: Path, count: int) -> Path:
    graph = training_policy()
    single = np.zeros(1, np.float32)
    write_checkpoint(folder / "model-10.cptk", {**graph.variables, **{f"v{i}": single for i in range(count)}})
    graph.write(folder / "model-10.cptk.meta", meta=True)
    return _written(folder / "checkpoint", 'model_checkpoint_path: "model-10.cptk"\n').parent


@maker("checkpoint, a chain in its meta graph")
def _(folder: Path, count: int) -> Path:
    graph = training_policy()
    write_checkpoint(folder / "model-10.cptk", graph.variables)
    meta = graph.write(folder / "model-10.cptk.meta", meta=True)
    _written(folder / "checkpoint", 'model_checkpoint_path: "model-10.cptk"\n')
    message = schema.MetaGraphDef.FromString(meta.read_bytes())
    last = "biased"
    for number in range(count):
        message.graph_def.node.add(name=f"x{number}", op="Identity", input=[last]).attr["T"].type = 1
        last = f"x{number}"
    next(n for n in message.graph_def.node if n.name == "action").input[0] = last
    meta.write_bytes(message.SerializeToString())
    return folder


def _web(topology: Any, folder: Path, kind: str, **more: Any) -> Path:
    content = {
        "format": kind,
        "modelTopology": topology,
        "weightsManifest": [{"paths": ["w.bin"], "weights": []}],
        **more,
    }
    _written(folder / "w.bin", b"")
    return _written(folder / "model.json", json.dumps(content)).parent


def _web_node(name: str, op: str, *inputs: str) -> dict[str, Any]:
    return {"name": name, "op": op, "input": list(inputs), "attr": {"T": {"type": "DT_FLOAT"}}}


_WEB_INPUT = {
    "name": "vector_observation",
    "op": "Placeholder",
    "attr": {"dtype": {"type": "DT_FLOAT"}, "shape": {"shape": {"dim": [{"size": "-1"}, {"size": "3"}]}}},
}


@maker("TensorFlow.js graph model, a chain")
def _(folder: Path, count: int) -> Path:
    nodes, last = [_WEB_INPUT], "vector_observation"
    for number in range(count):
        nodes.append(_web_node(f"x{number}", "Identity", last))
        last = f"x{number}"
    return _web({"node": [*nodes, _web_node("action", "Tanh", last)]}, folder / "m", "graph-model")


@maker("TensorFlow.js graph model, a sum of one tensor")
def _(folder: Path, count: int) -> Path:
    total = _web_node("action", "AddN", *["vector_observation"] * count)
    return _web({"node": [_WEB_INPUT, total]}, folder / "m", "graph-model")


@maker("TensorFlow.js graph model, weights")
def _(folder: Path, count: int) -> Path:
    weights = [{"name": f"w{i}", "shape": [0], "dtype": "float32"} for i in range(count)]
    topology = {"node": [_WEB_INPUT, _web_node("action", "Tanh", "vector_observation")]}
    _web(topology, folder / "m", "graph-model")
    content = json.loads((folder / "m" / "model.json").read_bytes())
    content["weightsManifest"] = [{"paths": ["w.bin"], "weights": weights}]
    return _written(folder / "m" / "model.json", json.dumps(content)).parent


def _layer(kind: str, name: str, config: dict[str, Any], inbound: list[Any] | None = None) -> dict[str, Any]:
    return {"class_name": kind, "name": name, "config": {"name": name, **config}, "inbound_nodes": inbound or []}


_START = _layer("InputLayer", "i", {"batch_input_shape": [None, 3], "dtype": "float32"})


def _layers(model: dict[str, Any], folder: Path) -> Path:
    return _web(
        {"keras_version": "2.15.0", "backend": "tensorflow", "model_config": model}, folder / "m", "layers-model"
    )


@maker("layers model, a chain")
def _(folder: Path, count: int) -> Path:
    chain = [_layer("Activation", f"a{i}", {"activation": "relu"}) for i in range(count)]
    return _layers({"class_name": "Sequential", "config": {"name": "m", "layers": [_START, *chain]}}, folder)


@maker("layers model, backwards")
def _(folder: Path, count: int) -> Path:
    last, chain = "i", []
    for number in range(count):
        chain.append(_layer("Activation", f"a{number}", {"activation": "relu"}, [[[last, 0, 0, {}]]]))
        last = f"a{number}"
    config = {
        "name": "m",
        "layers": [*reversed(chain), _START],
        "input_layers": [["i", 0, 0]],
        "output_layers": [[last, 0, 0]],
    }
    return _layers({"class_name": "Functional", "config": config}, folder)


@maker("layers model, a sum of one tensor")
def _(folder: Path, count: int) -> Path:
    total = _layer("Add", "a", {}, [[["i", 0, 0, {}]] * count])
    config = {"name": "m", "layers": [_START, total], "input_layers": [["i", 0, 0]], "output_layers": [["a", 0, 0]]}
    return _layers({"class_name": "Functional", "config": config}, folder)


@maker("layers model, calls of one layer")
def _(folder: Path, count: int) -> Path:
    calls = [[["i" if n == 0 else "a", max(n - 1, 0), 0, {}]] for n in range(count)]
    layer = _layer("Activation", "a", {"activation": "relu"}, calls)
    config = {
        "name": "m",
        "layers": [_START, layer],
        "input_layers": [["i", 0, 0]],
        "output_layers": [["a", count - 1, 0]],
    }
    return _layers({"class_name": "Functional", "config": config}, folder)


@maker("layers model, outputs")
def _(folder: Path, count: int) -> Path:
    layer = _layer("Activation", "a", {"activation": "relu"}, [[["i", 0, 0, {}]]])
    config = {
        "name": "m",
        "layers": [_START, layer],
        "input_layers": [["i", 0, 0]],
        "output_layers": [["a", 0, 0]] * count,
    }
    return _layers({"class_name": "Functional", "config": config}, folder)


def _relu(name: str, source: str) -> Layer:
    return Layer(name, 50, 1, (), (), (), -1, 1.0, 0.0, (source,), ())


@maker(".nn, a chain")
def _(folder: Path, count: int) -> Path:
    layers = [_relu("a0", "vector_observation"), *(_relu(f"a{i}", f"a{i - 1}") for i in range(1, count))]
    model = NnModel(
        17,
        (NnInput("vector_observation", (1, 1, 1, 1, 1, 1, 1, 3)),),
        (f"a{count - 1}",),
        (),
        tuple(layers),
        np.zeros(0, np.float32),
    )
    return _written(folder / "policy.nn", write_nn(model))


@maker(".nn, outputs")
def _(folder: Path, count: int) -> Path:
    layers = (_relu("action", "vector_observation"),)
    model = NnModel(
        17,
        (NnInput("vector_observation", (1, 1, 1, 1, 1, 1, 1, 3)),),
        ("action",) * count,
        (),
        layers,
        np.zeros(0, np.float32),
    )
    return _written(folder / "policy.nn", write_nn(model))


def _lite(folder: Path, tensors: list[Any], operators: list[Any], **more: Any) -> Path:
    tensors = [
        {"name": "obs", "shape": [1, 3], "shape_signature": [-1, 3]},
        {"name": "action", "shape": [1, 3]},
        *tensors,
    ]
    subgraph = {"tensors": tensors, "inputs": [0], "outputs": [1], "operators": operators}
    tanh = {"deprecated_builtin_code": 28, "builtin_code": 28, "version": 1}
    model = {"version": 3, "operator_codes": [tanh], "subgraphs": [subgraph], "buffers": [{}], **more}
    return _written(folder / "policy.tflite", encode(model).to_bytes())


@maker(".tflite, a chain")
def _(folder: Path, count: int) -> Path:
    ends = [0, *range(2, count + 1), 1]
    operators = [{"inputs": [a], "outputs": [b]} for a, b in itertools.pairwise(ends)]
    return _lite(folder, [{"name": f"t{i}", "shape": [1, 3]} for i in range(count - 1)], operators)


@maker(".tflite, one operator again and again")
def _(folder: Path, count: int) -> Path:
    return _lite(folder, [{"name": "t"}], [{"inputs": [0], "outputs": [1]}] * count)


@maker(".tflite, tensors of one long name")
def _(folder: Path, count: int) -> Path:
    return _lite(
        folder, [{"name": "t" * 10_000, "buffer": i % 3} for i in range(count)], [{"inputs": [0], "outputs": [1]}]
    )


@maker(".tflite, outputs")
def _(folder: Path, count: int) -> Path:
    ports = [{"name": f"y{i}", "tensor_index": 1} for i in range(count)]
    called = {"inputs": [{"name": "obs"}], "outputs": ports, "signature_key": "serving_default"}
    return _lite(folder, [], [{"inputs": [0], "outputs": [1]}], signature_defs=[called])


def _onnx(folder: Path, nodes: list[Any], **more: Any) -> Path:
    from onnx import TensorProto, helper

    ends = [helper.make_tensor_value_info(n, TensorProto.FLOAT, ["batch", 3]) for n in ("obs_0", "action")]
    functions = more.pop("functions", [])
    graph = helper.make_graph(nodes, "g", ends[:1], ends[1:], **more)
    opsets = [helper.make_opsetid("", 18), helper.make_opsetid("own", 1)]
    model = helper.make_model(graph, opset_imports=opsets, functions=functions)
    return _written(folder / "policy.onnx", model.SerializeToString())


@maker("ONNX, a chain")
def _(folder: Path, count: int) -> Path:
    from onnx import helper

    names = ["obs_0", *(f"x{i}" for i in range(count)), "action"]
    return _onnx(folder, [helper.make_node("Relu", [a], [b]) for a, b in itertools.pairwise(names)])


@maker("ONNX, a sum of one tensor")
def _(folder: Path, count: int) -> Path:
    from onnx import helper

    return _onnx(folder, [helper.make_node("Sum", ["obs_0"] * count, ["action"])])


@maker("ONNX, a chain of ops that ONNX defines by others")
def _(folder: Path, count: int) -> Path:
    from onnx import helper

    names = ["obs_0", *(f"x{i}" for i in range(count)), "action"]
    made = [helper.make_node("CenterCropPad", [a, "s"], [b], axes=[1]) for a, b in itertools.pairwise(names)]
    shape = helper.make_tensor("s", 7, [1], [3])
    return _onnx(folder, made, initializer=[shape])


def _pickled(value: Any, folder: Path, name: str = "policy.pt") -> Path:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        archive.writestr("a/data.pkl", pickle.dumps(value, 2))
        archive.writestr("a/version", "3\n")
    return _written(folder / name, made.getvalue())


@maker("PyTorch, a dictionary")
def _(folder: Path, count: int) -> Path:
    return _pickled({f"network.{i}.weight": i for i in range(count)}, folder)


@maker("PyTorch, nested lists")
def _(folder: Path, count: int) -> Path:
    data = b"\x80\x02" + b"]" * count + b"a" * (count - 1) + b"."
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        archive.writestr("a/data.pkl", data)
    return _written(folder / "policy.pt", made.getvalue())


@maker("a ZIP archive, entries")
def _(folder: Path, count: int) -> Path:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        archive.writestr("a/data.pkl", pickle.dumps({}, 2))
        for number in range(count):
            archive.writestr(zipfile.ZipInfo(f"a/data/{number}"), b"")
    return _written(folder / "policy.pt", made.getvalue())


@maker("Stable-Baselines3, keys of its data")
def _(folder: Path, count: int) -> Path:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        archive.writestr("data", json.dumps({f"k{i}": i for i in range(count)}))
        archive.writestr("policy.pth", b"x")
    return _written(folder / "policy.zip", made.getvalue())


def measured(path: Path) -> tuple[float, int, str]:
    """(seconds of computing, MiB at its peak, what was said first) of ``inspect``, in a process of its own."""
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(
            [sys.executable, "-m", "export_model", "inspect", str(path)], stdout=said, stderr=said
        )
        _, _, used = os.wait4(process.pid, 0)
        said.seek(0)
        first = said.readline().decode()
    return used.ru_utime + used.ru_stime, used.ru_maxrss >> 10, first.split(": ", 2)[-1].strip()


def main(count: int = 1_000_000, *begin: str) -> None:
    """Make and measure."""
    print("| file | bytes | seconds | MiB | said |\n|---|---|---|---|---|")
    for name in (n for n in MAKERS if n.startswith(begin or ("",))):
        with tempfile.TemporaryDirectory() as folder:
            path = MAKERS[name](Path(folder), count)
            size = sum(p.stat().st_size for p in Path(folder).rglob("*") if p.is_file())
            seconds, peak, said = measured(path)
        print(f"| {name} | {size:,} | {seconds:.1f} | {peak} | {said[:90]} |", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]), *sys.argv[2:])
