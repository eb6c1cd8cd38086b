"""What the mutants of each reader start from: files that the project itself generates, small first.

A seed is a folder: relative path → content. ``READERS`` says for each reader which seeds it has and how one is changed.
"""

from __future__ import annotations

import io
import json
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.registry import WRITTEN
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.signatures.errors import ExportModelError
from fixtures import FOLDER, path
from tests.checkpoint.writing import bundle as write_checkpoint
from tests.checkpoint.writing import policy as training_policy
from tests.fuzz import changes, hdf5, robots
from tests.fuzz.changes import Files
from tests.handmade import constant, continuous_policy, graph_bytes, graph_def, node, sampled_policy
from tests.hostile import zoo


@dataclass(frozen=True)
class Reader:
    """``main`` is what is given, "" for the folder; ``takes`` are the commands beside inspect and export."""

    seeds: Callable[[], list[Files]]
    change: Callable[[Files, Random], Files]
    main: str = ""
    takes: str = "source"


def files_of(folder: Path) -> Files:
    """What lies in a folder."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def _made(make: Callable[[Path], object]) -> Files:
    with tempfile.TemporaryDirectory() as folder:
        make(Path(folder))
        return files_of(Path(folder))


@cache
def _bundles() -> list[Files]:
    """Bundles of policies of all kinds, in all formats."""
    found = []
    with tempfile.TemporaryDirectory() as top:
        sources = [Path(top, "tiny.bytes"), Path(top, "draws.bytes"), path("recurrent"), path("discrete")]
        sources[0].write_bytes(graph_bytes(continuous_policy()))
        sources[1].write_bytes(graph_bytes(sampled_policy()))
        for source in sources:
            for targets in (tuple(f for f in WRITTEN if f != "nn"), ("nn",)):
                try:
                    (done,) = export([source], ExportOptions(Path(top, targets[0]), targets, verify="none"))
                except ExportModelError:  # a draw has no .nn
                    continue
                found.append(files_of(done.folder))
    return found


def _artefacts(prefix: str, suffix: str) -> list[Files]:
    """The files of one format of every bundle, without what carries our contract along where that is a folder."""
    found = []
    for bundle in _bundles():
        part = {k.removeprefix(prefix): v for k, v in bundle.items() if k.startswith(prefix) and k.endswith(suffix)}
        if part:
            found.append(part)
    return found


def _single(name: str, contents: list[bytes]) -> list[Files]:
    return [{name: data} for data in contents]


# ------------------------------------------------------------------ seeds


def _loop() -> bytes:
    """A policy whose mean goes round a loop of old TensorFlow."""
    made = _made(lambda folder: zoo.CASES["frozen graph, a writer in a loop's body"].make(folder, folder / "marker"))
    graph = schema.GraphDef.FromString(made["policy.bytes"])
    kept = [n for n in graph.node if not n.name.startswith("write_file")]
    for each in kept:
        each.input[:] = [i for i in each.input if not i.startswith("^")]
    return schema.serialise(graph_def(kept))


def _frozen() -> list[Files]:
    nodes = continuous_policy()
    shaped = [
        *nodes[:-1],
        constant("size", [-1, 2, 1]),
        constant("axes", [2]),
        node("r", "Reshape", "mu", "size", T=np.float32, Tshape=np.int32),
        node("m", "Mean", "r", "axes", T=np.float32, Tidx=np.int32, keep_dims=False),
        node("c", "ConcatV2", "m", "mu", "one", N=2, T=np.float32, Tidx=np.int32),
        constant("one", 1),
        node("s", "StridedSlice", "c", "b", "e", "d", begin_mask=1, end_mask=1, T=np.float32, Index=np.int32),
        *(constant(n, v) for n, v in (("b", [0, 1]), ("e", [0, 3]), ("d", [1, 1]))),
        node("action", "Tanh", "s", T=np.float32),
    ]
    small = [graph_bytes(n, p) for n, p in ((nodes, 0), (sampled_policy(), 26), (shaped, 26))]
    large = [path(name).read_bytes() for name in ("recurrent", "discrete", "twobrains")]
    return _single("policy.bytes", [*small, *small, _loop(), *large])


def _onnx() -> list[Files]:
    files = sorted([*(FOLDER / "sb3").glob("*.onnx"), *(FOLDER / "torch_checkpoint").glob("*.onnx")])
    weights = (FOLDER / "sb3" / "torch_actor.onnx.data").read_bytes()
    found = _single("policy.onnx", [zoo.onnx_policy(), *(f.read_bytes() for f in files)])
    for each in found:
        if b"torch_actor.onnx.data" in each["policy.onnx"]:
            each["torch_actor.onnx.data"] = weights
    return [*found, *({"policy.onnx": data} for files_ in _artefacts("", ".onnx") for data in files_.values())]


def _saved_models() -> list[Files]:
    found = [{k.removeprefix("saved_model/"): v for k, v in f.items()} for f in _artefacts("saved_model/", "")]
    f32 = {"T": np.float32}

    def calling(folder: Path) -> None:
        while_ = node("loop", "While", "zero:output:0", "y:y:0", T=(np.int32, np.float32))
        while_.attr["cond"].func.name, while_.attr["body"].func.name = "cond", "turn"
        graph = zoo.calling([constant("zero", 0), while_], (), "loop:output:1")
        takes = [("i", 3), ("x", 1)]
        less = [constant("two", 2), node("less", "Less", "i", "two:output:0", T=np.int32)]
        zoo.function(graph, "cond", takes, [("r", 10, "less:z:0")], less)
        turn = [constant("one", 1), node("n", "Add", "i", "one:output:0", T=np.int32), node("t", "Tanh", "x", **f32)]
        zoo.function(graph, "turn", takes, [("a", 3, "n:z:0"), ("b", 1, "t:y:0")], turn)
        zoo.saved(folder, graph, "called:0")

    def variables(folder: Path) -> None:
        graph = training_policy()
        zoo.saved(folder, graph.message, "action:0", lambda meta: None)
        write_checkpoint(folder / "saved/variables/variables", graph.variables)

    made = [_made(make) for make in (calling, variables)]
    return [*({k.removeprefix("saved/"): v for k, v in f.items()} for f in (*made, *made)), *found]


def _checkpoints() -> list[Files]:
    def run(meta: bool, op: str) -> Callable[[Path], None]:
        def make(folder: Path) -> None:
            graph = training_policy(op=op)
            prefix = folder / "model-10.cptk"
            write_checkpoint(prefix, graph.variables, shards=2 if meta else 1)
            graph.write(folder / ("model-10.cptk.meta" if meta else "raw_graph_def.pb"), meta=meta)
            (folder / "checkpoint").write_text('model_checkpoint_path: "model-10.cptk"\n')

        return make

    ways = ((False, "VariableV2"), (True, "VarHandleOp"), (False, "VarHandleOp"))
    return [*(_made(run(*way)) for way in ways), files_of(FOLDER / "trained" / "3DBall")]


def _torch() -> list[Files]:
    return _single("policy.pt", [f.read_bytes() for f in sorted((FOLDER / "torch_checkpoint").glob("*.pt"))])


def _torchscript() -> list[Files]:
    return _single("policy.pt", [f.read_bytes() for f in sorted((FOLDER / "torchscript").glob("*.pt"))])


#: Name of a weight → its shape.
Shapes = dict[str, tuple[int, ...]]


def _layered() -> list[tuple[str, dict[str, Any], Shapes]]:
    """Models of layers, class, configuration and weights: a chain, one of steps, and one of several inputs."""

    def layer(kind: str, **config: Any) -> dict[str, Any]:
        return {"class_name": kind, "config": {"name": kind.lower(), "trainable": True, "dtype": "float32", **config}}

    dense = layer("Dense", units=2, activation="tanh", use_bias=True)
    chain = [
        layer("Conv2D", filters=2, kernel_size=[2, 2], strides=[1, 1], padding="same", data_format="channels_last",
              activation="relu", use_bias=True, batch_input_shape=[None, 4, 4, 1]),
        layer("MaxPooling2D", pool_size=[2, 2], strides=[2, 2], padding="valid", data_format="channels_last"),
        layer("Flatten"),
        dense,
    ]  # fmt: skip
    steps = [
        layer("LSTM", units=2, activation="tanh", recurrent_activation="sigmoid", use_bias=True, return_sequences=False,
              batch_input_shape=[None, 3, 2]),
        dense,
    ]  # fmt: skip
    given = layer("InputLayer", batch_input_shape=[None, 3], sparse=False)
    add = layer("Add")
    nodes = [(given, []), (dense, [["inputlayer", 0, 0, {}]]), (add, [["dense", 0, 0, {}], ["dense", 0, 0, {}]])]
    layers = [{**x, "name": x["config"]["name"], "inbound_nodes": [i] if i else []} for x, i in nodes]
    ends = {"input_layers": [["inputlayer", 0, 0]], "output_layers": [["add", 0, 0]]}
    bias = {"dense/bias": (2,)}
    images: Shapes = {"conv2d/kernel": (2, 2, 1, 2), "conv2d/bias": (2,), "dense/kernel": (8, 2), **bias}
    cell: Shapes = {"lstm/kernel": (2, 8), "lstm/recurrent_kernel": (2, 8), "lstm/bias": (8,)}
    return [
        ("Sequential", {"name": "s", "layers": chain}, images),
        ("Sequential", {"name": "s", "layers": steps}, {**cell, "dense/kernel": (2, 2), **bias}),
        ("Model", {"name": "m", "layers": layers, **ends}, {"dense/kernel": (3, 2), **bias}),
    ]


def _keras() -> list[Files]:
    """Configurations of both spellings; ``weights.npz`` has what a process would have read of ``model.weights.h5``."""
    models = [*_layered(), ("Functional", keras_3(), {"dense/kernel": (3, 2), "dense/bias": (2,)})]
    return [
        {
            "config.json": json.dumps({"module": "keras", "class_name": kind, "config": config}).encode(),
            "metadata.json": b"{}",
            "model.weights.h5": b"",
            "weights.npz": groups(shapes),
        }
        for kind, config, shapes in models
    ]


def _hdf5_models() -> list[Files]:
    """The same models as Keras 2 writes them: one HDF5 file of configuration, lists of names and arrays."""
    import h5py

    found = []
    for kind, config, shapes in _layered():
        random, made = np.random.default_rng(0), io.BytesIO()
        with h5py.File(made, "w") as file:
            file.attrs["model_config"] = json.dumps({"class_name": kind, "config": config})
            file.attrs["keras_version"] = "2.4.0"
            root = file.create_group("model_weights")
            layers = list(dict.fromkeys(name.partition("/")[0] for name in shapes))
            root.attrs["layer_names"] = [layer.encode() for layer in layers]
            for layer in layers:
                own = [name for name in shapes if name.startswith(f"{layer}/")]
                group = root.create_group(layer)
                group.attrs["weight_names"] = [name.encode() for name in own]
                for name in own:
                    group[name] = random.standard_normal(shapes[name]).astype(np.float32)
        found.append({"policy.h5": made.getvalue()})
    return found


def keras_3() -> dict[str, Any]:
    """A model of one layer as Keras 3 spells it."""

    def layer(kind: str, name: str, calls: list[Any], **config: Any) -> dict[str, Any]:
        own = {"name": name, "dtype": {"module": "keras", "class_name": "DTypePolicy", "config": {"name": "float32"}}}
        known = {"module": "keras.layers", "class_name": kind, "registered_name": None, "name": name}
        return {**known, "config": {**own, **config}, "inbound_nodes": calls}

    seen = {"dtype": "float32", "keras_history": ["seen", 0, 0]}
    tensor = {"class_name": "__keras_tensor__", "config": {"shape": [None, 3], **seen}}
    first = layer("InputLayer", "seen", [], batch_shape=[None, 3], sparse=False)
    dense = layer("Dense", "dense", [{"args": [tensor], "kwargs": {}}], units=2, activation="tanh", use_bias=True)
    ends = {"input_layers": [["seen", 0, 0]], "output_layers": [["dense", 0, 0]]}
    return {"name": "functional", "trainable": True, "layers": [first, dense], **ends}


def groups(shapes: Shapes) -> bytes:
    """The weights by the groups of a ``.keras``: a layer's in their order, an LSTM's in those of its cell."""
    made, counts = io.BytesIO(), Counter[str]()
    arrays: dict[str, np.ndarray] = {}
    for name, shape in shapes.items():
        layer = name.partition("/")[0]
        inside = f"layers/{layer}/cell" if layer == "lstm" else f"layers/{layer}"
        arrays[f"{inside}/vars/{counts[layer]}"] = np.linspace(-1, 1, int(np.prod(shape)), dtype="f4").reshape(shape)
        counts[layer] += 1
    np.savez(made, **arrays)
    return made.getvalue()


def _web_layers() -> list[Files]:
    """TensorFlow.js layers models."""
    found = []
    for kind, config, shapes in _layered():
        weights = [{"name": name, "shape": list(shape), "dtype": "float32"} for name, shape in shapes.items()]
        count = sum(int(np.prod(shape)) for shape in shapes.values())
        topology = {"keras_version": "tfjs-layers 4.22.0", "backend": "tensor_flow.js"}
        whole = {**topology, "model_config": {"class_name": kind, "config": config}}
        manifest = [{"paths": ["weights.bin"], "weights": weights}]
        content = {"format": "layers-model", "modelTopology": whole, "weightsManifest": manifest}
        data = np.linspace(-1, 1, count, dtype=np.float32).tobytes()
        found.append({"model.json": json.dumps(content).encode(), "weights.bin": data})
    return found


def _saved_zips() -> list[Files]:
    return [{"policy.zip": f.read_bytes()} for f in sorted((FOLDER / "sb3_zip").glob("*.zip"))]


def _normalised() -> list[Files]:
    """Saved models with the pickle of VecNormalize beside them."""
    from fixtures.sb3_zip import NORMALISED
    from tests.stable_baselines3.saved_models import saved

    found = []
    for name in ("ppo_box", "a2c_discrete", "ppo_mixed"):
        with tempfile.TemporaryDirectory() as folder:
            model = saved(name, Path(folder)).read_bytes()
        found.append({"policy.zip": model, "vecnormalize.pkl": (NORMALISED / f"{name}.pkl").read_bytes()})
    older = sorted((NORMALISED / "versions").glob("*box*.pkl"))
    return [*found, *({**found[0], "vecnormalize.pkl": f.read_bytes()} for f in older)]


def _single_nn() -> list[Files]:
    return [{"policy.nn": data} for files in _artefacts("", ".nn") for data in files.values()]


def _litert() -> list[Files]:
    return [{"policy.tflite": data} for files in _artefacts("", ".tflite") for data in files.values()]


def _recordings() -> list[Files]:
    """Three rows of each policy, under the names that its contract has."""
    return [
        {"policy.bytes": path(n).read_bytes(), "recorded.npz": _three(n)}
        for n in ("continuous", "recurrent", "discrete")
    ]


def _three(name: str) -> bytes:
    made = io.BytesIO()
    with np.load(path(f"{name}.npz")) as arrays:
        rows = {k.rpartition("/")[2]: a for k, a in arrays.items() if k.startswith("b3/") and a.ndim}
    np.savez(made, **rows)
    return made.getvalue()


# ------------------------------------------------------------------ seeds and what changes them


def _tables() -> Iterator[tuple[str, Reader]]:
    yield "frozen graph", Reader(_frozen, changes.one(changes.message(schema.GraphDef.FromString)), "policy.bytes")
    yield "SavedModel", Reader(_saved_models, changes.saved_model)
    yield "ONNX", Reader(_onnx, changes.one(changes.message(changes.onnx_message)), "policy.onnx")
    yield "Barracuda .nn", Reader(lambda: _single_nn(), changes.nn, "policy.nn")
    yield "LiteRT", Reader(_litert, changes.flatbuffer, "policy.tflite")
    yield "checkpoint", Reader(_checkpoints, changes.checkpoint)
    yield "PyTorch", Reader(_torch, changes.pickled, "policy.pt")
    yield "TorchScript", Reader(_torchscript, changes.script, "policy.pt")
    yield "TensorFlow.js", Reader(lambda: _artefacts("tfjs/", ""), changes.tfjs)
    yield "layers model", Reader(_web_layers, changes.tfjs)
    yield "Stable-Baselines3", Reader(_saved_zips, changes.saved_zip, "policy.zip")
    yield "robots' runs", Reader(robots.runs, robots.change_run, "policy.pt")
    yield "RLlib", Reader(robots.modules, robots.change_module)
    yield "brax", Reader(robots.brax_pickles, robots.change_brax, "params.pkl")
    yield "SBX", Reader(robots.saved_policies, robots.change_saved_policy, "policy.zip")
    yield "VecNormalize", Reader(_normalised, changes.statistics, "policy.zip")
    yield "bundle", Reader(_bundles, changes.bundle, takes="bundle")
    yield "Keras", Reader(_keras, changes.keras_config, "policy.keras", takes="configuration")
    yield "HDF5", Reader(_hdf5_models, hdf5.change_structures, "policy.h5", takes="stored")
    yield "recording", Reader(_recordings, changes.recording, takes="recording")


READERS: dict[str, Reader] = dict(_tables())


def mutant(reader: str, number: int) -> Files:
    """The files of the mutant with this number; the same every time."""
    random = Random(f"{reader} {number}")
    seeds = _seeds(reader)
    (seed,) = random.choices(seeds, [1 / sum(map(len, files.values())) for files in seeds])
    try:
        return READERS[reader].change(seed, random)
    except RecursionError:  # JSON that was nested again and again
        return READERS[reader].change(seed, Random(f"{reader} {number} again"))


@cache
def _seeds(reader: str) -> list[Files]:
    return READERS[reader].seeds()
