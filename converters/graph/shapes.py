"""dtype, shape and, where it can be known, value of every tensor of a graph."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import count
from math import inf, prod

import numpy as np

from export_model.converters.graph.nodes import Graph, Node, ref
from export_model.converters.graph.ops.base import MISFIT, Kernel, OpDef, misfit, shape_error
from export_model.converters.graph.ops.table import CONTROL_FLOW, op_of
from export_model.converters.graph.size_limits import Allowance
from export_model.converters.graph.types import FLOAT32, INT32, Dim, Symbols, TensorType, of_array
from export_model.signatures.errors import ExportModelError, GraphError

Types = dict[str, TensorType]

#: Folding may not make a constant of more elements than this out of smaller ones.
_MAX_FOLD = 1 << 20
#: Results of up to so many elements are folded whatever was folded before: shapes and indices are.
_SMALL = 1 << 8
#: ``moves`` of ops whose results mostly are their operand's memory under another shape.
_VIEWS = ("same", "view")
#: No tensor may have more elements than this per row (256 MiB in float32), unless one that the op was given has as
#: many: a Fill, Tile, Pad, Range or OneHot of a few bytes may ask for any amount of memory, thirty Concats of a tensor
#: with itself, too.
MAX_ELEMENTS = 1 << 26


def infer_types(graph: Graph, *, partial: bool = False) -> Types:
    """The type of every output in ``graph``, by reference.

    ``partial`` lets loops through (their outputs have unknown shapes), for the passes that come before the
    unrolling. Otherwise they raise UnsupportedOpError, as unknown ops always do. Raises GraphError where shapes
    contradict each other.
    """
    if partial not in graph.inferences:
        graph.inferences[partial] = _infer(graph, partial)
    return dict(graph.inferences[partial])


def _infer(graph: Graph, partial: bool) -> Types:
    types: Types = {}
    symbols, allowance = Symbols(), Allowance()
    for node in graph.nodes:
        if partial and node.op in CONTROL_FLOW:
            dtype = types[node.inputs[0]].dtype if node.inputs and node.inputs[0] in types else FLOAT32
            dtype = node.attrs.get("element_dtype", dtype)
            if node.op == "TensorArraySizeV3":
                dtype = INT32
            for index in range(2):
                types[ref(node.name, index)] = TensorType(node.attrs.get("dtype", dtype), None)
        else:
            add_types(types, node, symbols, allowance)
    return types


def outputs_of(types: Mapping[str, TensorType], name: str) -> int:
    """How many outputs a node has."""
    return next(i for i in count(1) if ref(name, i) not in types)


def add_types(types: Types, node: Node, symbols: Symbols, allowance: Allowance) -> None:
    """Extend ``types`` by the outputs of a node whose inputs are in it; raises as ``infer_types`` does.

    Most passes leave most nodes as they are, but for their names: those are inferred once, unless new symbols come of
    them, which must be the graph's own. What they fold is counted every time.
    """
    args = _arguments(node, types)
    if node.inference is not None:
        before, results, folded = node.inference
        if not ((args == before or _are_same(args, before)) and allowance.take(folded)):
            results = _inferred_anew(node, args, symbols, allowance)
    else:
        results = _inferred_anew(node, args, symbols, allowance)
    if results:
        types[node.name] = results[0]
    for index in range(1, len(results)):
        types[ref(node.name, index)] = results[index]


def _inferred_anew(
    node: Node, args: Sequence[TensorType], symbols: Symbols, allowance: Allowance
) -> Sequence[TensorType]:
    made = symbols.count
    results = _results(op_of(node), node, args, symbols, allowance)
    if symbols.count == made and allowance.left >= 0:
        node.keep_inference((args, results, _folded_elements(node, args, results)))
    return results


def _are_same(now: Sequence[TensorType], before: Sequence[TensorType]) -> bool:
    return len(now) == len(before) and all(
        a.dtype == b.dtype and a.shape == b.shape and a.value is b.value for a, b in zip(now, before, strict=True)
    )


def _folded_elements(node: Node, args: Sequence[TensorType], results: Sequence[TensorType]) -> int:
    """Elements of new memory that the values of results take; one for a view, so that it has its end, too."""
    values = [r.value for r in results if r.value is not None and r.value.size > _SMALL]
    if not values or not args:
        return 0
    operand = args[0].value
    if op_of(node).moves in _VIEWS and operand is not None and all(np.may_share_memory(v, operand) for v in values):
        return 1
    return sum(v.size for v in values)


def _arguments(node: Node, types: Mapping[str, TensorType]) -> list[TensorType]:
    try:
        return [types[r] for r in node.inputs]
    except KeyError as error:
        raise GraphError(
            f"node {node.name!r} ({node.op}) reads {error.args[0]!r}, an output that its producer does not have",
            why="the graph is damaged or was edited",
            fix="freeze the graph again from its checkpoint",
        ) from error


def _results(
    op: OpDef, node: Node, args: Sequence[TensorType], symbols: Symbols, allowance: Allowance
) -> Sequence[TensorType]:
    if op.kernel is not None:
        least, most = _inputs_of(op.kernel)
        if not least <= len(args) <= most:
            raise shape_error(node, args, f"it takes {most if len(args) > most else least:.0f} inputs")
    try:
        results = op.infer(node, args, symbols)
    except ExportModelError:
        raise
    except MISFIT as error:
        raise misfit(node, error) from error
    _check_size(node, args, results)
    known = [a.value for a in args if a.value is not None]
    if op.kernel is None or not op.foldable or results[0].value is not None or not args or len(known) < len(args):
        return results
    if not _may_fold(op, results, allowance):
        return results
    if all(v.dtype != object for v in known):
        folded: Sequence[TensorType] = [of_array(v) for v in run_kernel(op, node, known)]
    else:
        folded = _symbolic(op, node, args, known, results, symbols)
    return folded if allowance.take(_folded_elements(node, args, folded)) else results


def _may_fold(op: OpDef, results: Sequence[TensorType], allowance: Allowance) -> bool:
    """Whether results are small enough to be computed here; their elements are counted where they are large."""
    sizes = [elements_of(r) for r in results]
    large = sum(size for size in sizes if size > _SMALL)
    least = min(large, 1) if op.moves in _VIEWS else large
    return max(sizes, default=0) <= _MAX_FOLD and (least <= allowance.left or allowance.take(least))


@cache
def _inputs_of(kernel: Kernel) -> tuple[int, float]:
    """(at least, at most) how many tensors a kernel takes: an infer rule does not ask for all of them."""
    given = list(inspect.signature(kernel).parameters.values())[1:]
    named = [p for p in given if p.kind is not p.VAR_POSITIONAL]
    return sum(p.default is p.empty for p in named), len(named) if len(named) == len(given) else inf


def elements_of(kind: TensorType) -> int:
    """Elements of a tensor; an axis that is free counts as one."""
    count = 1
    for length in kind.shape or ():
        if isinstance(length, int):
            count *= abs(length)
    return count


def numbers_made(graph: Graph, rows: int) -> int:
    """How many numbers the kernels make of a straight graph for so many rows.

    These are all results, and the windows that a convolution looks at. A free axis counts as ``rows``: who computes
    what a file declares asks this first.
    """
    types, total = infer_types(graph), 0
    for node in graph.nodes:
        outputs = outputs_of(types, node.name)
        sizes = [_length(types[ref(node.name, index)].shape, rows) for index in range(outputs)]
        total += sum(sizes)
        if op_of(node).layer == "convolution" and len(node.inputs) > 1:
            kernel, channels = types[node.inputs[1]], (types[node.name].shape or (1,))[-1]
            total += sizes[0] * elements_of(kernel) // max(1, channels if isinstance(channels, int) else 1)
    return total


def _length(shape: tuple[Dim, ...] | None, rows: int) -> int:
    return prod(abs(d) if isinstance(d, int) else rows for d in shape or ())


def _check_size(node: Node, args: Sequence[TensorType], results: Sequence[TensorType]) -> None:
    """Raise GraphError where a result is larger than any policy's, before anything of that size is allocated."""
    largest = max(map(elements_of, results), default=0)
    if largest <= MAX_ELEMENTS:
        return
    if node.op == "Placeholder" or largest > max(map(elements_of, args), default=0):
        raise GraphError(
            f"node {node.name!r} ({node.op}) makes a tensor of {largest} elements",
            why=f"no policy has one of more than {MAX_ELEMENTS} per row",
            fix="the graph is damaged, or not a policy; freeze it again from its checkpoint",
        )


def run_kernel(op: OpDef, node: Node, arrays: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
    """The outputs of a node's kernel, without numpy's warnings: infinities and NaNs are numbers to a model.

    Raises GraphError that names the node.
    """
    with np.errstate(all="ignore"):
        return run_kernel_as_it_is(op, node, arrays)


def run_kernel_as_it_is(op: OpDef, node: Node, arrays: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
    """As ``run_kernel``, for who has silenced numpy's warnings for many."""
    assert op.kernel is not None
    try:
        result = op.kernel(node, *arrays)
    except MISFIT as error:
        raise GraphError(
            f"node {node.name!r} ({node.op}) cannot be computed",
            why=f"{type(error).__name__}: {error}",
            fix="the inputs do not have the shapes that the graph asks for, or the graph is damaged",
        ) from error
    return result if isinstance(result, tuple) else (result,)


def _symbolic(
    op: OpDef,
    node: Node,
    args: Sequence[TensorType],
    values: Sequence[np.ndarray],
    results: Sequence[TensorType],
    symbols: Symbols,
) -> Sequence[TensorType]:
    """Follow shape vectors that hold symbols through the ops that shape arithmetic is made of."""
    if op.moves:
        positions = set(op.data_operands(range(len(values))))
        if any(v.dtype == object for i, v in enumerate(values) if i not in positions):
            return results
        objects = [v.astype(object) if i in positions else v for i, v in enumerate(values)]
        outputs = run_kernel(op, node, objects)
        return [
            TensorType(
                args[min(positions)].dtype, tuple(int(d) for d in v.shape), _plain(v, args[min(positions)].dtype)
            )
            for v in (np.asarray(o, dtype=object) for o in outputs)
        ]
    kind = results[0]
    if len(results) > 1 or kind.shape is None or not all(isinstance(d, int) for d in kind.shape):
        return results  # how much it makes depends on the symbols
    found = _probe(op, node, values) if elements_of(kind) <= _SMALL else None
    if found is None:
        return results
    for cell in np.ndindex(found.shape):
        if found[cell] is None and op.name != "Mul" and op.name != "Prod":  # not a list: the op table alone has those
            return results
        if found[cell] is None:
            found[cell] = symbols.fresh()  # a length, whatever it is
    return [TensorType(kind.dtype, tuple(int(d) for d in found.shape), _plain(found, kind.dtype))]


#: Lengths that symbols are tried with: what is the same for all of them is a number, what is always one of them is that
#: symbol. They are below and above every constant that a shape is compared with.
_PROBES = (1, 2, 3, 5, 7, 11, (1 << 29) + 11)


def _probe(op: OpDef, node: Node, values: Sequence[np.ndarray]) -> np.ndarray | None:
    """Arithmetic on lengths, cell by cell: a number, a symbol, or None where it is neither; None for no array at all.

    A shape is computed by small steps (products, quotients, maxima with 0, broadcasting), each of which is looked at.
    """
    names = sorted({c for v in values if v.dtype == object for c in v.reshape(-1).tolist() if isinstance(c, str)})
    tried: list[tuple[dict[str, int], np.ndarray]] = []
    for number, probe in enumerate(_PROBES):
        # each symbol goes through the lengths in an order of its own
        lengths = {n: probe if not i else _PROBES[(number * (i + 1) + i) % len(_PROBES)] for i, n in enumerate(names)}
        arrays = [
            np.array([lengths.get(c, c) for c in v.reshape(-1).tolist()], np.int64).reshape(v.shape)
            if v.dtype == object
            else v
            for v in values
        ]
        tried.append((lengths, np.asarray(run_kernel(op, node, arrays)[0])))
    shape = tried[0][1].shape
    if any(result.shape != shape for _, result in tried):
        return None
    found = np.empty(shape, object)
    for cell in np.ndindex(shape):
        results = [(lengths, result.item(*cell)) for lengths, result in tried]
        if all(r == results[0][1] for _, r in results):
            found[cell] = results[0][1]
        else:
            found[cell] = next((n for n in names if all(r == lengths[n] for lengths, r in results)), None)
    return found


def _plain(cells: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """An object array as a plain one if no symbol is left in it."""
    if all(not isinstance(c, str) for c in cells.reshape(-1).tolist()):
        return cells.astype(dtype)
    return cells
