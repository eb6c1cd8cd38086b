"""A graph that decides for one agent as a graph that decides for any number, each row as if it were alone.

Every tensor that depends on an agent's inputs (or on a draw) gets an axis in front, and every op the form that leaves
that axis alone. This is right whatever the ops mean by their own axes, so it serves models that have no batch axis at
all, and those that were exported for one row in a form that is wrong for two.

Precondition: every shape is known. Postcondition: the inputs named have a free first axis, and so has all that is
computed from them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from msgspec.structs import replace

from export_model.converters.compiler.passes.fold import fold
from export_model.converters.compiler.passes.normalise import normalise
from export_model.converters.graph.nodes import Graph, Node, TensorShape, ref
from export_model.converters.graph.ops.batching_rules import Rows, rule_of
from export_model.converters.graph.ops.table import op_of
from export_model.converters.graph.types import BATCH, TensorType


def for_every_row(
    graph: Graph, outputs: Sequence[str], inputs: Mapping[str, int | None], ends: Mapping[str, int] | None = None
) -> Graph:
    """The graph upstream of the nodes ``outputs``, which keep their names.

    ``inputs`` are the placeholders that each agent has its own of, with the axis of length 1 that becomes that of the
    agents; None: they get one in front. ``ends`` has that axis for outputs; one that is not in it has it in front, in
    place of a first axis of length 1 where an input's was one. Raises UnsupportedOpError where an op has no such form,
    or a shape is not known.
    """
    return _Turned(fold(normalise(graph.prune(outputs), outputs)), inputs, ends or {}).run(outputs)


class _Turned(Rows):
    def __init__(self, graph: Graph, inputs: Mapping[str, int | None], ends: Mapping[str, int]) -> None:
        super().__init__(graph)
        self.graph = graph
        self.inputs = inputs
        self.ends = ends

    def run(self, outputs: Sequence[str]) -> Graph:
        results = {name: self.b.names.fresh(f"{name}/row") for name in outputs if name not in self.inputs}
        for node in self.graph.nodes:
            self.b.prefix = node.name
            if node.name in self.inputs:
                self._input(node)
            elif not any(r in self.own for r in node.inputs) and not op_of(node).sampler:
                self.b.append(node.with_inputs(self.at[r] for r in node.inputs))
                self._stand(node, [ref(node.name, i) for i in range(self.b.outputs(node.name))])
            else:  # what is drawn is drawn for each agent
                self._node(node, results.get(node.name))
        for name, inner in results.items():
            if name in self.own:  # else it is the same for all agents, and stands there already
                self._output(name, inner)
        return self.b.graph()

    def _input(self, node: Node) -> None:
        dims, axis = self.shape(node.name), self.inputs[node.name]
        self.own.add(node.name)
        if axis is None:
            self.at[node.name] = self.b.append(_with_shape(node, (None, *dims)))
            return
        given = self.b.append(_with_shape(node, (*dims[:axis], None, *dims[axis + 1 :])))
        if axis:
            known = tuple(BATCH if i == axis else d for i, d in enumerate(dims))
            self.b.types[given] = TensorType(self.b.dtype(given), known)
            given = self.b.transpose(given, [axis, *(i for i in range(len(dims)) if i != axis)])
        self.at[node.name] = self.b.reshape(given, (BATCH, *dims))

    def _output(self, name: str, inner: str) -> None:
        dims = self.shape(name)
        axis = self.ends.get(name, 0)
        leading = name in self.ends or any(a is not None for a in self.inputs.values())
        if leading and len(dims) > axis and dims[axis] == 1:
            inner = self.b.reshape(inner, (BATCH, *dims[:axis], *dims[axis + 1 :]))
            inner = self.b.transpose(inner, [*range(1, axis + 1), 0, *range(axis + 1, len(dims))])
        self.b.append(Node(name, "Identity", (inner,), origin=self.graph[name].origin))

    def _node(self, node: Node, name: str | None) -> None:
        before = len(self.b.nodes)
        made = rule_of(node)(self, node)
        results = [made] if isinstance(made, str) else list(made)
        last = self.b.nodes[-1]
        wish = name or node.name
        fresh = len(self.b.nodes) > before and results[0] == last.name
        if len(results) == 1 and fresh and self.b.outputs(last.name) == 1:
            results = [self.b.rename(last.name, wish, node.origin)]
        elif len(results) == 1 and results[0] != wish:
            results = [self.b.append(Node(wish, "Identity", (results[0],), origin=node.origin))]
        self._stand(node, results)
        self.own.update(ref(node.name, i) for i in range(len(results)))

    def _stand(self, node: Node, results: Sequence[str]) -> None:
        self.at.update((ref(node.name, i), result) for i, result in enumerate(results))


def _with_shape(node: Node, dims: tuple[int | None, ...]) -> Node:
    return replace(node, attrs={**node.attrs, "shape": TensorShape(dims)})
