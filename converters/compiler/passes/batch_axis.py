"""A graph whose inputs all have a fixed number of rows, or none, as one that takes any number.

Two readings are tried: the first axes of the inputs, which are equally long, are the agents' and are left free, if rows
do not change one another then (``vmap_trial.py``); or the graph decides for one agent, and is computed for each
(``vmap.py``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from msgspec.structs import replace

from export_model.converters.compiler.passes.normalise import normalise
from export_model.converters.compiler.passes.vmap import for_every_row
from export_model.converters.compiler.passes.vmap_trial import check_rows, too_large
from export_model.converters.graph.nodes import Graph, TensorShape, topological
from export_model.converters.graph.ops.table import is_fed
from export_model.converters.graph.shapes import infer_types
from export_model.signatures.errors import ExportModelError

Dims = tuple[int, ...]


def without_agents(graph: Graph) -> bool:
    """Whether all inputs have lengths, and none is free."""
    fed = [n.dims for n in graph.nodes if is_fed(n)]
    return any(fed) and all(dims is not None and None not in dims for dims in fed)


def for_any_number(graph: Graph, outputs: Sequence[str]) -> tuple[Graph, int] | None:
    """(the graph, how many rows the one given takes); None where a length is free already, or it cannot be told.

    ``outputs`` are nodes, and keep their names; of what they do not need constants are left.
    """
    upstream = graph.prune(outputs)
    fed = {n.name: n.dims for n in upstream.nodes if is_fed(n)}
    if not fed or any(not dims or None in dims for dims in fed.values()):
        return None
    inputs = {name: tuple(d for d in dims or () if d is not None) for name, dims in fed.items()}
    try:
        if too_large(upstream):
            return None
        found = _free_first_axis(upstream, outputs, inputs) or _vectorise(upstream, outputs, inputs)
    except ExportModelError:
        return None
    if found is None:
        return None
    made, rows = found
    # constants beside the outputs say what a trainer knew of the policy
    constants = (n for n in graph.nodes if not n.inputs and n.name not in upstream and n.name not in made)
    return Graph(topological([*made.nodes, *constants])), rows


def _free_first_axis(graph: Graph, outputs: Sequence[str], inputs: Mapping[str, Dims]) -> tuple[Graph, int] | None:
    """The first axes left free, where these are the agents'."""
    rows = {dims[0] for dims in inputs.values()}
    if len(rows) != 1 or all(len(dims) == 1 for dims in inputs.values()):
        return None
    free = {name: TensorShape((None, *dims[1:])) for name, dims in inputs.items()}
    nodes = (replace(n, attrs={**n.attrs, "shape": free[n.name]}) if n.name in free else n for n in graph.nodes)
    try:
        made = normalise(Graph(tuple(nodes)), outputs)
        types = infer_types(made)
        if not all((shape := types[o].shape) and isinstance(shape[0], str) for o in outputs):
            return None
        check_rows(made, outputs)
    except ExportModelError:
        return None
    return made, rows.pop()


def _vectorise(graph: Graph, outputs: Sequence[str], inputs: Mapping[str, Dims]) -> tuple[Graph, int] | None:
    """Computed for each agent; a first axis of 1 is the agents'. Raises UnsupportedOpError where it cannot be."""
    types = infer_types(normalise(graph, outputs))
    first = {(types[o].shape or (None,))[0] for o in outputs}
    rows = {dims[0] for dims in inputs.values() if len(dims) > 1}
    if len(rows) == 1 and rows == first != {1}:
        return None  # several agents, which change one another
    ends = {o: 0 for o in outputs if len(shape := types[o].shape or ()) > 1 and shape[0] == 1}
    agents = {name: 0 if rows == {1} and dims[:1] == (1,) else None for name, dims in inputs.items()}
    return for_every_row(graph, outputs, agents, ends), 1
