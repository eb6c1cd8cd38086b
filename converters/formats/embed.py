"""The contract that every artefact of ours embeds: put in, taken out, and what it says of the graph around it.

An artefact is read back as what it was: roles, family, algorithm, memory layout, constants and notes come from its
contract instead of being guessed from names that are canonical now. Only the tensors' source names are the artefact's
own: it is the source now, and the original that the result is compared with.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from msgspec.structs import replace

from export_model.converters.compiler.passes.normalise import normalise
from export_model.converters.compiler.passes.signature import derived_notes
from export_model.converters.graph.nodes import Graph, NameScope, Node, topological
from export_model.converters.graph.ops.table import traits
from export_model.converters.policy.facts import SourceFacts
from export_model.signatures.contract import EMBEDDED, Contract, json_of, parse
from export_model.signatures.errors import DamagedFileError
from export_model.signatures.fields import FieldError
from export_model.signatures.memories import SeparateMemory
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature

#: How the note begins of files that were made for a fixed number of agents; it is about the file, not the policy.
FIXED_BATCH = "made for batches of "


def with_contract(graph: Graph, contract: str) -> Graph:
    """The graph with the contract as an unconnected string constant: how a GraphDef carries it."""
    return Graph((*graph.nodes, Node(EMBEDDED, "Const", value=np.array(contract.encode(), np.bytes_))))


def without_contract(graph: Graph) -> Graph:
    """The graph without the constant that carries the contract."""
    return Graph(tuple(n for n in graph.nodes if n.name != EMBEDDED))


def contract_text(graph: Graph) -> str | None:
    """The contract's text in a graph, None where there is none."""
    node = graph.get(EMBEDDED)
    if node is None or node.value is None or node.value.ndim or not isinstance(node.value.item(), bytes):
        return None
    return str(node.value.item().decode("utf-8", "replace"))


def runnable(graph: Graph) -> Graph:
    """The graph as the numpy kernels run it: without the contract or any other text, in one spelling.

    Made once for a graph: to reckon what it costs, to look inside, and to run it.
    """
    if runnable not in graph.cache:
        told = [n for n in graph.nodes if n.value is None or n.value.dtype.kind != "S"]
        graph.cache[runnable] = normalise(graph if len(told) == len(graph.nodes) else Graph(tuple(told)))
    made: Graph = graph.cache[runnable]
    return made


# ------------------------------------------------------------------ reading an artefact back


def contract_of(content: Any) -> Contract:
    """The contract in JSON text, or in an object that was parsed already. Raises DamagedFileError."""
    try:
        return parse(json_of(content) if isinstance(content, str | bytes) else content)
    except FieldError as error:
        raise DamagedFileError(
            "the contract that it embeds cannot be read",
            why=str(error)[:300],
            fix="export the policy again; if another tool made this file, remove what it calls its contract",
        ) from error


def split_contract(graph: Graph) -> tuple[Graph, Contract | None]:
    """A GraphDef's graph without the constant that carries the contract, and the contract (None: it is not ours)."""
    text = contract_text(graph)
    if text is None:
        return graph, None
    contract = contract_of(text)
    return redrawn(without_contract(graph), contract), contract


def facts_of(graph: Graph, contract: Contract | None, nodes: Mapping[str, str] | None = None) -> SourceFacts:
    """What the contract says of a graph, for the compiler; ``nodes`` maps outputs to nodes of other names (ONNX)."""
    if contract is None:
        return SourceFacts()
    signature = contract.signature
    layouts = [p.get("layout") for p in signature.preprocess.values() if isinstance(p, Mapping)]
    found_again = derived_notes(signature)
    return SourceFacts(
        roles={s.name: s.role for s in signature.inputs if s.name in graph},
        family=signature.family,
        algorithm=signature.algorithm or "",
        image_layout=next((text for text in layouts if isinstance(text, str)), "NHWC"),
        memory_layout=() if signature.memory is None else signature.memory.layout,
        constants=signature.constants,
        distributions={s.name: s.distribution for s in signature.inputs if s.distribution and s.name in graph},
        outputs=_outputs(graph, signature, nodes or {}),
        notes=tuple(n for n in signature.notes if n not in found_again and not n.startswith(FIXED_BATCH)),
        labels=signature.labels,
        memories=_separate_memories(contract, nodes or {}) or None,
        interface=signature.interface,
        ours=True,
    )


def _separate_memories(contract: Contract, nodes: Mapping[str, str]) -> tuple[SeparateMemory, ...]:
    """The parts of a memory whose batch axis the role of its tensors does not tell; none of other memories.

    These are the parts of a memory in several tensors, or of three axes in a file for a fixed number of agents, where
    the shape does not tell the axis either.
    """
    signature = contract.signature
    states = [signature.input(taken) for taken, _ in signature.recurrences]
    if len(states) < 2 and not ("batch" in contract.tool and any(len(s.shape) > 2 for s in states)):
        return ()
    layout = () if signature.memory is None else signature.memory.layout
    return tuple(
        SeparateMemory(a, nodes.get(b, b), signature.input(a).shape, signature.output(b).shape, part)
        for (a, b), part in zip(signature.recurrences, layout, strict=True)
    )


def _outputs(graph: Graph, signature: PolicySignature, nodes: Mapping[str, str]) -> dict[str, Role | None]:
    """Output node → its role. The actions come first, and what they mean is read off the graph, as in any source."""
    heads = {head.name for head in signature.heads}
    found = {nodes.get(s.name, s.name): Role.ACTION if s.name in heads else s.role for s in signature.outputs}
    return {node: role for node, role in found.items() if node in graph}


def redrawn(graph: Graph, contract: Contract) -> Graph:
    """The graph with draws from a single class as draws; they are written as ArgMax (TensorFlow.js draws from no less).

    Without them an action that is drawn, as its contract says, would be read as one without chance.
    """
    drawn = [s.name for s in contract.signature.outputs if s.role is Role.SAMPLED and s.name in graph]
    count = NameScope(n.name for n in graph.nodes).fresh("draws")
    draws: dict[str, Node] = {}
    for node in (graph[n] for n in sorted(graph.ancestors(drawn))):
        setting = graph.constant(node.inputs[1]) if traits(node).moves == "view" and len(node.inputs) > 1 else None
        if setting is None or setting.tolist() not in ([-1, 1], 1):  # a column, of either
            continue
        best, dtype = graph.producer(node.inputs[0]), None
        while best.op == "Cast":  # of a format that has not the dtype, or whose ArgMax gives another
            dtype, best = dtype or best.attrs["DstT"], graph.producer(best.inputs[0])
        if best.op == "ArgMax":
            dtype = dtype or best.attrs.get("output_type", np.dtype(np.int64))
            attrs = {"seed": 0, "seed2": 0, "output_dtype": dtype}
            draws[node.name] = replace(node, op="Multinomial", inputs=(best.inputs[0], count), attrs=attrs)
    if not draws:
        return graph
    nodes = [draws.get(n.name, n) for n in graph.nodes]
    return Graph(topological([Node(count, "Const", value=np.array(1, np.int32)), *nodes]))
