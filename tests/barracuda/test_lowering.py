"""Every op of the table as layers: what they compute by the format's rules, and what cannot be written."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from export_model.converters.graph.ops.table import TABLE
from export_model.converters.graph.run import run_graph
from export_model.signatures.errors import UnsupportedOpError
from export_model.signatures.roles import Role
from tests.barracuda.cases import Case, all_cases
from tests.barracuda.nn_running import action_model, action_of, as_policy, some
from tests.barracuda.nn_safety import assert_safe
from tests.barracuda.test_layers import feeds_of, policy_of
from tests.graph.samples import SAMPLES

CLOSE = {"atol": 3e-5, "rtol": 3e-5}


# ------------------------------------------------------------------ the table of ops


#: Op → the titles of its samples that version 16 cannot hold, or that not every Barracuda computes.
REFUSALS: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(("Sin", "Cos", "Tan"), ("matrix", "rank 4")),
    **dict.fromkeys(("ArgMax", "ArgMin"), ("negative axis, int32",)),
    **dict.fromkeys(("Softmax", "LogSoftmax"), ("rank 3",)),
    "BatchMatMul": ("rank 3", "adj_x", "adj_y, rank 4"),
    "Shape": ("int64",),
    "StridedSlice": ("x[:, 2:2]",),
    "Gather": ("int64 matrix of indices",),
    "GatherV2": ("negative axis",),
    "OneHot": ("axis 1 of 3",),
    "SparseToDense": ("places of a matrix",),
    "Where": ("numbers, NaN among them",),
}

#: (op, title) → why the layers give something else: the rules are float64 here, and numbers of no policy are fed.
DIFFERS: Mapping[tuple[str, str], str] = {
    ("FloorDiv", "float32, near an integer"): "1 / 0.1 is 10 in float32 and a little less in the test's float64",
    ("LogSoftmax", "large"): "the rules take the logarithm of the softmax, whose smallest numbers are 0",
    ("ZerosLike", "float32"): "a row of constants is an input times 0, and NaN is fed",
    ("OnesLike", "float32"): "as ZerosLike",
}


@pytest.mark.parametrize("op", TABLE)
def test_an_op_computes_the_same_as_layers_or_is_refused_by_name(op: str) -> None:
    refused = []
    for sample in (s for s in SAMPLES if s.op == op and not s.drawn):
        policy = as_policy(sample)
        if policy is None:
            continue
        try:
            model = action_model(policy)
        except UnsupportedOpError as error:
            assert list(error.issues) == [("op", op)]
            assert error.why
            assert error.fix
            refused.append(sample.title)
            continue
        reference = policy.fetches["action"]
        expected = run_graph(sample.graph, sample.feeds, [reference])[reference]
        with np.errstate(all="ignore"):
            got = action_of(policy, model, sample.feeds).astype(np.float32)
            same = np.allclose(got, expected.astype(np.float32).reshape(got.shape), **CLOSE, equal_nan=True)
        assert same != ((op, sample.title) in DIFFERS), f"{sample.title}: {got} for {expected}"
    assert tuple(refused) == REFUSALS.get(op, ())


def test_a_layer_that_is_an_op_is_no_other() -> None:
    """Readers make the op of it; both kinds of numbers are counted from 0."""
    kinds = [(type(op.nn.kind), op.nn.kind) for op in TABLE.values() if op.nn is not None and op.nn.kind is not None]
    assert len(set(kinds)) == len(kinds) > 15


# ------------------------------------------------------------------ the layers that are read


#: Cases that are not written again: their layers (or what becomes of them in a graph) are none of every Barracuda's.
UNWRITTEN = (
    "Sin", "Cos", "Tan", "ArgMax", "ArgMin", "BatchMatMul", "MatMul", "Prod", "Min", "Reshape", "GatherV2",
)  # fmt: skip


@pytest.mark.parametrize("case", [pytest.param(c, id=c.name) for c in all_cases()])
def test_a_layer_that_is_read_is_written_again_as_what_it_computes(case: Case) -> None:
    policy = policy_of(case)
    if any(s.role is Role.PARAMETER for s in policy.signature.inputs):
        pytest.skip("it has an input that ML-Agents does not feed")
    try:
        model = action_model(policy)
    except UnsupportedOpError as error:
        assert error.issues[0][1] in UNWRITTEN, str(error)
        return
    assert_safe(model)
    for rows in (1, 3):
        feeds = some(policy, rows)
        feeds = {n: np.resize(feeds_of(case, policy)[n], a.shape).astype(a.dtype) for n, a in feeds.items()}
        expected = run_graph(policy.graph, feeds, ["action"])["action"]
        np.testing.assert_allclose(action_of(policy, model, feeds), expected.reshape(rows, -1), **CLOSE)
