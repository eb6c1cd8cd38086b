"""Planted faults of behaviour: what goes wrong in exported files and in programs that run them.

``IN_FILES`` edit the exported ONNX; ``IN_PROGRAMS`` change what a runtime is fed or what is taken from it, as an agent
does whose code keeps the memory.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

Array = np.ndarray
Edit = Callable[[onnx.ModelProto], None]
Answer = Callable[[Mapping[str, Array]], dict[str, Array]]
#: what a program does with the runtime's answer
Wrap = Callable[[Answer], Answer]


@dataclass(frozen=True)
class Fault:
    """``policy`` of fixtures/trained; ``first`` are tensors of which one must be named as the first that differs."""

    name: str
    policy: str
    edit: Edit
    first: tuple[str, ...]


@dataclass(frozen=True)
class ProgramFault:
    """``outputs``: one of them must be named."""

    name: str
    policy: str
    wrap: Wrap
    outputs: tuple[str, ...]


# ------------------------------------------------------------------ edits


def scaled(initializer: str, factor: float) -> Edit:
    return changed(initializer, lambda a: a * np.float32(factor))


def changed(initializer: str, change: Callable[[Array], Array]) -> Edit:
    def edit(model: onnx.ModelProto) -> None:
        (found,) = (i for i in model.graph.initializer if i.name == initializer)
        array = change(numpy_helper.to_array(found).copy())
        found.CopyFrom(numpy_helper.from_array(np.ascontiguousarray(array, np.float32), initializer))

    return edit


def through(tensor: str, op: str, *constants: Array, **attributes: object) -> Edit:
    """What reads ``tensor`` reads ``op(tensor, constants)``; of an output, the output itself is that."""

    def edit(model: onnx.ModelProto) -> None:
        graph = model.graph
        names = [f"fault/{i}" for i in range(len(constants))]
        graph.initializer.extend(numpy_helper.from_array(c, n) for c, n in zip(constants, names, strict=True))
        at = next((i for i, n in enumerate(graph.node) if tensor in n.output), None)
        if at is None:  # an input
            for node in graph.node:
                node.input[:] = ["fault/out" if n == tensor else n for n in node.input]
            graph.node.insert(0, helper.make_node(op, [tensor, *names], ["fault/out"], **attributes))
            return
        graph.node[at].output[:] = ["fault/before" if n == tensor else n for n in graph.node[at].output]
        graph.node.insert(at + 1, helper.make_node(op, ["fault/before", *names], [tensor], **attributes))

    return edit


def order(*columns: int) -> Array:
    return np.array(columns, np.int64)


def f32(*values: float) -> Array:
    return np.array(values, np.float32)


def int8(weights: Array) -> Array:
    """As a quantiser does it: a scale for the whole tensor."""
    scale = np.abs(weights).max() / 127
    return np.round(weights / scale) * scale


def sparse(weights: Array) -> Array:
    """As pruning does it: the smaller half of the weights is gone."""
    return np.where(np.abs(weights) < np.median(np.abs(weights)), 0, weights)


def relu_for_swish(model: onnx.ModelProto) -> None:
    for node in model.graph.node:
        if node.output[0] == "main_graph_0/hidden_0/Mul":
            node.op_type = "Relu"
            del node.input[1:]


def half_precision(model: onnx.ModelProto) -> None:
    """The last layer in float16."""
    graph = model.graph
    at = next(i for i, n in enumerate(graph.node) if "dense/BiasAdd" in n.output)
    graph.node[at].output[:] = ["fault/before"]
    graph.node.insert(at + 1, helper.make_node("Cast", ["fault/before"], ["fault/half"], to=TensorProto.FLOAT16))
    graph.node.insert(at + 2, helper.make_node("Cast", ["fault/half"], ["dense/BiasAdd"], to=TensorProto.FLOAT))


def inverted(model: onnx.ModelProto) -> None:
    """Masks with 1 for what is forbidden."""
    through("action_masks", "Sub", f32(1))(model)
    node = model.graph.node[0]
    node.input[:] = list(reversed(node.input))


HIDDEN, LAST = "main_graph_0/hidden_0/kernel/read", "dense/kernel/read"
LAYER = ("main_graph_0/hidden_0/BiasAdd", "main_graph_0/hidden_0/MatMul", HIDDEN)
NORMALISER = ("sub", "truediv_1", "normalized_state", "Sqrt", "running_mean/read")
LOGITS = ("action_probs", LAST)
CELL = ("lstm/strided_slice", "lstm/strided_slice_1", "lstm/rnn/while/basic_lstm_cell/concat")
MOVES = ("mul", "action")

IN_FILES = (
    Fault("memory dropped", "Hallway", through("recurrent_in", "Mul", f32(0)), CELL),
    Fault("memory not written", "Hallway", through("recurrent_out", "Mul", f32(0)), ("recurrent_out",)),
    Fault("halves of the memory swapped", "Hallway",
          through("recurrent_in", "Gather", order(*range(16, 32), *range(16)), axis=1), CELL),
    Fault("action before ignored", "Hallway", through("prev_action", "Mul", np.array(0, np.int32)),
          ("strided_slice/view/view", "strided_slice/view", "one_hot")),
    Fault("two actions swapped", "GridWorld", through("action", "Gather", order(1, 0, 2, 3), axis=1), ("action",)),
    Fault("two continuous actions swapped", "3DBall", changed(LAST, lambda w: w[:, ::-1]), ("dense/BiasAdd", LAST)),
    Fault("sign of an action", "3DBall", through("action", "Mul", f32(-1, 1)), ("action",)),
    Fault("temperature of 2", "GridWorld", scaled(LAST, 0.5), LOGITS),
    Fault("masks ignored", "GridWorld", through("action_masks", "Max", f32(1)), MOVES),
    Fault("masks inverted", "GridWorld", inverted, MOVES),
    Fault("one layer in int8", "Crawler2D", changed(HIDDEN, int8), LAYER),
    Fault("one layer pruned", "Crawler2D", changed(HIDDEN, sparse), LAYER),
    Fault("normaliser off by 5 %", "3DBall", scaled("Sqrt", 1.05), NORMALISER),
    Fault("normaliser's mean forgotten", "Crawler2D", scaled("running_mean/read", 0), NORMALISER),
    Fault("epsilon halved", "3DBall", through("epsilon", "Mul", f32(0.5)), ("mul", "Sqrt_1")),
    Fault("epsilon ignored", "Crawler2D", through("epsilon", "Mul", f32(0)), ("mul", "Sqrt_1")),
    Fault("order of observations", "3DBall", through("state", "Gather", order(1, 0, *range(2, 8)), axis=1), NORMALISER),
    Fault("frames one column late", "Crawler2D", through("state", "Gather", order(25, *range(25)), axis=1), NORMALISER),
    Fault("another activation", "GridWorld", relu_for_swish, ("main_graph_0/hidden_0/Mul",)),
    Fault("a layer in float16", "3DBall", half_precision, ("dense/BiasAdd",)),
    Fault("degrees for radians", "3DBall",
          through("state", "Mul", f32(57.29578, 57.29578, 1, 1, 1, 1, 1, 1)), NORMALISER),
)  # fmt: skip


# ------------------------------------------------------------------ programs


def late(name: str) -> Wrap:
    """What is fed as ``name`` is what should have been fed the call before."""

    def wrap(answer: Answer) -> Answer:
        before: dict[str, Array] = {}

        def run(feeds: Mapping[str, Array]) -> dict[str, Array]:
            given = feeds[name]
            held = before.get(name, np.zeros_like(given))
            before[name] = given
            return answer({**feeds, name: held if held.shape == given.shape else np.zeros_like(given)})

        return run

    return wrap


def repeated(wanted: Sequence[str]) -> Wrap:
    """Every second decision is the one before."""

    def wrap(answer: Answer) -> Answer:
        before: list[dict[str, Array]] = []

        def run(feeds: Mapping[str, Array]) -> dict[str, Array]:
            own = answer(feeds)
            if len(before) == 1 and all(before[0][n].shape == own[n].shape for n in own):
                own = {n: before[0][n] if n in wanted else a for n, a in own.items()}
                before.clear()
            else:
                before[:] = [own]
            return own

        return run

    return wrap


def first_row(answer: Answer) -> Answer:
    """All agents do what the first one does."""
    return lambda feeds: {n: np.repeat(a[:1], len(a), axis=0) for n, a in answer(feeds).items()}


def clipped(answer: Answer) -> Answer:
    """Actions are clipped to half of their range."""
    return lambda feeds: {n: np.clip(a, -0.5, 0.5) if n == "action" else a for n, a in answer(feeds).items()}


IN_PROGRAMS = (
    ProgramFault("memory one step late", "Hallway", late("recurrent_in"), ("recurrent_out", "action")),
    ProgramFault("observation one step late", "3DBall", late("state"), ("action",)),
    ProgramFault("masks one step late", "GridWorld", late("action_masks"), ("action",)),
    ProgramFault("every second decision is the one before", "Crawler2D", repeated(("action",)), ("action",)),
    ProgramFault("all agents do what the first does", "GridWorld", first_row, ("action",)),
    ProgramFault("actions clipped twice", "Crawler2D", clipped, ("action",)),
)
