"""Constants that hold other than they say: refused with file, node and reason, and little memory is taken."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.signatures.errors import DamagedFileError
from tests.commands import export_model
from tests.handmade import (
    NodeDef,
    constant,
    continuous_policy,
    dense,
    graph_bytes,
    node,
    placeholder,
)
from tests.robustness.refusing import refused, tensor

#: What a file of a few hundred bytes may make the reader allocate.
MODEST = 32 << 20


def test_a_constant_with_too_few_bytes_is_refused(tmp_path: Path) -> None:
    nodes = continuous_policy()
    tensor(nodes, "mu/kernel").tensor_content = bytes(23)
    refused(nodes, tmp_path, "node 'mu/kernel'", "23 bytes for 6 elements of float32")


def test_a_constant_without_a_value_is_refused(tmp_path: Path) -> None:
    nodes = continuous_policy()
    del nodes[1].attr["value"]
    refused(nodes, tmp_path, "'mu/kernel' has no value")


def _claimed(tensor: Any, *sizes: int) -> None:
    del tensor.tensor_shape.dim[:]
    for size in sizes:
        tensor.tensor_shape.dim.add(size=size)


def _absurd(t: Any) -> None:
    _claimed(t, 1 << 20, 1 << 20)


def _huge(t: Any) -> None:
    t.tensor_content = b""
    _claimed(t, 1 << 13, 1 << 13)


def _overflowing(t: Any) -> None:
    _claimed(t, *[1 << 40] * 4)


def _overflowing_but_empty(t: Any) -> None:
    t.tensor_content = b""
    _claimed(t, 0, 1 << 62, 1 << 62)


def _many_axes(t: Any) -> None:
    t.tensor_content = b"\0\0\0\0"
    _claimed(t, *[1] * 200)


def _negative(t: Any) -> None:
    _claimed(t, -1, 2)


def _unknown_rank(t: Any) -> None:
    t.tensor_shape.unknown_rank = True


def _more_values_than_elements(t: Any) -> None:
    t.tensor_content = b""
    t.float_val.extend([1.0] * 7)


def _a_resource(t: Any) -> None:
    t.dtype = 20


def _a_half_of_20_bits(t: Any) -> None:
    t.tensor_content = b""
    t.dtype = 19
    t.half_val.append(1 << 20)


def _wide_strings(t: Any) -> None:
    t.tensor_content = b""
    t.dtype = 7
    t.string_val.extend([b"x" * 100_000, *[b""] * 10_000])


DAMAGES = [
    *(_absurd, _huge, _overflowing, _overflowing_but_empty, _many_axes, _negative, _unknown_rank),
    *(_more_values_than_elements, _a_resource, _a_half_of_20_bits, _wide_strings),
]


@pytest.mark.parametrize("damage", DAMAGES, ids=[d.__name__.strip("_") for d in DAMAGES])
def test_a_tensor_that_cannot_be_is_refused_before_it_takes_memory(
    damage: Callable[[Any], None], tmp_path: Path
) -> None:
    nodes = continuous_policy()
    damage(tensor(nodes, "mu/kernel"))
    data = graph_bytes(nodes)
    tracemalloc.start()
    try:
        with pytest.raises(DamagedFileError, match="node 'mu/kernel', attribute 'value': the tensor cannot be read"):
            read_graph(data)
        assert tracemalloc.get_traced_memory()[1] < MODEST
    finally:
        tracemalloc.stop()
    refused(nodes, tmp_path, "node 'mu/kernel'")


def test_many_constants_together_may_not_claim_much_more_than_the_file_holds() -> None:
    def filled(name: str, side: int) -> NodeDef:
        made = constant(name, 1.0)
        t = made.attr["value"].tensor
        t.tensor_content = b""
        t.float_val.append(0.5)
        _claimed(t, side, side)
        return made

    single = read_graph(graph_bytes([filled("a", 1 << 11)]))["a"].value
    assert single is not None
    assert single.shape == (1 << 11, 1 << 11)
    assert (single == 0.5).all()
    tracemalloc.start()
    try:
        with pytest.raises(DamagedFileError, match="elements that the file does not hold"):
            read_graph(graph_bytes([filled(f"a{i}", 1 << 11) for i in range(100)]))
        assert tracemalloc.get_traced_memory()[1] < 100 << 20  # 64 MiB is what all may claim together
    finally:
        tracemalloc.stop()


def test_the_short_forms_of_a_tensor_are_read() -> None:
    def read(dtype: Any, shape: tuple[int, ...], field: str, values: list[Any]) -> np.ndarray:
        made = constant("a", 0.0)
        t = made.attr["value"].tensor
        t.tensor_content = b""
        t.dtype = schema.dtype_number(np.dtype(dtype))
        getattr(t, field).extend(values)
        _claimed(t, *shape)
        value = read_graph(graph_bytes([made]))["a"].value
        assert value is not None
        assert value.dtype == np.dtype(dtype)
        return value

    assert read(np.float32, (3,), "float_val", [1.5]).tolist() == [1.5, 1.5, 1.5]
    assert read(np.float32, (2, 2), "float_val", [1, 2, 3]).tolist() == [[1, 2], [3, 3]]
    assert read(np.int64, (2,), "int64_val", []).tolist() == [0, 0]
    assert read(np.float16, (2,), "half_val", [0x3C00]).tolist() == [1, 1]
    assert read(np.bool_, (2,), "bool_val", [True]).tolist() == [True, True]
    assert read(np.int8, (), "int_val", [-7]).tolist() == -7
    assert read(np.int32, (0, 3), "int_val", []).shape == (0, 3)
    assert read(np.bytes_("ab").dtype, (), "string_val", [b"ab"]).tolist() == b"ab"


def test_statistics_and_constants_that_are_not_finite_do_not_reach_the_contract(tmp_path: Path) -> None:
    """JSON has no NaN: a version number that is none is left out."""
    nodes = [
        *continuous_policy(),
        *(constant(n, np.float32(v)) for n, v in (("version_number", np.nan), ("memory_size", np.inf))),
        constant("is_continuous_control", 1),
    ]
    (tmp_path / "a.bytes").write_bytes(graph_bytes(nodes))
    ran = export_model("inspect", tmp_path / "a.bytes", "--json")
    assert ran.json["policies"][0]["constants"] == {"is_continuous_control": 1}


def test_a_normaliser_that_is_not_finite_is_not_told(tmp_path: Path) -> None:
    """Training that diverged leaves NaN; JSON has none, and nobody can draw around it."""
    nodes = [
        placeholder("vector_observation"),
        constant("mean", np.array([0, np.nan, 1], np.float32)),
        constant("deviation", np.array([1, 1, 1], np.float32)),
        node("centred", "Sub", "vector_observation", "mean"),
        node("normalised", "RealDiv", "centred", "deviation"),
        *dense("mu", "normalised", 3, 2),
        node("action", "Tanh", "mu"),
    ]
    (tmp_path / "a.bytes").write_bytes(graph_bytes(nodes))
    ran = export_model("inspect", tmp_path / "a.bytes", "--json")
    assert "NaN" not in ran.out
    assert export_model(tmp_path / "a.bytes", "-o", tmp_path / "out", "--verify", "none").status == 0


def test_a_constant_that_is_read_through_nothing_is_none(tmp_path: Path) -> None:
    nodes = [*continuous_policy(), node("memory_size", "Identity")]
    (tmp_path / "a.bytes").write_bytes(graph_bytes(nodes))
    assert export_model("inspect", tmp_path / "a.bytes", "--json").json["policies"][0]["constants"] == {}
