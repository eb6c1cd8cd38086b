"""Ids that a policy looks up: which are tried, what is found of faults that hang on one, what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.verify.participants import Feeds
from export_model.signatures.errors import UsageError
from tests.exporting import load_policy
from tests.faults.test_blind_spots import Arrays, honest, verified
from tests.handmade import constant, dense, graph_bytes, node, placeholder, weights

INTS: dict[str, Any] = {"T": np.int32}
SLICE = {**INTS, "Index": np.int32}


def column(name: str, first: int, count: int = 1) -> list[Any]:
    """Columns of the observation from ``first`` on."""
    return [
        constant(f"{name}/from", np.array([0, first], np.int32)),
        constant(f"{name}/size", np.array([-1, count], np.int32)),
        node(name, "Slice", "vector_observation", f"{name}/from", f"{name}/size", **SLICE),
    ]


def gathered(name: str, source: str, rows: int) -> list[Any]:
    """[B, 1, 2]: the rows of a table that ids [B, 1] pick."""
    return [
        constant(f"{name}/table", weights(rows, 2, rows)),
        node(name, "Gather", f"{name}/table", source, Tparams=np.float32, Tindices=np.int32),
    ]


def flat(name: str, source: str, width: int) -> list[Any]:
    return [
        constant(f"{name}/shape", np.array([-1, width], np.int32)),
        node(name, "Reshape", source, f"{name}/shape", T=np.float32, Tshape=np.int32),
    ]


def one_hot(name: str, source: str, depth: int) -> list[Any]:
    return [
        constant(f"{name}/depth", depth, np.int32),
        constant(f"{name}/on", 1.0),
        constant(f"{name}/off", 0.0),
        node(name, "OneHot", source, f"{name}/depth", f"{name}/on", f"{name}/off", T=np.float32, TI=np.int32, axis=-1),
    ]


def acting(parts: list[Any], widths: dict[str, int], columns: int, dtype: Any = np.int32) -> bytes:
    """``action`` = tanh of a sum of layers on what was looked up."""
    nodes = [placeholder("vector_observation", (None, columns), dtype), *parts]
    terms = []
    for name, width in widths.items():
        nodes += [*flat(f"{name}/flat", name, width), *dense(f"{name}/dense", f"{name}/flat", width, 2)]
        terms.append(f"{name}/dense")
    while len(terms) > 1:
        total = f"sum_{len(terms)}"
        nodes.append(node(total, "Add", terms[0], terms[1], T=np.float32))
        terms = [total, *terms[2:]]
    return graph_bytes([*nodes, node("action", "Tanh", terms[0], T=np.float32)])


def two_tables() -> bytes:
    parts = [*column("a", 0), *column("b", 1), *gathered("ga", "a", 5), *gathered("gb", "b", 40)]
    return acting(parts, {"ga": 2, "gb": 2}, 2)


def two_one_hots() -> bytes:
    parts = [*column("a", 0), *column("b", 1), *one_hot("ha", "a", 3), *one_hot("hb", "b", 7)]
    return acting(parts, {"ha": 3, "hb": 7}, 2)


def compared() -> bytes:
    parts = [
        constant("classes", np.arange(6, dtype=np.int32)),
        constant("long", np.array([-1, 2, 1], np.int32)),
        node("wide", "Reshape", "vector_observation", "long", T=np.int32, Tshape=np.int32),
        node("same", "Equal", "wide", "classes", **INTS),
        node("hot", "Cast", "same", SrcT=np.bool_, DstT=np.float32),
    ]
    return acting(parts, {"hot": 12}, 2)


def shifted() -> bytes:
    """One table of 11 rows for two columns, the second from its row 4 on, counted from 1."""
    parts = [
        constant("by", np.array([[-1, 4]], np.int32)),
        node("rows", "Add", "vector_observation", "by", **INTS),
        *gathered("g", "rows", 11),
    ]
    return acting(parts, {"g": 4}, 2)


def as_numbers() -> bytes:
    """Ids that come as float32, beside a number."""
    parts = [
        constant("a/from", np.array([0, 0], np.int32)),
        constant("a/size", np.array([-1, 1], np.int32)),
        node("a", "Slice", "vector_observation", "a/from", "a/size", T=np.float32, Index=np.int32),
        node("id", "Cast", "a", SrcT=np.float32, DstT=np.int32),
        *gathered("g", "id", 9),
        node("numbers", "Identity", "vector_observation", T=np.float32),
    ]
    return acting(parts, {"g": 2, "numbers": 2}, 2, np.float32)


KNOWN: dict[str, tuple[Callable[[], bytes], Any, Any]] = {
    "two tables": (two_tables, [0, 0], [4, 39]),
    "two one-hots": (two_one_hots, [0, 0], [2, 6]),
    "compared with 0 to 5": (compared, 0, 5),
    "shifted": (shifted, [1, -4], [11, 6]),
    "as numbers": (as_numbers, [0, None], [8, None]),
}


@pytest.mark.parametrize("kind", KNOWN)
def test_bounds_are_known_column_by_column(kind: str, tmp_path: Path, processes: RuntimePool) -> None:
    make, low, high = KNOWN[kind]
    source = tmp_path / "ids.bytes"
    source.write_bytes(make())
    (result,) = export([source], ExportOptions(tmp_path / "first", verify="none"))
    (spec,) = result.policy.signature.inputs
    assert spec.distribution == {"kind": "integer", "low": low, "high": high}
    report = verified(source, tmp_path, processes, honest)
    assert report.passed is True, [f.explanation() for f in report.failures]
    assert not any("not known" in note for note in report.notes)
    lows, highs = (np.broadcast_to(each, 2) for each in (low, high))
    for place in (i for i in (0, 1) if highs[i] is not None):
        for number in range(int(lows[place]), int(highs[place]) + 1):
            assert not found_alone(source, tmp_path, processes, place, number).passed, (place, number)


def found_alone(source: Path, tmp_path: Path, processes: RuntimePool, place: int, number: int) -> Any:
    """The report on a runtime that is wrong for one id of one column."""

    def spoil(feeds: Feeds, answers: Arrays) -> Arrays:
        if "action" in answers:
            (ids,) = feeds.values()
            answers["action"] = answers["action"] + 0.1 * (ids[:, place] == number)[:, None].astype(np.float32)
        return answers

    return verified(source, tmp_path, processes, spoil)


def test_an_id_outside_of_its_table_is_refused(tmp_path: Path) -> None:
    source = tmp_path / "ids.bytes"
    source.write_bytes(two_tables())
    for where in (source, export_to(source, tmp_path)):
        policy = load_policy(where, runtime="numpy")
        policy.decide([[4, 39]])
        for wrong in ([5, 0], [0, 40], [-1, 0]):
            with pytest.raises(UsageError, match="holds") as caught:
                policy.decide([wrong])
            assert "must be an integer from 0 to" in str(caught.value.why)


def export_to(source: Path, tmp_path: Path) -> Path:
    (result,) = export([source], ExportOptions(tmp_path / "out", verify="none"))
    return result.folder


def test_unknown_bounds_are_said(tmp_path: Path, processes: RuntimePool) -> None:
    """The remainder by 3 picks the row: any integer goes, and nothing tells which are meant."""
    parts = [
        constant("three", np.array(3, np.int32)),
        node("rows", "FloorMod", "vector_observation", "three", **INTS),
        *gathered("g", "rows", 3),
    ]
    source = tmp_path / "ids.bytes"
    source.write_bytes(acting(parts, {"g": 4}, 2))
    report = verified(source, tmp_path, processes, honest)
    assert any("which integers" in note for note in report.notes)


def test_integers_that_nothing_looks_up_may_be_any(tmp_path: Path, processes: RuntimePool) -> None:
    parts = [node("numbers", "Cast", "vector_observation", SrcT=np.int32, DstT=np.float32)]
    source = tmp_path / "ids.bytes"
    source.write_bytes(acting(parts, {"numbers": 2}, 2))
    for number in (-2, 3, 5):
        assert not found_alone(source, tmp_path, processes, 0, number).passed
    policy = load_policy(source, runtime="numpy")
    assert policy.decide([[-7, 1000]]).action.shape == (1, 2)
