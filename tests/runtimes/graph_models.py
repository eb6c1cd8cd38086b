"""Graph models written by hand, so that the tests say what tfjs makes of a model.json, whoever writes it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.runtimes.pipe import Array

DTYPES = {"float32": "DT_FLOAT", "int32": "DT_INT32", "int64": "DT_INT64", "bool": "DT_BOOL"}


def shape_proto(shape: Sequence[int | None]) -> dict[str, Any]:
    return {"dim": [{"size": "-1" if size is None else str(size)} for size in shape]}


def placeholder(name: str, dtype: str, shape: Sequence[int | None]) -> dict[str, Any]:
    attr = {"dtype": {"type": DTYPES[dtype]}, "shape": {"shape": shape_proto(shape)}}
    return {"name": name, "op": "Placeholder", "attr": attr}


def node(name: str, op: str, *inputs: str, **attr: Any) -> dict[str, Any]:
    return {"name": name, "op": op, "input": list(inputs), "attr": attr}


def info(tensor: str, dtype: str, shape: Sequence[int | None]) -> dict[str, Any]:
    return {"name": tensor, "dtype": DTYPES[dtype], "tensorShape": shape_proto(shape)}


def write_model(
    folder: Path,
    nodes: Sequence[dict[str, Any]],
    weights: Mapping[str, Array],
    inputs: Mapping[str, dict[str, Any]],
    outputs: Mapping[str, dict[str, Any]],
    shard_bytes: int = 1 << 22,
) -> Path:
    """A model.json as a converter has to write it, and its shards."""
    constants = [
        {"name": name, "op": "Const", "attr": {"dtype": {"type": DTYPES[value.dtype.name]}}}
        for name, value in weights.items()
    ]
    data = b"".join(value.tobytes() for value in weights.values())
    shards = [data[start : start + shard_bytes] for start in range(0, len(data), shard_bytes)]
    names = [f"group1-shard{i + 1}of{len(shards)}.bin" for i in range(len(shards))]
    specs = [{"name": n, "shape": list(v.shape), "dtype": v.dtype.name} for n, v in weights.items()]
    content = {
        "format": "graph-model",
        "modelTopology": {"node": [*constants, *nodes], "versions": {"producer": 134}},
        "weightsManifest": [{"paths": names, "weights": specs}],
        "signature": {"inputs": dict(inputs), "outputs": dict(outputs)},
        "userDefinedMetadata": {"structuredOutputKeys": list(outputs)},
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, shard in zip(names, shards, strict=True):
        (folder / name).write_bytes(shard)
    (folder / "model.json").write_text(json.dumps(content))
    return folder


def edit(folder: Path, *path: str, value: Any) -> None:
    """Sets a field of a model.json; None removes it."""
    content = json.loads((folder / "model.json").read_text())
    target = content
    for step in path[:-1]:
        target = target[step]
    if value is None:
        del target[path[-1]]
    else:
        target[path[-1]] = value
    (folder / "model.json").write_text(json.dumps(content))


RNG = np.random.default_rng(7)
W1, W2 = (RNG.standard_normal((4, 3)).astype(np.float32) for _ in range(2))
B1, B2 = (RNG.standard_normal(3).astype(np.float32) for _ in range(2))


def twins(folder: Path, shard_bytes: int = 1 << 22) -> Path:
    """Two inputs and two outputs that shapes cannot tell apart, under names that are not their nodes'.

    The outputs stand in the signature in another order than in the graph: only the names can put them right.
    """
    floats = {"T": {"type": "DT_FLOAT"}}
    nodes = [
        placeholder("ph_a", "float32", [None, 4]),
        placeholder("ph_b", "float32", [None, 4]),
        node("mm_a", "MatMul", "ph_a", "w1", **floats),
        node("sum_a", "BiasAdd", "mm_a", "b1", **floats),
        node("mm_b", "MatMul", "ph_b", "w2", **floats),
        node("sum_b", "BiasAdd", "mm_b", "b2", **floats),
        node("mix", "Sub", "sum_a", "sum_b", **floats),
        node("out_1", "Identity", "mix", **floats),
        node("out_2", "Identity", "sum_a", **floats),
    ]
    return write_model(
        folder,
        nodes,
        {"w1": W1, "b1": B1, "w2": W2, "b2": B2},
        {"state": info("ph_a:0", "float32", [None, 4]), "goal": info("ph_b:0", "float32", [None, 4])},
        {"value": info("out_2:0", "float32", [None, 3]), "action": info("out_1:0", "float32", [None, 3])},
        shard_bytes,
    )


def twins_by_numpy(state: Array, goal: Array) -> dict[str, Array]:
    value = state @ W1 + B1
    return {"value": value, "action": value - (goal @ W2 + B2)}


def batch(rows: int, seed: int = 0) -> dict[str, Array]:
    rng = np.random.default_rng(seed)
    return {name: rng.standard_normal((rows, 4)).astype(np.float32) for name in ("state", "goal")}


def choice(folder: Path) -> Path:
    """int64 and bool inputs; int64 (declared) and bool outputs."""
    nodes = [
        placeholder("prev", "int64", [None, 2]),
        placeholder("mask", "bool", [None, 2]),
        placeholder("logits", "float32", [None, 2]),
        node("add", "AddV2", "prev", "one", T={"type": "DT_INT64"}),
        node("not", "LogicalNot", "mask"),
        node("low", "SelectV2", "mask", "logits", "floor", T={"type": "DT_FLOAT"}),
        node("best", "ArgMax", "low", "axis", T={"type": "DT_FLOAT"}, output_type={"type": "DT_INT64"}),
        node("out_next", "Identity", "add", T={"type": "DT_INT64"}),
        node("out_not", "Identity", "not", T={"type": "DT_BOOL"}),
        node("out_best", "Identity", "best", T={"type": "DT_INT64"}),
    ]
    weights: dict[str, Array] = {
        "one": np.array(1, np.int32),
        "floor": np.array(-1e9, np.float32),
        "axis": np.array(1, np.int32),
    }
    return write_model(
        folder,
        nodes,
        weights,
        {
            "prev_action": info("prev:0", "int64", [None, 2]),
            "action_masks": info("mask:0", "bool", [None, 2]),
            "state": info("logits:0", "float32", [None, 2]),
        },
        {
            "next": info("out_next:0", "int64", [None, 2]),
            "closed": info("out_not:0", "bool", [None, 2]),
            "deterministic_action": info("out_best:0", "int64", [None]),
        },
    )


CHOICE_FEEDS: dict[str, Array] = {
    "prev_action": np.array([[0, -5], [2**31 - 2, -(2**31)], [7, 8]], np.int64),
    "action_masks": np.array([[True, True], [False, True], [True, False]]),
    "state": np.array([[1, 2], [9, 2], [1, 9]], np.float32),
}
