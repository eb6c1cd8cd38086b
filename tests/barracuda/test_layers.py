"""Every kind of layer and activation: the graph that is made of it computes what the format's formulas say."""

from __future__ import annotations

import numpy as np
import pytest

from export_model.converters.compiler.compile import compile_graph
from export_model.converters.formats.barracuda.format import parse
from export_model.converters.formats.barracuda.graph import to_graph
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import static_shape
from export_model.converters.policy.policy import Policy
from tests.barracuda.cases import Case, all_cases
from tests.barracuda.nn_files import write_nn
from tests.barracuda.reference import evaluate

CASES = all_cases()


def policy_of(case: Case) -> Policy:
    (policy,) = compile_graph(to_graph(parse(write_nn(case.model))).graph, case.name)
    return policy


def feeds_of(case: Case, policy: Policy) -> dict[str, np.ndarray]:
    found = {}
    for spec in policy.signature.inputs:
        assert isinstance(spec.source, str)
        array = case.feeds[spec.source]
        found[spec.name] = (array if len(spec.shape) == 4 else array.reshape(len(array), -1)).astype(spec.dtype)
    return found


def expected_of(case: Case) -> np.ndarray:
    action = evaluate(case.model, case.feeds)["action"]
    return action.reshape(len(action), -1)


@pytest.mark.parametrize("case", [pytest.param(c, id=c.name) for c in CASES])
def test_a_layer_computes_what_its_formula_says(case: Case) -> None:
    graph = to_graph(parse(write_nn(case.model))).graph
    expected = expected_of(case)
    raw = {}
    for name, array in case.feeds.items():
        rank = len(graph[name].attrs["shape"].dims)
        raw[name] = array if rank == 4 else array.reshape(len(array), -1)
    first = run_graph(graph, raw, ["action"])["action"]
    np.testing.assert_allclose(first, expected, atol=2e-5, rtol=2e-5)

    policy = policy_of(case)
    action = policy.signature.output("action")
    assert action.shape == (None, expected.shape[1])
    assert action.source == "action"
    for spec in policy.signature.outputs:
        assert static_shape(infer_types(policy.graph)[spec.name].shape) == spec.shape
    for rows in (1, len(expected)):
        fed = {name: array[:rows] for name, array in feeds_of(case, policy).items()}
        got = run_graph(policy.graph, fed, ["action"])["action"]
        np.testing.assert_allclose(got, expected[:rows], atol=2e-5, rtol=2e-5)
