"""What policy.json says of a policy is read back as what it was."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from export_model.signatures.contract import _RANKS, parse_signature, parse_source_map
from export_model.signatures.roles import INPUT_ROLES, Role
from export_model.signatures.spec import Memory, PolicySignature, SourceMap, TensorSpec

NAMES = st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1, max_size=12)
NUMBERS = st.integers(-(2**40), 2**40) | st.floats(allow_nan=False, allow_infinity=False)
AXES = st.none() | st.integers(0, 9)
SHAPES = st.lists(AXES, max_size=4).map(tuple)
SOURCES = st.none() | NAMES | st.lists(NAMES, min_size=1, max_size=3).map(tuple)
DISTRIBUTIONS = st.none() | st.fixed_dictionaries({"kind": st.just("normal"), "mean": NUMBERS, "std": NUMBERS})


@st.composite
def tensor(draw: st.DrawFn, roles: Sequence[Role], total: int) -> TensorSpec:
    """Of as many axes as its role has; masks and chances are one for each of ``total`` actions, if that is known."""
    role = draw(st.sampled_from(roles))
    ranks = _RANKS.get(role, range(5))
    shape = draw(st.lists(AXES, min_size=min(ranks), max_size=min(max(ranks), 5)))
    if role in (Role.MASKS, Role.LOG_PROBS, Role.PROBS) and total:
        shape[-1] = draw(st.sampled_from([None, total]))
    dtype = draw(st.sampled_from(["float32", "int32", "int64", "bool"]))
    return TensorSpec(draw(NAMES), role, dtype, tuple(shape), draw(SOURCES), draw(DISTRIBUTIONS))


def tensors(roles: Sequence[Role], total: int) -> st.SearchStrategy[list[TensorSpec]]:
    return st.lists(tensor(roles, total), max_size=3, unique_by=lambda s: s.name)


@st.composite
def actions(draw: st.DrawFn, space: str) -> list[TensorSpec]:
    kinds = {"hybrid": [Role.CONTINUOUS, Role.SAMPLED], "discrete": [Role.SAMPLED], "continuous": [Role.CONTINUOUS]}
    shapes = st.tuples(st.none(), st.integers(1, 9))
    return [
        TensorSpec(f"head {i}", role, "float32", draw(shapes), draw(SOURCES)) for i, role in enumerate(kinds[space])
    ]


@st.composite
def signatures(draw: st.DrawFn) -> PolicySignature:
    space = draw(st.sampled_from(["continuous", "discrete", "hybrid"]))
    branches = tuple(draw(st.lists(st.integers(1, 9), max_size=3)))
    inputs = tuple(draw(tensors(INPUT_ROLES, sum(branches))))
    others = draw(tensors([r for r in Role if r not in INPUT_ROLES], sum(branches)))
    outputs = (*draw(actions(space)), *(s for s in others if s.name not in ("head 0", "head 1")))
    name = st.none() | st.sampled_from([s.name for s in inputs]) if inputs else st.none()
    memory = st.builds(
        Memory,
        size=st.integers(1, 512),
        input=name,
        output=st.none() | st.sampled_from([s.name for s in outputs]),
        layout=st.lists(st.sampled_from("ch"), max_size=4).map(tuple),
    )
    return PolicySignature(
        inputs=inputs,
        outputs=outputs,
        family=draw(NAMES),
        action_space=space,
        branches=branches,
        algorithm=draw(st.none() | st.sampled_from(["PPO", "SAC"])),
        memory=draw(st.none() | memory),
        preprocess={s.name: {"layout": "NHWC", "range": [0, 1], "from_bytes": "as they are"} for s in inputs[:1]},
        constants=draw(st.dictionaries(NAMES, NUMBERS, max_size=3)),
        notes=draw(st.lists(NAMES, max_size=2).map(tuple)),
    )


def through_json(content: dict[str, Any]) -> dict[str, Any]:
    read: dict[str, Any] = json.loads(json.dumps(content, allow_nan=False))
    return read


@given(signatures())
@settings(max_examples=60, deadline=None)
def test_a_signature_is_read_back(signature: PolicySignature) -> None:
    entry = through_json(signature.to_dict())
    assert parse_signature(entry) == signature
    assert parse_signature({**entry, "files": {}, "schema": 1}) == signature
    assert through_json(parse_signature(entry).to_dict()) == entry


ARRAYS = st.one_of(
    st.integers(-(2**31), 2**31 - 1).map(lambda v: np.array(v, np.int32)),
    st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), min_size=1, max_size=3).map(
        lambda v: np.array(v, np.float32)
    ),
    st.booleans().map(np.array),
)


@given(
    st.dictionaries(NAMES, ARRAYS, max_size=2),
    st.dictionaries(NAMES, st.integers(0, 1), max_size=2),
    st.dictionaries(NAMES, SHAPES, max_size=2),
    st.booleans(),
    st.lists(st.none() | NAMES, max_size=3).map(tuple),
)
@settings(max_examples=60, deadline=None)
def test_how_to_run_the_source_is_read_back(
    fixed: dict[str, np.ndarray],
    batch_sizes: dict[str, int],
    noise: dict[str, tuple[int | None, ...]],
    kept: bool,
    branches: tuple[str | None, ...],
) -> None:
    inputs = (TensorSpec("state", Role.VECTOR, "float32", (None, 3), "vector_observation:0"),)
    outputs = (
        TensorSpec("action", Role.CONTINUOUS, "float32", (None, 2), "action:0"),
        TensorSpec("deterministic_action", Role.DETERMINISTIC, "float32", (None, 2), None),
        TensorSpec("recurrent_out", Role.MEMORY_OUT, "float32", (None, 2), ("c:0", "h:0")),
    )
    signature = PolicySignature(inputs=inputs, outputs=outputs, family="own model", action_space="continuous")
    source = SourceMap({}, {}, fixed, batch_sizes, noise, kept, branches)
    read = parse_source_map(through_json(source.to_dict()), signature)
    assert read.feeds == {"state": "vector_observation:0"}
    assert read.fetches["action"] == "action:0"
    assert "deterministic_action" not in read.fetches
    assert (read.batch_sizes, read.noise, read.noise_kept, read.branches) == (batch_sizes, noise, kept, branches)
    assert read.fixed.keys() == fixed.keys()
    for name, value in fixed.items():
        np.testing.assert_array_equal(read.fixed[name], value, strict=True)


def test_an_empty_map_is_read_from_nothing() -> None:
    signature = PolicySignature(inputs=(), outputs=(), family="own model", action_space="continuous")
    assert parse_source_map({}, signature) == SourceMap()


def test_tensors_are_found_by_name() -> None:
    state = TensorSpec("state", Role.VECTOR, "float32", (None, 3))
    noise = TensorSpec("epsilon", Role.NOISE, "float32", (None, 2))
    action = TensorSpec("action", Role.CONTINUOUS, "float32", (None, 2))
    signature = PolicySignature(inputs=(state, noise), outputs=(action,), family="own model", action_space="continuous")
    assert signature.input("epsilon") is noise
    assert signature.output("action") is action
    assert signature.observations == (state,)
    assert signature.noise == (noise,)
    assert signature.has_input("state")
    assert not signature.has_input("action")
    for lookup in (signature.input, signature.output):
        with pytest.raises(KeyError, match="nothing"):
            lookup("nothing")


def test_the_parts_of_policy_json_are_in_their_order() -> None:
    signature = PolicySignature(
        inputs=(), outputs=(), family="own model", action_space="continuous", memory=Memory(4, "a", "b", ("c", "h"))
    )
    assert list(signature.to_dict()) == [
        *("family", "algorithm", "action_space", "inputs", "outputs", "memory", "branches"),
        *("preprocess", "constants", "notes"),
    ]
    assert signature.to_dict()["memory"] == {"size": 4, "input": "a", "output": "b", "layout": ["c", "h"]}


def hybrid(*companions: TensorSpec) -> PolicySignature:
    heads = (
        TensorSpec("continuous_actions", Role.CONTINUOUS, "float32", (None, 2)),
        TensorSpec("discrete_actions", Role.LOG_PROBS, "float32", (None, 5)),
    )
    return PolicySignature(
        inputs=(), outputs=(*heads, *companions), family="own model", action_space="hybrid", branches=(2, 3)
    )


def test_each_action_of_a_hybrid_has_its_own_companion_even_where_one_is_missing() -> None:
    steady = TensorSpec("deterministic_continuous_actions", Role.DETERMINISTIC, "float32", (None, 2))
    likeliest = TensorSpec("deterministic_discrete_actions", Role.DETERMINISTIC, "int64", (None, 2))
    assert [h.plain for h in hybrid(steady, likeliest).heads] == [steady, likeliest]
    assert [h.plain for h in hybrid(likeliest, steady).heads] == [steady, likeliest]
    assert [h.plain for h in hybrid(likeliest).heads] == [None, likeliest]
    assert [h.plain for h in hybrid(steady).heads] == [steady, None]
    assert hybrid(likeliest).companion_of("continuous_actions") is None
    assert hybrid(likeliest).companion_of("discrete_actions") is likeliest
    assert hybrid(likeliest).companion_of("deterministic_discrete_actions") is None
    assert [(h.name, h.is_continuous, h.branches) for h in hybrid().heads] == [
        ("continuous_actions", True, ()),
        ("discrete_actions", False, (2, 3)),
    ]


def test_the_only_action_has_the_companion_that_there_is() -> None:
    action = TensorSpec("action", Role.SAMPLED, "int64", (None, 1))
    likeliest = TensorSpec("own/deterministic", Role.DETERMINISTIC, "int64", (None, 1))
    scores = TensorSpec("action_log_probs", Role.LOG_PROBS, "float32", (None, 4))
    signature = PolicySignature(
        inputs=(), outputs=(action, likeliest, scores), family="own model", action_space="discrete", branches=(4,)
    )
    assert signature.companion_of("action") is likeliest
    assert signature.log_probs is scores
    assert (
        PolicySignature(inputs=(), outputs=(likeliest,), family="own model", action_space="discrete", branches=(4,))
        .heads[0]
        .plain
        is None
    )
