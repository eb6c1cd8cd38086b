"""Small files that ask for much work: each is refused by a count, before the work is done."""

from __future__ import annotations

import itertools
import json
import os
from pathlib import Path
from typing import Any

import pytest

from export_model.converters.files.children.memory_limits import ChildMemory
from export_model.converters.formats.keras.model import tensors_in
from export_model.converters.formats.onnx.functions import inline_functions
from export_model.converters.trainers.stable_baselines3.spaces import space_of
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import DamagedFileError, ExportModelError, NotAPolicyError, UnsupportedOpError

Config = dict[str, Any]


def tensor(layer: str, call: int = 0) -> Config:
    config = {"shape": [None, 2], "dtype": "float32", "keras_history": [layer, call, 0]}
    return {"class_name": "__keras_tensor__", "config": config}


def called_with(*given: Config) -> Config:
    return {"args": list(given), "kwargs": {}}


def layer(kind: str, name: str, config: Config, *calls: Config) -> Config:
    config = {"name": name, "trainable": True, "dtype": "float32", **config}
    return {"module": "keras.layers", "class_name": kind, "config": config, "name": name, "inbound_nodes": list(calls)}


def functional(name: str, layers: list[Config], output: list[Any]) -> Config:
    config = {"name": name, "layers": layers, "input_layers": ["i", 0, 0], "output_layers": output}
    return {"module": "keras", "class_name": "Functional", "config": config, "name": name, "inbound_nodes": []}


def written(model: Config, folder: Path) -> Path:
    topology = {"keras_version": "3.0", "backend": "tensorflow", "model_config": model}
    manifest = [{"paths": ["w.bin"], "weights": []}]
    content = {"format": "layers-model", "modelTopology": topology, "weightsManifest": manifest}
    folder.mkdir(parents=True)
    (folder / "model.json").write_text(json.dumps(content))
    (folder / "w.bin").touch()
    return folder


def doubling(levels: int) -> Config:
    """A model that calls a model twice, which calls a model twice …"""
    start = layer("InputLayer", "i", {"batch_shape": [None, 2]})
    model = functional("m0", [start], ["i", 0, 0])
    for level in range(1, levels + 1):
        inner = {**model, "inbound_nodes": [called_with(tensor("i")), called_with(tensor(f"m{level - 1}"))]}
        model = functional(f"m{level}", [start, inner], [f"m{level - 1}", 1, 0])
    return model


def test_models_that_call_one_another_twice(tmp_path: Path) -> None:
    assert read_source(written(doubling(3), tmp_path / "few")).policies()
    with pytest.raises(DamagedFileError, match="call one another too often"):
        read_source(written(doubling(25), tmp_path / "many")).policies()


def activations(order: list[int], names: list[str], outputs: list[Any]) -> Config:
    """A chain of activations, listed in another order."""
    chain = [
        layer("Activation", n, {"activation": "relu"}, called_with(tensor(b)))
        for b, n in zip(["i", *names], names, strict=False)
    ]
    start = layer("InputLayer", "i", {"batch_shape": [None, 2]})
    model = functional("m", [*(chain[n] for n in order), start], outputs)
    model["config"]["output_layers"] = outputs
    return model


def test_layers_in_any_order_are_gone_through_once(tmp_path: Path) -> None:
    """Backwards, 2,000 of them took 7 s: the list was looked through for each."""
    names = [f"a{n}" for n in range(300)]
    counted = 0

    def count(value: Any) -> Any:
        nonlocal counted
        counted += 1
        return tensors_in(value)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("export_model.converters.formats.keras.network.tensors_in", count)
        model = activations([*reversed(range(300))], names, [["a299", 0, 0]])
        (policy,) = read_source(written(model, tmp_path / "m")).policies()
    assert sum(n.op == "Relu" for n in policy.graph.nodes) == 300
    assert counted < 10 * 300


def test_outputs_of_one_name_have_an_end(tmp_path: Path) -> None:
    """The third was called a_2 again and again, which was taken."""
    model = activations([0, 1], ["a", "a_2"], [["a", 0, 0], ["a_2", 0, 0], ["a", 0, 0]])
    with pytest.raises(ExportModelError, match="action"):
        read_source(written(model, tmp_path / "m")).policies()


def test_more_calls_of_layers_than_any_policy_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("export_model.converters.formats.keras.network.MAX_POLICY_NODES", 2)
    model = activations([0, 1, 2], ["a", "b", "c"], [["c", 0, 0]])
    with pytest.raises(NotAPolicyError, match="called 3 times"):
        read_source(written(model, tmp_path / "m")).policies()


def test_more_layers_than_any_policy_has_are_not_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A million of them took a minute before their calls were counted."""
    monkeypatch.setattr("export_model.converters.formats.keras.model.MAX_POLICY_NODES", 2)
    with pytest.raises(NotAPolicyError, match="3 layers"):
        read_source(written(activations([0, 1], ["a", "b"], [["b", 0, 0]]), tmp_path / "m")).policies()


def test_constants_that_are_not_in_the_file_are_counted_together(tmp_path: Path) -> None:
    """An identity matrix of 8,192 rows was 512 MB on its way, for each node that asks for one."""
    from onnx import TensorProto, helper

    ends = [helper.make_tensor_value_info(n, TensorProto.FLOAT, ["batch", 3]) for n in ("obs_0", "action")]
    shape = helper.make_tensor("shape", TensorProto.INT64, [2], [8192, 8192])
    nodes = [
        helper.make_node("ConstantOfShape", ["shape"], ["zeros"]),
        helper.make_node("EyeLike", ["zeros"], ["eye"]),
        helper.make_node("ReduceSum", ["eye"], ["sum"], keepdims=0),
        helper.make_node("Add", ["obs_0", "sum"], ["action"]),
    ]
    graph = helper.make_graph(nodes, "g", ends[:1], ends[1:], [shape])
    (tmp_path / "policy.onnx").write_bytes(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)]).SerializeToString()
    )
    with pytest.raises(UnsupportedOpError, match="makes a constant of 67108864 elements"):
        read_source(tmp_path / "policy.onnx")


def test_ops_that_onnx_defines_by_others_are_counted_before_they_are_written_out() -> None:
    """2,000 of them in 60 kB took 20 s."""
    from onnx import TensorProto, helper

    def model(count: int) -> Any:
        names = ["obs_0", *(f"x{i}" for i in range(count))]
        nodes = [helper.make_node("Bernoulli", [a], [b]) for a, b in itertools.pairwise(names)]
        ends = [helper.make_tensor_value_info(n, TensorProto.FLOAT, ["batch", 3]) for n in (names[0], names[-1])]
        graph = helper.make_graph(nodes, "g", ends[:1], ends[1:])
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)])

    assert len(inline_functions(model(9)).graph.node) > 9
    with pytest.raises(UnsupportedOpError, match="600 nodes that ONNX defines by others"):
        inline_functions(model(600))


def test_a_child_is_allowed_for_the_models_that_it_has() -> None:
    memory = ChildMemory(os.getpid())
    memory._base, limits = 0, list[int]()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "export_model.converters.files.children.memory_limits._limit", lambda pid, bound: limits.append(bound)
        )
        for _ in range(3):
            memory.allow(1 << 20)
            memory.allow_for_request(0)
            memory.release(1 << 20)
    assert len(limits) == 1


def test_a_cropping_that_leaves_nothing(tmp_path: Path) -> None:
    start = layer("InputLayer", "i", {"batch_shape": [None, 4, 3]})
    crop = layer("Cropping1D", "c", {"cropping": [10**9, 10**9]}, called_with(tensor("i")))
    with pytest.raises(DamagedFileError, match="leaves nothing"):
        read_source(written(functional("m", [start, crop], ["c", 0, 0]), tmp_path / "m")).policies()


@pytest.mark.parametrize("text", ["\\'" * 1_000_000, "'a':Box(" * 300_000, "\\'" * 100_000, "'a':Box(" * 30_000])
def test_the_text_of_a_space(text: str) -> None:
    with pytest.raises(DamagedFileError):
        space_of({"o": {":type:": "<class 'gymnasium.spaces.dict.Dict'>", "spaces": text}}, "o")
