"""What policy.json says of a policy is read back as what it was."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from signatures.roles import Role
from signatures.spec import Memory, PolicySignature, SourceMap, TensorSpec

NAMES = st.text(min_size=1, max_size=12)
NUMBERS = st.integers(-(2**40), 2**40) | st.floats(allow_nan=False, allow_infinity=False)
SHAPES = st.lists(st.none() | st.integers(0, 512), max_size=4).map(tuple)
SOURCES = st.none() | NAMES | st.lists(NAMES, min_size=1, max_size=3).map(tuple)
DISTRIBUTIONS = st.none() | st.fixed_dictionaries({"kind": st.just("normal"), "mean": st.lists(NUMBERS, max_size=3)})
TENSORS = st.builds(
    TensorSpec,
    name=NAMES,
    role=st.sampled_from(list(Role)),
    dtype=st.sampled_from(["float32", "int32", "int64", "bool"]),
    shape=SHAPES,
    source=SOURCES,
    distribution=DISTRIBUTIONS,
)
MEMORIES = st.none() | st.builds(
    Memory,
    size=st.integers(0, 512),
    input=st.none() | NAMES,
    output=st.none() | NAMES,
    layout=st.lists(st.sampled_from("ch"), max_size=4).map(tuple),
)
SIGNATURES = st.builds(
    PolicySignature,
    inputs=st.lists(TENSORS, max_size=3).map(tuple),
    outputs=st.lists(TENSORS, max_size=3).map(tuple),
    family=NAMES,
    action_space=st.sampled_from(["continuous", "discrete", "hybrid"]),
    branches=st.lists(st.integers(1, 9), max_size=3).map(tuple),
    algorithm=st.none() | st.sampled_from(["PPO", "SAC"]),
    memory=MEMORIES,
    preprocess=st.dictionaries(NAMES, st.just({"layout": "NHWC"}), max_size=2),
    constants=st.dictionaries(NAMES, NUMBERS, max_size=3),
    notes=st.lists(NAMES, max_size=2).map(tuple),
)


def through_json(content: dict[str, Any]) -> dict[str, Any]:
    read: dict[str, Any] = json.loads(json.dumps(content, allow_nan=False))
    return read


@given(TENSORS)
def test_a_tensor_is_read_back(spec: TensorSpec) -> None:
    assert TensorSpec.from_dict(through_json(spec.to_dict())) == spec


@given(SIGNATURES)
@settings(max_examples=60, deadline=None)
def test_a_signature_is_read_back(signature: PolicySignature) -> None:
    entry = through_json(signature.to_dict())
    assert PolicySignature.from_dict(entry) == signature
    assert PolicySignature.from_dict({**entry, "files": {}, "schema": 1}) == signature
    assert through_json(PolicySignature.from_dict(entry).to_dict()) == entry


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
    signature = PolicySignature(inputs, outputs, "own model", "continuous")
    source = SourceMap({}, {}, fixed, batch_sizes, noise, kept, branches)
    read = SourceMap.from_dict(through_json(source.to_dict()), signature)
    assert read.feeds == {"state": "vector_observation:0"}
    assert read.fetches["action"] == "action:0"
    assert "deterministic_action" not in read.fetches
    assert (read.batch_sizes, read.noise, read.noise_kept, read.branches) == (batch_sizes, noise, kept, branches)
    assert read.fixed.keys() == fixed.keys()
    for name, value in fixed.items():
        np.testing.assert_array_equal(read.fixed[name], value, strict=True)


def test_an_empty_map_is_read_from_nothing() -> None:
    signature = PolicySignature((), (), "own model", "continuous")
    assert SourceMap.from_dict({}, signature) == SourceMap()


def test_tensors_are_found_by_name() -> None:
    state = TensorSpec("state", Role.VECTOR, "float32", (None, 3))
    noise = TensorSpec("epsilon", Role.NOISE, "float32", (None, 2))
    action = TensorSpec("action", Role.CONTINUOUS, "float32", (None, 2))
    signature = PolicySignature((state, noise), (action,), "own model", "continuous")
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
    signature = PolicySignature((), (), "own model", "continuous", memory=Memory(4, "a", "b", ("c", "h")))
    assert list(signature.to_dict()) == [
        *("family", "algorithm", "action_space", "inputs", "outputs", "memory", "branches"),
        *("preprocess", "constants", "notes"),
    ]
    assert signature.to_dict()["memory"] == {"size": 4, "input": "a", "output": "b", "layout": ["c", "h"]}
