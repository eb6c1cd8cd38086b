"""What a runtime is given of a graph: what the fetched tensors are computed from, and no op that does more."""

from __future__ import annotations

from typing import Any

import pytest

from export_model.converters.formats.subgraph import subgraph
from export_model.converters.graph.ops.table import FORBIDDEN
from export_model.signatures.errors import ExportModelError, UnsupportedOpError
from tests.handmade import constant, continuous_policy, graph_def, node


def policy(*extra: Any, control: str | None = None, at: str = "action") -> Any:
    nodes = [*continuous_policy(), *extra]
    if control is not None:
        next(n for n in nodes if n.name == at).input.append(f"^{control}")
    return graph_def(nodes)


def writer(op: str = "WriteFile") -> list[Any]:
    return [constant("path", b"/tmp/x"), constant("text", b"y"), node("write_file", op, "path", "text")]


def names(graph: Any) -> set[str]:
    return {n.name for n in graph.node}


def test_what_nothing_asks_for_is_left_out() -> None:
    part = subgraph(policy(*writer()), ["action"])
    assert "action" in names(part)
    assert not {"path", "text", "write_file"} & names(part)


@pytest.mark.parametrize(
    "op", ["WriteFile", "ReadFile", "PrintV2", "PyFunc", "Save", "Madeup", "VarHandleOp", "Assign"]
)
def test_what_hangs_on_a_control_input_is_refused_by_name(op: str) -> None:
    with pytest.raises(UnsupportedOpError, match=f"{op} .*'write_file'"):
        subgraph(policy(*writer(op), control="write_file"), ["action:0"])


def test_what_hangs_behind_an_op_that_only_orders_is_refused_too() -> None:
    for op in ("NoOp", "Assert"):
        barrier = node("barrier", op, "^write_file")
        with pytest.raises(UnsupportedOpError, match="WriteFile"):
            subgraph(policy(*writer(), barrier, control="barrier"), ["action"])


def test_it_is_found_wherever_upstream_it_hangs() -> None:
    nodes = continuous_policy()
    for name in [n.name for n in nodes]:
        with pytest.raises(UnsupportedOpError, match="WriteFile"):
            subgraph(policy(*writer(), control="write_file", at=name), ["action"])


def test_an_op_that_only_orders_is_left_out() -> None:
    part = subgraph(policy(node("barrier", "NoOp"), control="barrier"), ["action"])
    assert "barrier" not in names(part)
    assert not [i for n in part.node for i in n.input if i.startswith("^")]


def test_what_takes_references_to_variables_takes_values() -> None:
    entered = node("entered", "RefEnter", "action")
    part = subgraph(graph_def([*continuous_policy(), entered]), ["entered"])
    assert {n.op for n in part.node if n.name == "entered"} == {"Enter"}


def test_places_and_hints_are_left_out() -> None:
    graph = policy()
    for n in graph.node:
        n.device = "/job:worker/task:1"
        n.attr["_class"].s = b"loc:@x"
    part = subgraph(graph, ["action"])
    assert {n.device for n in part.node} == {""}
    assert not [key for n in part.node for key in n.attr if key.startswith("_")]


def test_a_tensor_that_is_not_there_is_an_error() -> None:
    with pytest.raises(ExportModelError, match="'nothing' is not in the graph"):
        subgraph(policy(), ["nothing:0"])
    with pytest.raises(ExportModelError, match="'nothing' is not in the graph"):
        subgraph(policy(control="nothing"), ["action"])


def test_no_op_that_reaches_outside_computes() -> None:
    from export_model.converters.formats.subgraph import COMPUTING

    assert not COMPUTING & FORBIDDEN
