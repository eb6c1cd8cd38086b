"""What the op table says of ops, held against the kernels; and that no file lists ops but theirs and some readers'."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import onnx.defs
import pytest

from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.ops import activations, table
from export_model.converters.graph.ops.table import (
    CONTROL_FLOW,
    FORBIDDEN,
    SPELLINGS,
    TABLE,
    hands_on,
    is_fed,
    passes_on,
    traits,
)
from export_model.converters.graph.run import run_graph
from tests.commands import ROOT
from tests.graph.harness import Array
from tests.graph.making import defaults
from tests.graph.samples import SAMPLES, Sample

OUTSIDE = table.VARIABLES | table.ASSIGNS | table.RESTORES | table.READS | table.ORDERING | table.CALLING
NAMES = {*TABLE, *SPELLINGS, *CONTROL_FLOW, *FORBIDDEN, *OUTSIDE}
#: ONNX's own words, which its room and the tables of those who import it may list.
ONNX_WORDS = frozenset(schema.name for schema in onnx.defs.get_all_schemas_with_history())
SPEAK_ONNX = ("converters/formats/onnx/", "converters/consumers/unity/")
#: Where an op's own entry is, and readers, whose words only look like ops.
NOT_COUNTED = (
    "converters/graph/ops/",
    *SPEAK_ONNX,
    *(f"converters/formats/{room}/" for room in ("litert/importer", "keras", "torchscript")),
)


def listed(tree: ast.AST, *, translates: bool = False) -> Iterator[tuple[int, set[str]]]:
    """(line, ops) of every literal collection that names at least two ops.

    ``translates``: but for a table from the words of a format to ops, or from ops to the words, sentences and functions
    of a format, ``dict.fromkeys`` too. One that has a truth, a number or nothing for an op says what the op is like.
    """
    tables = {id(part) for found in ast.walk(tree) for part in _keys(found)} if translates else set[int]()
    for found in ast.walk(tree):
        if isinstance(found, ast.Tuple | ast.List | ast.Set) and id(found) not in tables:
            parts: list[ast.expr | None] = list(found.elts)
        elif isinstance(found, ast.Dict) and not translates:
            parts = [*found.keys, *found.values]
        elif isinstance(found, ast.Dict):
            parts = [k for k, v in zip(found.keys, found.values, strict=True) if _is_fact(v)]
        elif translates and isinstance(found, ast.Call) and any(map(_is_fact, found.args[1:] or [ast.Constant(None)])):
            parts = [p for keys in _keys(found) for p in getattr(keys, "elts", ())]
        else:
            continue
        ops = {p.value for p in parts if isinstance(p, ast.Constant) and isinstance(p.value, str)} & NAMES
        if len(ops) > 1:
            yield found.lineno, ops


def _is_fact(value: ast.expr) -> bool:
    """Whether all that a table has for an op are truths and numbers."""
    parts = value.elts if isinstance(value, ast.Tuple | ast.List | ast.Set) else [value]
    return all(isinstance(p, ast.Constant) and not isinstance(p.value, str) for p in parts)


def _keys(node: ast.AST) -> list[ast.expr]:
    """The collections that are the keys of a dictionary: of ``dict.fromkeys``, of a comprehension."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "fromkeys":
        return node.args[:1]
    return [g.iter for g in node.generators] if isinstance(node, ast.DictComp) else []


def test_no_other_file_lists_ops() -> None:
    """Every file is looked at. A format's room may have tables that translate, none that say what ops are like."""
    found = {}
    for package in ("signatures", "converters", "exporter"):
        for path in sorted((ROOT / package).rglob("*.py")):
            name = path.relative_to(ROOT).as_posix()
            if name.startswith("converters/graph/ops/") or "node_modules" in name:
                continue
            tree = ast.parse(path.read_text(encoding="utf-8"))
            for line, ops in listed(tree, translates=name.startswith("converters/formats/")):
                if not (name.startswith(SPEAK_ONNX) and ops <= ONNX_WORDS):
                    found[f"{name}:{line}"] = ops
    assert found == {}


def entries(path: Path) -> set[str]:
    """The ops that have an entry of their own in a file: a key of a table, a part of a list with others."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".mjs":  # an op's kernel is a key of an object, or the name of one that the object takes
        words = {m[1] or m[2] for m in re.finditer(r"^\s+(\w+)(?:,|\s*[:(])|[{,]\s*(\w+):", text, re.MULTILINE)}
        return words & TABLE.keys()
    found = set[str]()
    for node in ast.walk(ast.parse(text)):
        parts = node.keys if isinstance(node, ast.Dict) else getattr(node, "elts", [])
        ops = {p.value for p in parts if isinstance(p, ast.Constant) and isinstance(p.value, str)} & TABLE.keys()
        found |= ops if len(ops) > 1 else set()
    return found


def test_an_op_has_no_entry_outside_of_its_own() -> None:
    """Readers' tables speak the words of their formats."""
    places: dict[str, list[str]] = {}
    for room in ("signatures", "converters", "exporter"):
        for path in sorted((ROOT / room).rglob("*")):
            name = path.relative_to(ROOT).as_posix()
            if path.suffix not in (".py", ".mjs") or "node_modules" in name or name.startswith(NOT_COUNTED):
                continue
            for op in entries(path):
                places.setdefault(op, []).append(name)
    assert places == {}


def test_a_list_of_ops_would_be_found() -> None:
    assert list(listed(ast.parse('A = frozenset(("MatMul", "x", "Conv2D"))'))) == [(1, {"MatMul", "Conv2D"})]
    assert list(listed(ast.parse('A = {"AddV2": 1, "Enter": 2}'))) == [(1, {"AddV2", "Enter"})]
    assert list(listed(ast.parse('A = ("MatMul", "width")'))) == []


def test_a_table_that_translates_is_told_from_a_list() -> None:
    table = 'A = {"Add": "AddV2", "Mul": "Sub", **dict.fromkeys(("MatMul", "Conv2D"), f)}'
    assert list(listed(ast.parse(table), translates=True)) == []
    assert list(listed(ast.parse('A = {"x": ("MatMul", "Conv2D")}'), translates=True)) == [(1, {"MatMul", "Conv2D"})]


@pytest.mark.parametrize(
    "table",
    [
        'A = {"Sum": False, "Mean": True}',
        'A = {"Sum": (0, 1), "Mean": (), "Add": f}',
        'A = dict.fromkeys(("Sum", "Mean"), 1)',
        'A = {**dict.fromkeys(("Sum", "Mean"))}',
    ],
)
def test_a_table_of_facts_is_no_translation(table: str) -> None:
    assert list(listed(ast.parse(table), translates=True)) == [(1, {"Sum", "Mean"})]


# ------------------------------------------------------------------ traits


def wide(arrays: Mapping[str, Array]) -> dict[str, Array]:
    return {name: a.astype(np.float64) if a.dtype == np.float32 else a for name, a in arrays.items()}


def computed(sample: Sample, *, in_double: bool) -> list[Array]:
    feeds = wide(sample.feeds) if in_double else dict(sample.feeds)
    if in_double:
        feeds |= wide({n.name: n.value for n in sample.nodes if n.value is not None})
    results = run_graph(sample.graph, feeds, sample.fetches)
    return [results[name] for name in sample.fetches]


@pytest.mark.parametrize("op", [op.name for op in TABLE.values() if op.exact and op.kernel is not None])
def test_an_exact_op_rounds_nothing(op: str) -> None:
    """In float64 the same numbers come out."""
    for sample in (s for s in SAMPLES if s.op == op):
        for narrow, double in zip(computed(sample, in_double=False), computed(sample, in_double=True), strict=True):
            np.testing.assert_array_equal(narrow.astype(np.float64), double.astype(np.float64), sample.title)


@pytest.mark.parametrize("op", [op.name for op in TABLE.values() if not op.exact and op.elementwise])
def test_an_op_that_rounds_rounds(op: str) -> None:
    """In float64 other numbers come out."""
    names = "abc"[: max(len(s.graph["op"].inputs) for s in SAMPLES if s.op == op)]
    operands = np.random.default_rng(0).standard_normal((len(names), 200)).astype(np.float32)
    operands[:, 0] = np.float32([1, 0.1, 0.3])[: len(names)]  # 1 // 0.1 is 10 in float32 alone
    graph = Graph((Node("op", op, tuple(names), defaults(op)),))
    narrow, double = (
        run_graph(graph, {n: row.astype(dtype) for n, row in zip(names, operands, strict=True)}, ["op"])
        for dtype in (np.float32, np.float64)
    )
    assert not np.array_equal(narrow["op"].astype(np.float64), double["op"], equal_nan=True)


@pytest.mark.parametrize("op", [op.name for op in TABLE.values() if op.moves])
def test_what_moves_elements_makes_none(op: str) -> None:
    for sample in (s for s in SAMPLES if s.op == op):
        node = sample.graph["op"]
        moved = list(TABLE[op].data_operands(node.inputs))
        values = run_graph(sample.graph, sample.feeds, [*moved, *sample.fetches])
        elements = np.concatenate([values[r].reshape(-1) for r in moved])
        for name in sample.fetches:
            assert np.isin(values[name], elements).all(), sample.title


@pytest.mark.parametrize("op", [op.name for op in TABLE.values() if op.elementwise])
def test_an_elementwise_op_sees_one_element_at_a_time(op: str) -> None:
    """The operands' elements in another order: the results come in that order."""
    for sample in (s for s in SAMPLES if s.op == op):
        node = sample.graph["op"]
        values = run_graph(sample.graph, sample.feeds, [*node.inputs, "op"])
        result = values["op"].reshape(-1)
        order = np.random.default_rng(0).permutation(result.size)
        feeds = {r: np.broadcast_to(values[r], values["op"].shape).reshape(-1)[order] for r in node.inputs}
        again = run_graph(Graph((node,)), feeds, ["op"])["op"]
        np.testing.assert_array_equal(again, result[order], sample.title)


def test_an_activation_that_is_fused_is_known_to_every_target_that_carries_it() -> None:
    fused = {op.name for op in TABLE.values() if op.tfjs_fuses}
    assert fused == {"Relu", "Relu6", "Elu", "Sigmoid"}  # TensorFlow.js's own list, but for Prelu and LeakyRelu
    for known in (activations.NN_KINDS, activations.LITERT_OPERATORS, activations.LOOPS):
        assert fused <= known.keys()
    assert {name for name, op in activations.LITERT_OPERATORS.items() if op.applied} == {"Relu", "Relu6"}


def test_spellings_are_no_ops_of_their_own() -> None:
    assert not SPELLINGS.keys() & TABLE.keys()
    assert set(SPELLINGS.values()) <= TABLE.keys()


def test_traits_are_known_under_every_spelling() -> None:
    assert traits(Node("n", "AddV2")) is TABLE["Add"]
    assert traits(Node("n", "BatchMatMulV3")).layer == "dense"
    assert is_fed(Node("n", "PlaceholderWithDefault"))
    assert is_fed(Node("n", "PlaceholderV2"))
    assert passes_on(Node("n", "Squeeze")) and not hands_on(Node("n", "Squeeze"))
    assert hands_on(Node("n", "Enter")) and hands_on(Node("n", "StopGradient"))
    assert not traits(Node("n", "NoSuchOp")).exact
