"""Several rows, tried: what they give together is what each gives alone.

A constant that was made for one row (torch's ``arange`` over the batch, an index) cannot be told from any other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from export_model.converters.compiler.passes.normalise import normalise
from export_model.converters.graph.nodes import Graph, Node, TensorShape, ref
from export_model.converters.graph.ops.table import op_of
from export_model.converters.graph.shapes import infer_types, numbers_made, run_kernel
from export_model.converters.graph.size_limits import MAX_COMPUTED
from export_model.converters.graph.types import TensorType
from export_model.signatures.errors import SignatureError

ROWS = 3


def check_rows(graph: Graph, outputs: Sequence[str]) -> None:
    """Raise SignatureError where an output is wrong for more rows than one, or rows share a draw.

    It names the first. What is drawn is the same, row by row, in all runs, so that what is behind it is judged, too.
    """
    graph = normalise(graph.prune(outputs), outputs).prune(outputs)
    types = infer_types(graph)
    axes = {name: _free(kind) for name, kind in types.items()}
    feeds = {n.name: _rows(n.attrs["shape"], n.attrs["dtype"]) for n in graph.nodes if n.op == "Placeholder"}
    draws = _Draws()
    together = _values(graph, feeds, draws.draw_node)
    for row in range(ROWS):
        alone = _values(graph, {name: _row(a, row, axes[name]) for name, a in feeds.items()}, partial(draws.of, row))
        for name in outputs:
            axis = axes[name] or 0
            got = together[name]
            same = got.ndim > axis and got.shape[axis] == ROWS
            same = same and np.allclose(_row(got, row, axis), alone[name], 1e-4, 1e-4)
            if not same:
                raise _one_row_only(f"the output {graph[name].origin or name!r}", row)


def _one_row_only(what: str, row: int) -> SignatureError:
    return SignatureError(
        f"{what} is computed for one row only",
        why="the model says that it takes any number of rows, but a constant inside was made for one: with "
        f"{ROWS} rows, row {row} comes out otherwise than alone",
        fix="export it again with the batch left free everywhere, or name the outputs that you need: "
        "--output action=action",
    )


#: (a sampler, its operands) → what it draws
Draw = Callable[[Node, Sequence[np.ndarray]], np.ndarray]


def _values(graph: Graph, feeds: Mapping[str, np.ndarray], draw: Draw) -> Mapping[str, np.ndarray]:
    """Every tensor of a straight graph, whose samplers draw what ``draw`` says once their operands are known."""
    values = dict(feeds)
    for node in graph.nodes:
        if node.name in feeds:
            continue
        operands = [values[r] for r in node.inputs]
        if node.op == "Const":
            assert node.value is not None
            results: Sequence[np.ndarray] = [node.value]
        elif op_of(node).sampler:
            results = [draw(node, operands)]
        else:
            results = run_kernel(op_of(node), node, operands)
        values.update((ref(node.name, index), result) for index, result in enumerate(results))
    return values


class _Draws:
    """What samplers draw for all rows, and each row's part of it."""

    def __init__(self) -> None:
        self._generator = np.random.Generator(np.random.PCG64(1))
        #: (what a sampler draws, its first operand)
        self._all: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def draw_node(self, node: Node, operands: Sequence[np.ndarray]) -> np.ndarray:
        shape, sampler = _drawn_shape(node, operands), op_of(node).sampler
        if sampler == "categorical":
            drawn = self._generator.integers(0, operands[0].shape[1], shape).astype(node.attrs["output_dtype"])
        elif sampler == "uniform":
            drawn = self._generator.random(shape).astype(node.attrs["dtype"])
        else:
            most = 2.0 if sampler == "truncated normal" else np.inf
            drawn = np.clip(self._generator.normal(size=shape), -most, most).astype(node.attrs["dtype"])
        self._all[node.name] = drawn, operands[0]
        return drawn

    def of(self, row: int, node: Node, operands: Sequence[np.ndarray]) -> np.ndarray:
        """The draws of one row. Raises SignatureError where it has none of its own, or other odds than alone."""
        drawn, operand = self._all[node.name]
        part = _part(drawn, _drawn_shape(node, operands), row)
        if part is None:
            raise SignatureError(
                f"the draw {node.origin or node.name!r} is made for one row only",
                why=f"with {ROWS} rows it is of the shape {list(drawn.shape)}, so that rows share what is drawn",
                fix="export it again with the batch left free everywhere (a shape that is computed from the input's), "
                "or name an output before the draw: --output NODE=action",
            )
        if op_of(node).sampler == "categorical":
            odds = _part(operand, operands[0].shape, row)
            if odds is None or not np.allclose(odds, operands[0], 1e-4, 1e-4):
                raise _one_row_only(f"what {node.origin or node.name!r} draws from", row)
        return part


def _drawn_shape(node: Node, operands: Sequence[np.ndarray]) -> tuple[int, ...]:
    if op_of(node).sampler == "categorical":
        return (len(operands[0]), int(operands[1]))
    return tuple(int(d) for d in operands[0].reshape(-1))


def _part(array: np.ndarray, shape: Sequence[int], row: int) -> np.ndarray | None:
    """A row's part, of ``shape``, of what all rows have: one axis is longer, and has their parts one after another."""
    longer = [i for i, (a, b) in enumerate(zip(array.shape, shape, strict=True)) if a != b]
    if len(longer) != 1 or array.shape[longer[0]] != ROWS * shape[longer[0]]:
        return None
    return np.split(array, ROWS, longer[0])[row]


def too_large(graph: Graph) -> bool:
    """Whether a trial takes more numbers than any policy does: shapes are what a file claims."""
    return numbers_made(normalise(graph), ROWS) > MAX_COMPUTED


def _free(kind: TensorType) -> int | None:
    """The axis of the agents: of a memory [layers, B, n] it is not the first."""
    return next((i for i, d in enumerate(kind.shape or ()) if isinstance(d, str)), None)


def _row(array: np.ndarray, row: int, axis: int | None) -> np.ndarray:
    return array if axis is None else np.take(array, [row], axis)


def _rows(shape: TensorShape, dtype: np.dtype) -> np.ndarray:
    dims = [ROWS if d is None else d for d in shape.dims or ()]
    numbers = np.random.Generator(np.random.PCG64(0)).normal(size=dims)
    return (np.abs(numbers) if dtype.kind in "iub" else numbers).astype(dtype)
