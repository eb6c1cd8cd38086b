"""Samplers: those of N(0, 1) become an input, a zero, or stay; none keeps the seed of a trainer's run.

Lifted, the policy is a pure function of its inputs: TFJS has no RandomStandardNormal (tfjs #4156), and a run can be
repeated in any runtime by feeding the same draws.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np
from msgspec.structs import replace

from export_model.converters.compiler.compilation import Compilation
from export_model.converters.compiler.options import NoiseMode
from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.ops.table import is_fed, op_of, traits
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.size_limits import MAX_MADE, Allowance
from export_model.converters.graph.types import BATCH, FLOAT32, Dim, static_shape
from export_model.signatures.errors import UnsupportedOpError
from export_model.signatures.roles import Role


def samplers(graph: Graph) -> list[Node]:
    """The nodes that draw from N(0, 1), in graph order."""
    return [n for n in graph.nodes if traits(n).sampler == "normal"]


def clear_seeds(graph: Graph) -> Graph:
    """Samplers without the seed that the trainer's run had.

    With it, a game draws the same actions after every start, and TensorFlow.js, which starts its generator anew for
    every run, the same one each time.
    """
    if not any(traits(n).sampler for n in graph.nodes):
        return graph
    nodes = [replace(n, attrs={**n.attrs, "seed": 0, "seed2": 0}) if traits(n).sampler else n for n in graph.nodes]
    return Graph(tuple(nodes))


def has_seeds(graph: Graph) -> bool:
    """Whether a sampler has the seed of a trainer's run: it draws alike after every start."""
    return any(traits(n).sampler and (n.attrs.get("seed") or n.attrs.get("seed2")) for n in graph.nodes)


def settle_noise(c: Compilation) -> Compilation:
    """Noise as the options say, and a note of what it was."""
    drawn = [n.name for n in samplers(c.graph)]
    taken = [n for n, r in c.roles.items() if r is Role.NOISE and n in c.graph]
    if not drawn and not taken:
        return c
    types = infer_types(c.graph)
    for name in drawn:
        _check_rows(c.graph[name], types[name].shape or ())
    draws, fed = ({n: static_shape(types[n].shape) or () for n in names} for names in (drawn, taken))
    graph = lift_noise(c.graph, "zero" if c.options.deterministic else c.options.noise or "lift", fed)
    turned = {n.name: n.attrs["shape"].dims for n in graph.nodes if is_fed(n) and n.name not in c.graph}
    noise = {tensor_of(c.graph[name]): dims for name, dims in (draws | fed).items()}
    return replace(c, graph=graph, draws={**draws, **turned}, fed=fed, noise=noise)


def tensor_of(node: Node) -> str:
    """The source's name for what a placeholder or a sampler gives."""
    return node.origin if isinstance(node.origin, str) else f"{node.name}:0"


def settle_single_draws(c: Compilation) -> Compilation:
    """A draw from a single class is always class 0: an ArgMax says so (TensorFlow.js refuses to draw from one)."""
    pairs = [pair for meaning in c.meanings.values() for pair in zip(meaning.samplers, meaning.branches, strict=False)]
    if not pairs:
        return c
    types = infer_types(c.graph)
    single = {sampler for sampler, branch in pairs if (types[branch].shape or (None,))[-1] == 1}
    if not single:
        return c
    editor = Editor(c.graph)
    for node in c.graph.nodes:
        if node.name not in single:
            editor.keep(node)
            continue
        editor.prefix = node.name
        best = editor.argmax(node.inputs[0], 1, "only", node.attrs["output_dtype"])
        editor.redirect(node.name, editor.reshape(best, (-1, 1), "column", node.origin))
    fetches = {out: editor.resolve(reference) for out, reference in c.fetches.items()}
    return replace(c, graph=editor.graph(), fetches=fetches)


def lift_noise(graph: Graph, mode: NoiseMode, inputs: Collection[str] = ()) -> Graph:
    """Placeholders (``lift``) or zeros (``zero``) in place of the samplers, under their names; ``keep`` leaves them.

    ``inputs`` are placeholders that take noise already (0.1-0.2, 0.6-0.14): ``zero`` removes them too. Draws whose axis
    of agents is not the first become an input [B, n] that is turned (``laid_out``).
    """
    fed = frozenset(inputs) if mode == "zero" else frozenset()
    if mode == "keep" or not (samplers(graph) or any(n.name in fed for n in graph.nodes)):
        return graph
    types = infer_types(graph)
    editor, allowance = Editor(graph), Allowance()
    for node in graph.nodes:
        if traits(node).sampler != "normal" and node.name not in fed:
            editor.keep(node)
            continue
        shape = types[node.name].shape
        if shape is None:
            raise UnsupportedOpError(
                f"cannot make an input of the noise of {node.name!r}: its shape is not known before the graph runs",
                issues=[(node.name, node.op)],
                why="an input needs a number of axes",
                fix="use --noise keep or --noise zero",
            )
        dims = static_shape(shape)
        assert dims is not None
        if mode == "zero":
            # One row of zeros broadcasts over the batch.
            zeros = _zeros(node, dims, allowance)
            editor.nodes.append(Node(node.name, "Const", value=zeros, origin=node.origin))
        elif _leads(dims):
            attrs = {"dtype": FLOAT32, "shape": TensorShape(dims)}
            editor.nodes.append(Node(node.name, "Placeholder", attrs=attrs, origin=node.origin))
        else:
            _move_batch_first(editor, node, dims)
    return editor.graph()


def _check_rows(node: Node, shape: Sequence[Dim]) -> None:
    """Raise UnsupportedOpError unless a draw has a number of elements for each agent."""
    free = [d for d in shape if isinstance(d, str)]
    if free and free != [BATCH]:
        raise UnsupportedOpError(
            f"how many numbers {node.name!r} ({node.op}) draws for each agent is not known",
            issues=[(node.name, node.op)],
            why=f"its shape is [{', '.join('?' if isinstance(d, str) else str(d) for d in shape)}]",
            fix="name a tensor before the draw, such as the mean: --output NODE=action",
        )


def _leads(dims: Sequence[int | None]) -> bool:
    """Whether the axis of agents is the first, or there is none."""
    return None not in dims or dims[0] is None


def laid_out(rows: np.ndarray, dims: Sequence[int | None]) -> np.ndarray:
    """Noise [B, n] in the layout ``dims`` of a sampler, where its axis of agents (None) is not the first."""
    if _leads(dims):
        return rows
    axis = list(dims).index(None)
    return np.moveaxis(rows.reshape(len(rows), *(d for d in dims if d is not None)), 0, axis)


def _move_batch_first(editor: Editor, node: Node, dims: Sequence[int | None]) -> None:
    """An input [B, n] under a name of its own, and what the sampler drew of it, under the sampler's."""
    axis, others = list(dims).index(None), [d for d in dims if d is not None]
    attrs = {"dtype": FLOAT32, "shape": TensorShape((None, math.prod(others)))}
    rows = editor.add_name(f"{node.name}/rows")
    editor.nodes.append(Node(rows, "Placeholder", attrs=attrs, origin=node.origin))
    if len(others) > 1:
        rows = editor.reshape(rows, (-1, *others), f"{node.name}/split")
    order = editor.ints([*range(1, axis + 1), 0, *range(axis + 1, len(dims))], f"{node.name}/order")
    editor.nodes.append(Node(node.name, "Transpose", (rows, order), attrs={}))


def _zeros(node: Node, dims: Sequence[int | None], allowance: Allowance) -> np.ndarray:
    """One row of no noise. Raises UnsupportedOpError where all rows of a graph would be more than any policy's."""
    shape = [1 if d is None else d for d in dims]
    if not allowance.take(math.prod(shape)):
        raise UnsupportedOpError(
            f"cannot leave out the noise of {node.name!r}: it is {math.prod(shape)} numbers for an agent",
            issues=[(node.name, node.op)],
            why=f"no more than {MAX_MADE} are made of all noise of a policy",
            fix="the file is damaged, or name an output without noise: --output NODE=action",
        )
    return np.zeros(shape, np.float32)


def without_noise(
    graph: Graph, references: Sequence[str], noise: Mapping[str, tuple[int | None, ...]], prefix: str
) -> tuple[Graph, list[str]]:
    """``references`` computed at zero noise beside the graph they stand in, which is walked once for all of them.

    ``noise`` maps the names of noise nodes (inputs or samplers) to their shapes. Nodes between them and ``references``
    are copied under ``prefix``. A product with zeros is taken to be zero: true for every finite factor,
    and where a standard deviation overflows, the mean is what a policy without chance should give.
    """
    wanted = graph.ancestors(references) & graph.descendants(noise)
    if not wanted:
        return graph, [*references]
    types = infer_types(graph)
    editor, allowance = Editor(graph), Allowance()
    copies: dict[str, str] = {}
    zeros: set[str] = set()
    editor.keep_all()
    for node in graph.nodes:
        if node.name not in wanted:
            continue
        if node.name in noise:
            copies[node.name] = editor.const(_zeros(node, noise[node.name], allowance), f"{prefix}/zero")
            zeros.add(copies[node.name])
            continue
        inputs = [_copy_of(r, copies) for r in node.inputs]
        zero = next((i for i in inputs if i in zeros), None)
        if node.op == "Mul" and zero is not None:
            copies[node.name] = zero
            continue
        if node.op == "Add" and zero is not None:
            side = 1 - inputs.index(zero)
            if inputs[side] not in zeros and types[node.inputs[side]].shape == types[node.name].shape:
                copies[node.name] = inputs[side]
                continue
        name = editor.add_name(f"{prefix}/{node.name}")
        editor.nodes.append(Node(name, node.op, tuple(inputs), node.attrs, node.value))
        copies[node.name] = name
        made_of = inputs if node.op == "Add" else op_of(node).data_operands(inputs) if traits(node).moves else ()
        if made_of and all(i in zeros or graph.is_full_of(i, 0) for i in made_of):
            zeros.add(name)
    return editor.graph(), [_copy_of(r, copies) for r in references]


def _copy_of(reference: str, copies: Mapping[str, str]) -> str:
    name, colon, index = reference.rpartition(":")
    if colon and index.isdigit() and name in copies:
        return f"{copies[name]}:{index}"
    return copies.get(reference, reference)
