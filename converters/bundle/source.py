"""What this tool wrote as a source: bundles, and the contract that every artefact of them embeds.

An artefact is read back as what it was: roles, family, algorithm, memory layout, constants and notes come from its
contract instead of being guessed from names that are canonical now. Only the tensors' source names are the artefact's
own: it is the source now, and the original that the result is compared with.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from converters.format import Format, Member
from converters.graph.compile import CONTRACT_NODE
from converters.graph.nodes import Graph, NameScope, Node, topological
from converters.renaming import renamed
from converters.understand.facts import SourceFacts
from converters.understand.signature import derived_notes
from signatures.digest import sha256_hex
from signatures.errors import BundleError, DamagedFileError
from signatures.roles import Role
from signatures.spec import PolicySignature

POLICY = "policy.json"
_FIX = "export the policy again"
#: The dtypes that TensorFlow.js has.
_NARROW = ("float32", "int32", "bool")


@dataclass(frozen=True)
class Contract:
    """A contract that was read back."""

    name: str
    signature: PolicySignature


def contract_of(content: Any) -> Contract:
    """The contract in JSON text, or in an object that was parsed already. Raises DamagedFileError."""
    try:
        if isinstance(content, str | bytes):
            content = json.loads(content)
        signature = PolicySignature.from_dict(content)
        name = content["name"]
        if not isinstance(name, str) or not name:
            raise ValueError("it has no name")
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise DamagedFileError(
            "the contract that it embeds cannot be read",
            why=f"{type(error).__name__}: {error}"[:300],
            fix="export the policy again; if another tool made this file, remove what it calls its contract",
        ) from error
    return Contract(name, signature)


def recalled(graph: Graph) -> tuple[Graph, Contract | None]:
    """A GraphDef's graph without the constant that carries the contract, and the contract (None: it is not ours)."""
    node = graph.get(CONTRACT_NODE)
    if node is None or node.value is None or node.value.ndim or not isinstance(node.value.item(), bytes):
        return graph, None
    contract = contract_of(node.value.item())
    return redrawn(Graph(tuple(n for n in graph.nodes if n.name != CONTRACT_NODE)), contract), contract


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
        notes=tuple(n for n in signature.notes if n not in found_again),
        labels=signature.labels,
    )


def _outputs(graph: Graph, signature: PolicySignature, nodes: Mapping[str, str]) -> dict[str, Role | None]:
    """Output node → its role. The actions come first, and what they mean is read off the graph, as in any source."""
    heads = 2 if signature.action_space == "hybrid" else 1
    roles: dict[str, Role | None] = {}
    for position, spec in enumerate(signature.outputs):
        node = nodes.get(spec.name, spec.name)
        if node in graph:
            roles[node] = Role.ACTION if position < heads else spec.role
    return roles


def redrawn(graph: Graph, contract: Contract) -> Graph:
    """The graph with draws from a single class as draws; they are written as ArgMax (TensorFlow.js draws from no less).

    Without them an action that is drawn, as its contract says, would be read as one without chance.
    """
    drawn = [s.name for s in contract.signature.outputs if s.role is Role.SAMPLED and s.name in graph]
    count = NameScope(n.name for n in graph.nodes).fresh("draws")
    draws: dict[str, Node] = {}
    for node in (graph[n] for n in sorted(graph.ancestors(drawn))):
        shape = graph.constant(node.inputs[1]) if node.op == "Reshape" else None
        if shape is None or shape.tolist() != [-1, 1]:
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


def retyped(graph: Graph, contract: Contract) -> Graph:
    """The graph with inputs and outputs in the dtypes of the contract, for a format that has not all of them.

    TensorFlow.js has no int64: what was narrowed to int32 is cast, behind an input and before an output.
    """
    scope = NameScope(n.name for n in graph.nodes)
    names = [s.name for s in (*contract.signature.inputs, *contract.signature.outputs) if s.dtype not in _NARROW]
    inner = {name: scope.fresh(f"{name}/narrow") for name in names if name in graph}
    nodes = {n.name: n for n in renamed(graph, inner).nodes}
    for spec in contract.signature.inputs:
        if spec.name in inner:
            node = nodes[inner[spec.name]]
            cast = Node(node.name, "Cast", (spec.name,), {"DstT": node.attrs["dtype"]})
            wide = replace(node, name=spec.name, attrs={**node.attrs, "dtype": np.dtype(spec.dtype)})
            nodes.update({node.name: cast, spec.name: wide})
    for spec in contract.signature.outputs:
        if spec.name in inner:
            node = nodes[inner[spec.name]]
            attrs = {"DstT": np.dtype(spec.dtype)}
            nodes[spec.name] = Node(spec.name, "Cast", (node.name,), attrs, origin=node.origin)
    return Graph(topological(list(nodes.values())))


# ------------------------------------------------------------------ bundles


def artefacts(folder: Path, formats: Sequence[Format]) -> list[tuple[Format, Path]]:
    """The artefacts that lie in a bundle. Raises BundleError, where there is none too."""
    name = _policy_json(folder / POLICY)["name"]
    found = [(f, folder / f.main_of(name)) for f in formats if f.main and (folder / f.first_file_of(name)).exists()]
    if not found:
        raise BundleError("the bundle holds no model", where=str(folder), fix=_FIX)
    return found


def read_first(folder: Path, formats: Sequence[Format]) -> Member:
    """The artefact that a bundle is read from: the first that policy.json names and that can be read.

    Raises BundleError where a file of it is missing or not the one that policy.json names.
    """
    content = _policy_json(folder / POLICY)
    name, files = content["name"], content["files"]
    able = [f for f in formats if f.main and f.read is not None]
    for found in able:
        if found.first_file_of(name) in files:
            _check(folder, {path: entry for path, entry in files.items() if found.owns(path, name)})
            return Member(folder / found.main_of(name), name, files=(folder / POLICY,))
    raise BundleError(
        "names no file that can be read",
        where=POLICY,
        why=f"a bundle has one of {', '.join(f.main_of(name) for f in able)}",
        fix=_FIX,
    )


def _policy_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise BundleError("is not JSON", where=path.name, why=str(error)[:200], fix=_FIX) from error
    name = content.get("name") if isinstance(content, dict) else None
    if not isinstance(name, str) or not name or Path(name).name != name or not isinstance(content.get("files"), dict):
        raise BundleError(
            "is not a policy.json of export-model",
            where=path.name,
            why="it has no name and files",
            fix="give the model itself, not the folder",
        )
    return {**content}


def _check(folder: Path, files: Mapping[str, Any]) -> None:
    """Raise BundleError unless the files of a format are those that policy.json names."""
    for relative, entry in files.items():
        file = folder / relative
        if not file.is_file():
            raise BundleError("is missing", where=relative, why=f"{POLICY} names it", fix=_FIX)
        wanted = entry.get("sha256") if isinstance(entry, dict) else None
        if sha256_hex(file.read_bytes()) != wanted:
            raise BundleError(
                "has been changed since it was exported",
                where=relative,
                why=f"its sha256 is not the one in {POLICY}",
                fix=f"{_FIX}; or give {relative} itself",
            )
