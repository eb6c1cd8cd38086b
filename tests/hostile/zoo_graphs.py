"""Frozen graphs and run folders of the zoo: what writes, prints or reads a file where the policy is computed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from export_model.converters.files import tensorflow_messages as schema
from tests.checkpoint.writing import bundle as write_checkpoint
from tests.checkpoint.writing import policy as training_policy
from tests.handmade import constant, continuous_policy, graph_def, node, sampled_policy
from tests.hostile.making import (
    ACTING,
    case,
    controlled,
    frozen,
    function,
    writer,
)


def _control_cases() -> None:
    for op, acting in ACTING.items():
        for at in ("action", "mu", "mu/kernel", "vector_observation"):

            def make(folder: Path, marker: Path, acting: Any = acting, at: str = at) -> Path:
                return frozen(folder, controlled([*continuous_policy(), *acting(marker)], at))

            case(f"frozen graph, {op} behind a control input of {at}")(make)
            if at == "action":
                case(f"compare with a frozen graph, {op} behind a control input of {at}", "candidate")(make)


_control_cases()


@case("frozen graph, a writer behind a NoOp")
def _(folder: Path, marker: Path) -> Path:
    barrier = node("barrier", "NoOp", "^write_file")
    return frozen(folder, controlled([*continuous_policy(), *writer(marker), barrier], "action", "barrier"))


@case("frozen graph, a writer behind an assertion's text")
def _(folder: Path, marker: Path) -> Path:
    check = [constant("true", True), node("check", "Assert", "true", "true", "^write_file", T=(np.bool_,), summarize=3)]
    return frozen(folder, controlled([*continuous_policy(), *writer(marker), *check], "action", "check"))


@case("frozen graph, a file read into the observation's scale")
def _(folder: Path, marker: Path) -> Path:
    nodes = continuous_policy()
    read = [
        constant("path", b"/etc/passwd"),
        node("text", "ReadFile", "path"),
        node("raw", "DecodeRaw", "text", out_type=np.uint8, little_endian=True),
        node("numbers", "Cast", "raw", SrcT=np.uint8, DstT=np.float32),
        node("sum", "Sum", "numbers", "zero", T=np.float32, Tidx=np.int32, keep_dims=False),
        constant("zero", 0),
        node("read", "Mul", "mu", "sum", T=np.float32),
    ]
    next(n for n in nodes if n.name == "action").input[0] = "read"
    return frozen(folder, [*nodes, *read])


@case("frozen graph, a writer that nothing hangs on")
def _(folder: Path, marker: Path) -> Path:
    return frozen(folder, [*continuous_policy(), *writer(marker)])


@case("frozen graph, a writer in a loop's body")
def _(folder: Path, marker: Path) -> Path:
    t = {"T": np.float32}
    loop = [
        node("enter", "Enter", "mu", frame_name="loop", is_constant=False, parallel_iterations=1, **t),
        node("count/start", "Enter", "zero", frame_name="loop", is_constant=False, parallel_iterations=1, T=np.int32),
        constant("zero", 0),
        node("merge", "Merge", "enter", "next", N=2, **t),
        node("count", "Merge", "count/start", "count/next", N=2, T=np.int32),
        constant("limit", 2),
        node("less", "Less", "count", "limit", T=np.int32),
        node("going", "LoopCond", "less"),
        node("switch", "Switch", "merge", "going", **t),
        node("count/switch", "Switch", "count", "going", T=np.int32),
        node("count/turn", "Identity", "count/switch:1", T=np.int32),
        constant("one", 1),
        node("count/add", "Add", "count/turn", "one", T=np.int32),
        node("count/next", "NextIteration", "count/add", T=np.int32),
        node("body", "Tanh", "switch:1", "^write_file", **t),
        node("next", "NextIteration", "body", **t),
        node("exit", "Exit", "switch", **t),
    ]
    nodes = continuous_policy()
    next(n for n in nodes if n.name == "action").input[0] = "exit"
    return frozen(folder, [*nodes, *loop, *writer(marker)])


@case("frozen graph, a writer in one of two brains")
def _(folder: Path, marker: Path) -> Path:
    nodes = [*continuous_policy("Goalie/"), *continuous_policy("Striker/"), *writer(marker)]
    return frozen(folder, controlled(nodes, "Striker/action"))


@case("frozen graph, a writer behind the sampler that is fed")
def _(folder: Path, marker: Path) -> Path:
    return frozen(folder, controlled([*sampled_policy(), *writer(marker)], "draw"))


@case("frozen graph, a default that is read from a file")
def _(folder: Path, marker: Path) -> Path:
    nodes = continuous_policy()
    nodes[0] = node("vector_observation", "PlaceholderWithDefault", "text", dtype=np.float32)
    nodes[0].attr["shape"].shape.unknown_rank = True
    return frozen(folder, [*nodes, *writer(marker), constant("path", b"/etc/passwd"), node("text", "ReadFile", "path")])


@case("frozen graph, a function that writes")
def _(folder: Path, marker: Path) -> Path:
    graph = graph_def([*continuous_policy(), node("write_file", "Evil", "mu")])
    graph.node[-2].input.append("^write_file")
    function(graph, "Evil", [("x", 1)], [("y", 1, "x")], [*writer(marker)], ["write_file"])
    path = folder / "policy.bytes"
    path.write_bytes(schema.serialise(graph))
    return path


@case("frozen graph, an op of a library that is not there")
def _(folder: Path, marker: Path) -> Path:
    return frozen(folder, controlled([*continuous_policy(), node("write_file", "LoadLibrary")], "action"))


@case("frozen graph on another device")
def _(folder: Path, marker: Path) -> Path:
    nodes = continuous_policy()
    for n in nodes:
        n.device = "/job:worker/replica:0/task:7/device:GPU:3"
    return frozen(folder, nodes)


def run(folder: Path, change: Callable[[Any], None], *, meta: bool) -> Path:
    """A run's folder whose training graph was changed."""
    graph = training_policy()
    prefix = folder / "model-10.cptk"
    write_checkpoint(prefix, graph.variables)
    place = graph.write(folder / ("model-10.cptk.meta" if meta else "raw_graph_def.pb"), meta=meta)
    kind = schema.MetaGraphDef if meta else schema.GraphDef
    message = kind.FromString(place.read_bytes())
    change(message.graph_def if meta else message)
    place.write_bytes(schema.serialise(message))
    return folder


def _run_cases() -> None:
    for meta in (False, True):
        label = "its .meta" if meta else "its raw graph"

        def restoring(folder: Path, marker: Path, meta: bool = meta) -> Path:
            def change(graph: Any) -> None:
                graph.node.extend([*writer(marker), node("save/restore_all", "NoOp", "^write_file")])
                if not any(n.name == "save/Const" for n in graph.node):
                    graph.node.append(constant("save/Const", b"model"))

            return run(folder, change, meta=meta)

        def controlling(folder: Path, marker: Path, meta: bool = meta) -> Path:
            def change(graph: Any) -> None:
                graph.node.extend(writer(marker))
                next(n for n in graph.node if n.name == "action").input.append("^write_file")

            return run(folder, change, meta=meta)

        def initialising(folder: Path, marker: Path, meta: bool = meta) -> Path:
            def change(graph: Any) -> None:
                graph.node.extend([*writer(marker), node("init", "NoOp", "^write_file")])
                next(n for n in graph.node if n.op == "VariableV2").input.append("^init")

            return run(folder, change, meta=meta)

        case(f"run folder, {label} writes where the saver restores")(restoring)
        case(f"run folder, {label} writes behind a control input of action")(controlling)
        case(f"run folder, {label} writes behind a variable")(initialising)


_run_cases()
