"""What a graph on its way must be before a pass, and is after it. Each says what contradicts it, or None."""

from __future__ import annotations

from collections.abc import Iterable

from export_model.converters.compiler.compilation import Compilation
from export_model.converters.compiler.passes.noise import samplers
from export_model.converters.graph.nodes import Node, ref
from export_model.converters.graph.ops.table import CONTROL_FLOW, TABLE, op_of, traits
from export_model.converters.graph.shapes import infer_types
from export_model.signatures.roles import Role


def pinned_outputs(c: Compilation) -> str | None:
    """Every output is a node of its own, under the name that it began with."""
    return next((f"{out} is {r}" for out, r in c.fetches.items() if r not in c.graph), None)


def settled_inputs(c: Compilation) -> str | None:
    """No placeholder is left for the sequence's length or the batch's size."""
    gone = (Role.SEQUENCE_LENGTH, Role.BATCH_SIZE)
    return _first(n for n in c.graph.nodes if n.op == "Placeholder" and c.roles.get(n.name) in gone)


def one_spelling(c: Compilation) -> str | None:
    """Every op is one of TensorFlow 1.4's, or of a loop, and has all attributes."""
    for node in c.graph.nodes:
        entry = TABLE.get(node.op)
        if entry is None:
            if node.op not in CONTROL_FLOW:
                return f"{node.name} ({node.op})"
        elif entry.older is not None or (
            node.op != "Const" and {a.name for a in entry.attrs if a.derive is None} - node.attrs.keys()
        ):
            return f"{node.name} ({node.op}) {dict(node.attrs)}"
    return None


def no_control_flow(c: Compilation) -> str | None:
    """No loop, branch or tensor array is left."""
    return _first(n for n in c.graph.nodes if n.op in CONTROL_FLOW)


def constants_folded(c: Compilation) -> str | None:
    """What does not depend on an input is a Const."""
    types = infer_types(c.graph)

    def is_constant(node: Node) -> bool:
        results = [types[ref(node.name, i)] for i in range(max(op_of(node).outputs, 1))]
        return all(r.constant is not None for r in results)

    return _first(n for n in c.graph.nodes if not traits(n).start and is_constant(n))


def no_identities(c: Compilation) -> str | None:
    """No node is left that only passes a value on."""
    return _first(n for n in c.graph.nodes if traits(n).moves == "same")


def no_dead_nodes(c: Compilation) -> str | None:
    """Every node is upstream of an output."""
    needed = c.graph.ancestors(c.fetches.values())
    return _first(n for n in c.graph.nodes if n.name not in needed)


def meanings(c: Compilation) -> str | None:
    """It is known what each action is."""
    return next((h.name for h in c.brain.heads if h.name not in c.meanings), None)


def noise_as_asked(c: Compilation) -> str | None:
    """Normals are drawn in the graph only where they are to be kept, and fed only where they are to be lifted."""
    if c.options.noise == "keep" and not c.options.deterministic:
        return None
    zero = c.options.noise == "zero" or c.options.deterministic
    noisy = (n for n in c.graph.nodes if n.op == "Placeholder" and n.name in {*c.draws, *c.fed})
    return _first(samplers(c.graph)) or (_first(noisy) if zero else None)


def no_seeds(c: Compilation) -> str | None:
    """A sampler draws anew in every run."""
    return _first(n for n in c.graph.nodes if n.attrs.get("seed") or n.attrs.get("seed2"))


def actions_without_chance(c: Compilation) -> str | None:
    """Every action has a companion that no sampler stands behind."""
    for head in c.brain.heads:
        if head.deterministic not in c.fetches:
            return head.deterministic
        upstream = c.graph.ancestors([c.fetches[head.deterministic]])
        drawn = _first(n for n in c.graph.nodes if n.name in upstream and traits(n).sampler)
        if drawn:
            return drawn
    return None


def signature(c: Compilation) -> str | None:
    """There is a signature, and a tensor for each of its inputs and outputs."""
    if c.signature is None:
        return "no signature"
    names = {s.name for s in c.signature.inputs} ^ c.feeds.keys() | {
        s.name for s in c.signature.outputs
    } ^ c.fetches.keys()
    return ", ".join(sorted(names)) or None


def names_of_the_signature(c: Compilation) -> str | None:
    """Inputs and outputs have the signature's names."""
    return next((k for k, v in {**c.feeds, **c.fetches}.items() if k != v or k not in c.graph), None)


def _first(nodes: Iterable[Node]) -> str | None:
    node = next(iter(nodes), None)
    return None if node is None else f"{node.name} ({node.op})"
