"""SavedModels of the zoo: functions, signatures and assets that would act where the model is loaded."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.checkpoint.writing import bundle as write_checkpoint
from tests.handmade import constant, continuous_policy, graph_def, node
from tests.hostile.making import (
    call,
    calling,
    case,
    controlled,
    function,
    inner_writer,
    saved,
    writer,
)


def _saved_cases() -> None:
    def flat(folder: Path, marker: Path) -> Path:
        return saved(folder, graph_def(controlled([*continuous_policy(), *writer(marker)], "action")), "action:0")

    def effect(folder: Path, marker: Path) -> Path:
        return saved(folder, calling(inner_writer(marker)), "called:0")

    def control(folder: Path, marker: Path) -> Path:
        graph = calling(inner_writer(marker), ())
        next(n for n in graph.library.function[0].node_def if n.name == "y").input.append("^write_file")
        return saved(folder, graph, "called:0")

    def nested(folder: Path, marker: Path) -> Path:
        graph = calling([call("inner", "evil", "x")], ("inner",))
        function(graph, "evil", [("x", 1)], [("r", 1, "x")], inner_writer(marker), ("write_file",))
        return saved(folder, graph, "called:0")

    def beside(folder: Path, marker: Path) -> Path:
        graph = calling([], ())
        graph.node.add().CopyFrom(call("write_file", "evil", "vector_observation"))
        graph.node[1].input.append("^write_file")
        function(graph, "evil", [("x", 1)], [("r", 1, "x")], inner_writer(marker), ("write_file",))
        return saved(folder, graph, "called:0")

    def loop(folder: Path, marker: Path) -> Path:
        while_ = node("loop", "While", "y:y:0", T=(np.float32,))
        while_.attr["cond"].func.name, while_.attr["body"].func.name = "cond", "evil"
        graph = calling([while_], (), "loop:output:0")
        function(graph, "cond", [("x", 1)], [("r", 10, "no:output:0")], [constant("no", False)])
        function(graph, "evil", [("x", 1)], [("r", 1, "x")], inner_writer(marker), ("write_file",))
        return saved(folder, graph, "called:0")

    def branch(folder: Path, marker: Path) -> Path:
        if_ = node("either", "If", "yes:output:0", "y:y:0", Tin=(np.float32,), Tout=(np.float32,), Tcond=np.bool_)
        if_.attr["then_branch"].func.name, if_.attr["else_branch"].func.name = "evil", "good"
        graph = calling([constant("yes", True), if_], (), "either:output:0")
        function(graph, "good", [("x", 1)], [("r", 1, "x")], [])
        function(graph, "evil", [("x", 1)], [("r", 1, "x")], inner_writer(marker), ("write_file",))
        return saved(folder, graph, "called:0")

    def endless(folder: Path, marker: Path) -> Path:
        graph = calling([call("again", "policy", "x")], ("again",))
        return saved(folder, graph, "called:0")

    def unfolding(folder: Path, marker: Path) -> Path:
        graph = calling([call("a", "f0", "y:y:0")], (), "a:output:0")
        for i in range(40):
            two = [call("a", f"f{i + 1}", "x"), call("b", f"f{i + 1}", "a:output:0")]
            function(graph, f"f{i}", [("x", 1)], [("r", 1, "b:output:0")], two)
        function(graph, "f40", [("x", 1)], [("r", 1, "x")], [])
        return saved(folder, graph, "called:0")

    def swelling(folder: Path, marker: Path) -> Path:
        graph = calling([call("a", "f0", "y:y:0")], (), "a:output:0")
        big = constant("big", np.ones((1 << 18,), np.float32))
        for i in range(14):
            two = [call("a", f"f{i + 1}", "x"), call("b", f"f{i + 1}", "a:output:0")]
            function(graph, f"f{i}", [("x", 1)], [("r", 1, "b:output:0")], two)
        body = [big, node("z", "Sum", "big:output:0", "axis:output:0", keep_dims=False), constant("axis", 0)]
        added = node("w", "Add", "x", "z:output:0")
        function(graph, "f14", [("x", 1)], [("r", 1, "w:z:0")], [*body, added])
        return saved(folder, graph, "called:0")

    def tree(depth: int, results: Sequence[str], body: Sequence[Any] = (), name: str = "a") -> Any:
        """A function that is called 2^depth times."""
        graph = calling([call(name, "f0", "y:y:0")], (), f"{name}:output:0")
        for i in range(depth):
            two = [call(name, f"f{i + 1}", "x"), call("b", f"f{i + 1}", f"{name}:output:0")]
            function(graph, f"f{i}", [("x", 1)], [("r", 1, "b:output:0")], two)
        function(graph, f"f{depth}", [("x", 1)], [(r, 1, "x") for r in results], body)
        return graph

    def passing(folder: Path, marker: Path) -> Path:
        return saved(folder, tree(13, [f"{i:x}" for i in range(3500)]), "called:0")

    def unread(folder: Path, marker: Path) -> Path:
        body = [node(f"{i:x}", "Abs", "x", T=np.float32) for i in range(3000)]
        return saved(folder, tree(14, ["r"], body), "called:0")

    def naming(folder: Path, marker: Path) -> Path:
        return saved(folder, tree(13, ["r"], name="a" * 100_000), "called:0")

    def missing(folder: Path, marker: Path) -> Path:
        graph = calling([call("inner", "nowhere", "x")], ("inner",))
        return saved(folder, graph, "called:0")

    def misfit(folder: Path, marker: Path) -> Path:
        graph = calling([call("inner", "policy", "x", "x")], ("inner",))
        return saved(folder, graph, "called:0")

    def main_op(folder: Path, marker: Path) -> Path:
        def extra(meta: Any) -> None:
            meta.signature_def["__saved_model_init_op"].outputs["__saved_model_init_op"].name = "write_file"

        return saved(folder, graph_def([*continuous_policy(), *writer(marker)]), "action:0", extra)

    def restoring(folder: Path, marker: Path) -> Path:
        def extra(meta: Any) -> None:
            meta.saver_def.restore_op_name = "write_file"

        path = saved(folder, graph_def([*continuous_policy(), *writer(marker)]), "action:0", extra)
        write_checkpoint(path / "variables" / "variables", {"w": np.ones(3, np.float32)})
        return path

    makers = {
        "a writer behind a control input": flat,
        "a function's effect": effect,
        "a function's control input": control,
        "an effect of a function that a function calls": nested,
        "a call that only a control input asks for": beside,
        "a loop's body": loop,
        "a branch that is not taken": branch,
        "a function that calls itself": endless,
        "functions that unfold to 2^40 calls": unfolding,
        "functions that unfold to 16 GiB": swelling,
        "3,500 results of 2^13 calls": passing,
        "3,000 nodes that none of 2^14 calls reads": unread,
        "calls whose names are 100 kB": naming,
        "a function that is not there": missing,
        "a call with too many tensors": misfit,
        "an init op": main_op,
        "a restore op": restoring,
    }
    for label, make in makers.items():
        case(f"SavedModel, {label}")(make)
        case(f"compare with a SavedModel, {label}", "candidate")(make)


_saved_cases()
