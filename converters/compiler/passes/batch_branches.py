"""Batches identical per-branch ops into one op on the concatenation.

A discrete policy treats each of its branches alike: scores, a softmax, masks, a division by the sum, a logarithm; then
puts them side by side. In runtimes in which the start of an op is most of its cost, ops on all branches at once cost a
branch's. What reads one branch alone gets its columns. The last step before an action stays a branch's own: by it
whoever reads the graph tells what the branches are (``converters/policy/action.py``).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence

import numpy as np

from export_model.converters.compiler.passes.slice_of_concat import slice_of_columns
from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node, node_of, ref, split_ref
from export_model.converters.graph.ops.slicing import strided_steps
from export_model.converters.graph.ops.table import op_of
from export_model.converters.graph.shapes import Types, infer_types
from export_model.converters.graph.types import FLOAT32

#: Columns of all parts together, for sums of parts: they are a product with as many rows.
_MOST_SUMMED = 64
#: Ops between a sum and what is known to be finite.
_FURTHEST = 8
#: Ops on top of one another that are joined; concatenations that are tried.
_DEEPEST, _MOST_TRIED = 40, 64
#: Classes of all one hots together.
_MOST_HOT = 1 << 10
#: Elements of the weights that are copied into one matrix.
_MOST_WEIGHTS = 1 << 16


def join_branches(graph: Graph, roots: Iterable[str], actions: Collection[str]) -> Graph:
    """The graph with what its concatenations' parts have in common done once, where that makes it smaller.

    ``actions`` are those of ``roots`` that are joined of branches.
    """
    outputs = frozenset(node_of(r) for r in roots)
    tried, depths = 0, _depths(graph)
    for name in [n.name for n in reversed(graph.nodes) if n.op == "ConcatV2" and len(n.inputs) > 2]:
        # An earlier one may have swallowed it; a policy has a handful.
        if name not in graph or tried == _MOST_TRIED or not _is_alike(graph, graph[name], depths):
            continue
        tried += 1
        made = _Joining(graph, outputs, depths).joined_graph(graph[name], name in actions)
        if made is not None and _size(made) < _size(graph):
            graph, depths = made, _depths(made)
    return _flat(graph, outputs)


def _is_alike(graph: Graph, root: Node, depths: Mapping[str, int]) -> bool:
    """Whether the parts of a concatenation may have anything in common."""
    nodes = [graph.producer(r) for r in root.inputs[:-1]]
    same = {n.op for n in nodes} == {nodes[0].op}
    return same and (nodes[0].op == "StridedSlice" or len({depths[n.name] for n in nodes}) == 1)


def _size(graph: Graph) -> int:
    return sum(1 for n in graph.nodes if n.op != "Const")


def _flat(graph: Graph, outputs: frozenset[str]) -> Graph:
    """Concatenations of concatenations as one."""
    readers = graph.consumers()
    editor = Editor(graph)
    parts: dict[str, tuple[str, ...]] = {}
    for node in graph.nodes:
        if node.op == "ConcatV2":
            axis = graph.constant(node.inputs[-1])
            inner = {
                r: parts[r]
                for r in node.inputs[:-1]
                if r in parts and r not in outputs and len(readers[r]) == 1
                if axis is not None and axis == graph.constant(graph[r].inputs[-1])
            }
            parts[node.name] = tuple(p for r in node.inputs[:-1] for p in inner.get(r, (r,)))
            if inner:
                node = node.with_inputs((*parts[node.name], node.inputs[-1]))
        editor.keep(node)
    return editor.prune(outputs)


class _Joining:
    """One concatenation along the last axis, and what it is made of."""

    def __init__(self, graph: Graph, outputs: frozenset[str], depths: Mapping[str, int]) -> None:
        self.graph, self.outputs = graph, outputs
        self.types: Types = infer_types(graph)
        self.editor = Editor(graph)
        self.depths, self.level = depths, 0
        #: parts that are computed together → the tensor in which they lie side by side
        self.groups: dict[tuple[str, ...], str] = {}
        #: parts that are put side by side, sums that are a product → the same
        self.made_of: dict[tuple[str, ...], str] = {}
        #: parts that have nothing in common
        self.apart: set[tuple[str, ...]] = set()

    def joined_graph(self, root: Node, action: bool) -> Graph | None:
        """The graph, if there is anything to join."""
        parts, kind = root.inputs[:-1], self.types[root.name]
        axis = self.graph.constant(root.inputs[-1])
        if kind.dtype != FLOAT32 or kind.shape is None or len(kind.shape) != 2 or axis is None or int(axis) % 2 != 1:
            return None
        if len(set(parts)) < len(parts) or any(self._width(r) is None for r in parts):
            return None
        if not (self._before(parts) if action else self._instead(root, parts)):
            return None
        for node in self.graph.nodes:
            if action or node.name != root.name:
                self.editor.keep(node)
        swallowed = {node_of(r) for group in (*self.groups, *self.made_of) for r in group}
        swallowed |= set() if action else {root.name}
        readers = self.graph.consumers()
        for group, value in list(self.groups.items()):
            self._hand_out(group, value, [r for part in group for r in readers[node_of(part)]], swallowed)
        return self.editor.prune(self.outputs)

    def _instead(self, root: Node, parts: tuple[str, ...]) -> bool:
        """Whether another tensor takes the place of the concatenation."""
        whole = self._together(parts)
        if whole is None or (root.name in self.outputs and whole in self.graph):
            return False
        if root.name in self.outputs:
            self.groups[parts] = self.editor.rename(whole, root.name, root.origin)
        else:
            self.editor.redirect(root.name, whole)
        return True

    def _before(self, parts: tuple[str, ...]) -> bool:
        """Whether what the parts are made of, each by one op, is one tensor."""
        nodes = [self.graph.producer(r) for r in parts]
        if any(n.op != nodes[0].op or len(n.inputs) != 1 for n in nodes):
            return False
        given = tuple(n.inputs[0] for n in nodes)
        if [self.types[r].shape for r in given] != [self.types[p].shape for p in parts]:
            return False
        return self._together(given) is not None

    def _hand_out(
        self, group: tuple[str, ...], value: str, readers: Sequence[Node], swallowed: Collection[str]
    ) -> None:
        """Let what reads one part of a group read a piece of the whole."""
        if all(reader.name in swallowed for reader in readers):
            return
        # Grappler (TensorFlow 2.21) pulls ops of one operand out of a SplitV, and then finds another ArgMax.
        alone = any(op_of(reader).elementwise and len(reader.inputs) == 1 for reader in readers)
        widths = [self._width(r) or 0 for r in group]
        if not alone:
            sizes = self.editor.ints(widths, f"{value}/sizes")
            axis = self.editor.ints(1, f"{value}/axis")
            pieces = self.editor.add("SplitV", [value, sizes, axis], f"{value}/parts", num_split=len(group))
        first = 0
        for index, (part, width) in enumerate(zip(group, widths, strict=True)):
            self.editor.redirect(part, self._columns(value, first, first + width) if alone else ref(pieces, index))
            first += width

    def _columns(self, value: str, first: int, last: int) -> str:
        bounds = [self.editor.ints(b, f"{value}/bound") for b in ((0, first), (0, last), (1, 1))]
        return self.editor.add("StridedSlice", [value, *bounds], f"{value}/part", begin_mask=1, end_mask=1)

    def _width(self, reference: str) -> int | None:
        shape = self.types[reference].shape
        return shape[1] if shape is not None and len(shape) == 2 and isinstance(shape[1], int) else None

    # ------------------------------------------------------------------ groups

    def _join(self, parts: tuple[str, ...]) -> tuple[str, bool]:
        """A tensor in which the parts lie side by side, and whether it took no ConcatV2 of them."""
        whole = self._together(parts)
        if whole is not None:
            return whole, True
        if parts not in self.made_of:
            axis = self.editor.ints(1, f"{node_of(parts[0])}/axis")
            self.made_of[parts] = self.editor.add("ConcatV2", [*parts, axis], f"{node_of(parts[0])}/joined")
        return self.made_of[parts], False

    def _together(self, parts: tuple[str, ...]) -> str | None:
        """The same without a ConcatV2; None where the parts have nothing in common."""
        if parts in self.groups or parts in self.apart or self.level == _DEEPEST:
            return self.groups.get(parts)
        self.level += 1
        made = self._batched_op(parts)
        self.level -= 1
        if made is None:
            self.apart.add(parts)
        return made

    def _batched_op(self, parts: tuple[str, ...]) -> str | None:
        whole = self._cut_from(parts)
        if whole is not None:
            return whole
        nodes = [self.graph.producer(r) for r in parts]
        first = nodes[0]
        if any(n.op != first.op or n.attrs != first.attrs or len(n.inputs) != len(first.inputs) for n in nodes):
            return None
        if any(n.name in self.outputs for n in nodes):
            return None
        # What is as deep in the graph as another does not depend on it, nor does what is made of both on either.
        if len({self.depths[n.name] for n in nodes}) > 1 or any(split_ref(r)[1] for r in parts):
            return None
        made = self._one_hot(nodes) or self._product(nodes) or self._elementwise(parts, nodes)
        if made is not None:
            self.groups[parts] = made
        return made

    def _cut_from(self, parts: Sequence[str]) -> str | None:
        """The tensor that the parts are all of, in their order."""
        position, source = 0, ""
        for part in parts:
            found = slice_of_columns(self.graph, self.types, self.graph.producer(part))
            if found is None or found[1] != position or source not in ("", found[0]):
                return None
            source, _, position = found
        return source if self._width(source) == position else None

    def _product(self, nodes: Sequence[Node]) -> str | None:
        """Products of one tensor with constants as one product; their biases side by side."""
        first = nodes[0]
        if first.attrs.get("transpose_a") or first.attrs.get("transpose_b"):
            return None
        if first.op == "BiasAdd":
            products = tuple(n.inputs[0] for n in nodes)
            value = self._together(products) if self.graph.producer(products[0]).op == "MatMul" else None
        elif first.op == "MatMul":
            value = first.inputs[0] if len({n.inputs[0] for n in nodes}) == 1 else None
        else:
            return None
        known = [c for n in nodes if (c := self.graph.constant(n.inputs[1])) is not None]
        if value is None or len(known) < len(nodes) or sum(c.size for c in known) > _MOST_WEIGHTS:
            return None
        weights = self.editor.const(np.concatenate(known, axis=-1), f"{first.name}/weights")
        return self.editor.add(first.op, [value, weights], f"{first.name}/joined", **first.attrs)

    def _elementwise(self, parts: Sequence[str], nodes: Sequence[Node]) -> str | None:
        first = nodes[0]
        entry = op_of(first)
        if not entry.elementwise or self.types[first.name].dtype != FLOAT32:
            return None
        columns = [[n.inputs[position] for n in nodes] for position in range(len(first.inputs))]
        shapes = [self.types[p].shape for p in parts]
        if not any([self.types[r].shape for r in given] == shapes for given in columns):
            return None  # a column that constants spread
        operands = []
        for given in columns:
            found = self._operand(parts, given, bool(entry.activation))
            if found is None:
                return None
            operands.append(found)
        return self.editor.add(first.op, operands, f"{first.name}/joined", **first.attrs)

    def _operand(self, parts: Sequence[str], given: Sequence[str], activation: bool) -> str | None:
        """One operand of the joined node, for all parts together; None where it cannot be joined.

        An activation is not taken from products that stay apart: runtimes have the two in one.
        """
        kinds = [self.types[r] for r in given]
        if any(k.shape is None or k.dtype != FLOAT32 for k in kinds):
            return None
        if all(k.constant is not None for k in kinds):
            return self._constants(parts, given)
        if [k.shape for k in kinds] == [self.types[p].shape for p in parts]:
            value, free = self._join(tuple(given))
            return value if free or not activation else None
        if len(set(given)) == 1 and kinds[0].shape is not None and kinds[0].shape[-1:] in ((), (1,)):
            return given[0]
        return self._sums(parts, given)

    def _constants(self, parts: Sequence[str], given: Sequence[str]) -> str | None:
        values = [self.graph.constant(r) for r in given]
        rows = []
        for value, part in zip(values, parts, strict=True):
            if value is None or value.ndim > 2 or (value.ndim == 2 and value.shape[0] != 1):
                return None
            rows.append(np.broadcast_to(value.reshape(-1), [self._width(part) or 0]))
        row = np.concatenate(rows)
        same = bool(row.size and (row == row[0]).all())
        return self.editor.const(row[0] if same else row, f"{node_of(given[0])}/joined")

    def _sums(self, parts: Sequence[str], given: Sequence[str]) -> str | None:
        """Sums over each part's columns, repeated for each column, as a product with ones and zeros."""
        nodes = [self.graph.producer(r) for r in given]
        widths = [self._width(p) or 0 for p in parts]
        if sum(widths) > _MOST_SUMMED or len({self.depths[n.name] for n in nodes}) > 1:
            return None
        for node, part in zip(nodes, parts, strict=True):
            axes = self.graph.constant(node.inputs[1]) if node.op == "Sum" else None
            if axes is None or not node.attrs["keep_dims"] or [int(a) % 2 for a in axes.reshape(-1)] != [1]:
                return None
            # A zero times what is no number is none either, and would spread to the other parts.
            if self.types[node.inputs[0]].shape != self.types[part].shape or not self._is_number(node.inputs[0]):
                return None
        summed, _ = self._join(tuple(n.inputs[0] for n in nodes))
        part_of = np.repeat(np.arange(len(widths)), widths)
        ones = self.editor.const((part_of[:, None] == part_of).astype(FLOAT32), f"{nodes[0].name}/ones")
        product = self.editor.add("MatMul", [summed, ones], f"{nodes[0].name}/joined")
        self.made_of[tuple(given)] = product
        return product

    def _is_number(self, reference: str, depth: int = 0) -> bool:
        """Whether a tensor cannot become infinite, as long as what is fed and the weights' products are finite."""
        node = self.graph.producer(reference)
        entry = op_of(node)
        if node.value is not None:
            return bool(np.isfinite(node.value).all())
        if entry.finite == "always" or entry.start == "fed":
            return True
        if depth == _FURTHEST or not (entry.moves or entry.finite):
            return False
        return all(
            self._is_number(r, depth + 1) for r in (entry.data_operands(node.inputs) if entry.moves else node.inputs)
        )

    def _one_hot(self, nodes: Sequence[Node]) -> str | None:
        """Columns of one tensor of whole numbers, each one hot: those columns, repeated, compared with the numbers."""
        columns: list[int] = []
        classes: list[int] = []
        sources = set()
        for node in nodes:
            found = self._hot(node)
            if found is None or node.name in self.outputs:
                return None
            source, column, depth = found
            if len(classes) + depth > _MOST_HOT:
                return None
            sources.add(source)
            columns += [column] * depth
            classes += range(depth)
        if len(sources) > 1 or len({self.depths[n.name] for n in nodes}) > 1:
            return None
        (source,) = sources
        if max(classes, default=0) > np.iinfo(self.types[source].dtype).max:
            return None
        editor, name = self.editor, nodes[0].name
        axis = editor.ints(1, f"{name}/axis")
        indices = editor.ints(columns, f"{name}/columns")
        taken = editor.add("GatherV2", [source, indices, axis], f"{name}/taken")
        numbers = editor.const(np.array(classes, self.types[source].dtype), f"{name}/classes")
        equal = editor.add("Equal", [taken, numbers], f"{name}/equal")
        return editor.add("Cast", [equal], f"{name}/joined", DstT=FLOAT32)

    def _hot(self, node: Node) -> tuple[str, int, int] | None:
        """(tensor, column, classes) of a OneHot of a column."""
        if node.op != "OneHot" or int(node.attrs["axis"]) not in (-1, 1) or self.types[node.name].dtype != FLOAT32:
            return None
        depth, on, off = (self.graph.constant(r) for r in node.inputs[1:])
        column = self.graph.producer(node.inputs[0])
        shape = self.types[column.inputs[0]].shape if column.op == "StridedSlice" else None
        if depth is None or on is None or off is None or on != 1 or off != 0 or shape is None or len(shape) != 2:
            return None
        bounds = [self.graph.constant(r) for r in column.inputs[1:]]
        if any(b is None for b in bounds):
            return None
        steps = strided_steps(column, 2, *(b.tolist() for b in bounds if b is not None))
        whole = (("slice", None, None, 1), ("slice", 0, None, 1))
        if len(steps) != 2 or steps[0] not in whole or steps[1][0] != "take" or not isinstance(shape[1], int):
            return None
        return column.inputs[0], int(steps[1][1]) % shape[1], int(depth)


def _depths(graph: Graph) -> Mapping[str, int]:
    """Node → how many nodes stand before it, at most."""
    depths: dict[str, int] = {}
    for node in graph.nodes:
        depths[node.name] = 0 if node.op == "Const" else 1 + max((depths[node_of(r)] for r in node.inputs), default=0)
    return depths
