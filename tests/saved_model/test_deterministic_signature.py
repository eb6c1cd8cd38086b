"""The signature ``deterministic`` of a SavedModel has what needs no draw, whichever op draws."""

from __future__ import annotations

import pytest

from export_model.converters.formats.saved_model.writer import DETERMINISTIC, signatures_of
from export_model.converters.graph.ops.samplers import SAMPLERS
from export_model.converters.policy.policy import Policy
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature, TensorSpec
from tests.graph.making import graph, node, placeholder


@pytest.mark.parametrize("op", sorted(SAMPLERS))
def test_what_is_drawn_is_left_out(op: str) -> None:
    made = graph(
        placeholder("state", (None, 2)),
        node("deterministic_action", "Tanh", "state"),
        node("shape", "Shape", "state"),
        node("draw", op, "shape", dtype="float32"),
        node("action", "Add", "deterministic_action", "draw"),
    )
    outputs = [
        TensorSpec(name, role, "float32", (None, 2), None)
        for name, role in (("action", Role.CONTINUOUS), ("deterministic_action", Role.DETERMINISTIC))
    ]
    state = TensorSpec("state", Role.VECTOR, "float32", (None, 2), None)
    signature = PolicySignature(inputs=(state,), outputs=tuple(outputs), family="test", action_space="continuous")
    policy = Policy("p", made, signature, {"state": "state"}, {s.name: s.name for s in outputs})
    inputs, given = signatures_of(policy)[DETERMINISTIC]
    assert [s.name for s in inputs] == ["state"]
    assert [s.name for s in given] == ["deterministic_action"]
