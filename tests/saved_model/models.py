"""The models of ``make_models``, and what they are compared with."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from export_model.converters.graph.nodes import node_of
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy

#: What the keys of the models' signatures are called in a policy.
CANONICAL = {
    "in": "state",
    "out": "action",
    "vector_observation": "state",
    "visual_observation_0": "observation_0",
    "output_0": "action",
}


def arrays(archive: Path) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """(what was fed, what TensorFlow computed), by canonical names."""
    with np.load(archive) as kept:
        sides = ({}, {})
        for key in kept.files:
            side, name = key.split("/", 1)
            sides[side == "out"][CANONICAL.get(name, name)] = kept[key]
    return sides


def assert_agrees(policy: Policy, archive: Path, atol: float = 1e-6) -> None:
    feeds, wanted = arrays(archive)
    assert {s.name for s in policy.signature.inputs} == set(feeds)
    got = run_graph(policy.graph, feeds, list(wanted))
    for name, value in wanted.items():
        np.testing.assert_allclose(got[name], value, rtol=1e-6, atol=atol, err_msg=name)


def roles(policy: Policy) -> Mapping[str, str]:
    both = (*policy.signature.inputs, *policy.signature.outputs)
    return {s.name: s.role.value for s in both if s.name != "deterministic_action"}


def sources(policy: Policy) -> Mapping[str, str]:
    """Names → the nodes of the source."""
    both = (*policy.signature.inputs, *policy.signature.outputs)
    return {s.name: node_of(s.source) for s in both if isinstance(s.source, str)}
