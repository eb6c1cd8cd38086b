"""The signature of a compiled graph: names, roles, shapes and facts, in the contract's order."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from msgspec.structs import replace

from export_model.converters.compiler.compilation import Compilation
from export_model.converters.compiler.passes.inputs import batch_size_rank, constant_value
from export_model.converters.compiler.passes.noise import tensor_of
from export_model.converters.compiler.passes.outputs import LOG_PROBS
from export_model.converters.graph.nodes import Graph, Node, node_of, split_ref
from export_model.converters.graph.shapes import Types, infer_types
from export_model.converters.graph.types import static_shape
from export_model.converters.interfaces.fit import fit_interface, name_numbers
from export_model.converters.policy.action import ActionMeaning, action_meaning
from export_model.converters.policy.brains import Head
from export_model.converters.policy.facts import SourceFacts
from export_model.converters.policy.generations import generation
from export_model.converters.policy.identifiers import id_distribution
from export_model.converters.policy.memories import memory_layout
from export_model.converters.policy.observations import highest_colour, normaliser
from export_model.signatures.errors import SignatureError
from export_model.signatures.interface import Interface
from export_model.signatures.labels import remaining
from export_model.signatures.roles import ACTION_NAMES, OBSERVATIONS, Role, canonical_name, numbers
from export_model.signatures.spec import Memory, PolicySignature, SourceMap, TensorSpec, sources

_INPUT_ORDER = (*OBSERVATIONS, Role.MASKS, Role.PREV_ACTION, Role.MEMORY_IN, Role.NOISE, Role.PARAMETER)
_OUTPUT_ORDER = (
    *ACTION_NAMES,
    *(f"deterministic_{name}" for name in ACTION_NAMES),
    LOG_PROBS,
    "action_probs",
    "value_estimate",
    "q_values",
    "recurrent_out",
)


def understand_actions(c: Compilation) -> Compilation:
    """What each action is, and the sizes of its branches."""
    types = infer_types(c.graph)
    masked = Role.MASKS in c.roles.values()
    meanings = {
        head.name: _of_rows(
            action_meaning(
                c.graph,
                c.fetches[head.name],
                types[c.fetches[head.name]].dtype,
                masked and head.base != "continuous_actions",
            ),
            types,
        )
        for head in c.brain.heads
    }
    branches = [b for m in meanings.values() for b in m.branches]
    squashed = c.graph.producer(c.fetches[c.brain.heads[0].name]).op == "Tanh"
    return replace(
        c,
        meanings=meanings,
        branches=branch_sizes(types, branches),
        branch_origins=branch_origins(c, branches),
        squashed=squashed,
    )


def _of_rows(meaning: ActionMeaning, types: Types) -> ActionMeaning:
    """A choice among scores that are no row of one branch ([B, branches, n]) is known by itself alone."""
    shapes = [types[b].shape or () for b in meaning.branches]
    rows = all(len(s) == 2 or (len(s) == 3 and s[1] == 1) for s in shapes)
    return meaning if meaning.role is not Role.DETERMINISTIC or rows else replace(meaning, branches=())


def sign(c: Compilation) -> Compilation:
    """The signature, and its inputs and outputs. Raises SignatureError."""
    signature, feeds, fetches = build_signature(c)
    return replace(c, signature=signature, feeds=feeds, fetches=fetches)


def build_signature(compiled: Compilation) -> tuple[PolicySignature, dict[str, str], dict[str, str]]:
    """(signature, name → placeholder, name → tensor). Raises SignatureError."""
    types = infer_types(compiled.graph)
    notes: list[str] = []
    if compiled.brain.left_out:
        notes.append(f"not exported: {', '.join(compiled.brain.left_out)}; name an output with --output NAME=ROLE")
    feeds, inputs = _inputs(compiled, types, notes)
    # A bundle that is read back says what its first source drew, which may be gone by now (--deterministic).
    told = (n for n in compiled.facts.notes if (lifted := LIFTED.fullmatch(n)) is None or lifted[1] in feeds)
    notes = [*told, *notes]
    outputs, named = _outputs(compiled, types)
    for spec in (*inputs, *outputs):
        if not spec.dtype.startswith(("bool", "int", "uint", "float")):
            raise SignatureError(
                f"{spec.name!r} is of {spec.dtype}, and a policy takes and gives numbers",
                fix="name the policy's own inputs and outputs: --input NODE=ROLE, --output NODE=ROLE",
            )
    meanings = compiled.meanings.values()
    kinds = {m.role is Role.CONTINUOUS for m in meanings}
    brain, facts = compiled.brain, compiled.facts
    bare = [n.removeprefix(brain.scope) for n in compiled.roles]
    constants = {**facts.constants, **brain.constants}
    family = facts.family or generation(numbers(constants), bare, {n.op for n in compiled.source.nodes})
    signature = PolicySignature(
        inputs=tuple(inputs),
        outputs=tuple(outputs),
        family=family,
        action_space="hybrid" if len(kinds) > 1 else "continuous" if True in kinds else "discrete",
        branches=compiled.branches,
        algorithm=_algorithm(compiled, family) if facts.algorithm is None else facts.algorithm or None,
        memory=_memory(compiled, inputs, outputs, feeds, notes),
        preprocess={
            s.name: _preprocessing(facts.image_layout, int((s.distribution or {}).get("high", 1)))
            for s in inputs
            if s.role is Role.VISUAL
        },
        constants=constants,
        notes=tuple(dict.fromkeys(notes)),
    )
    if facts.labels:
        signature = replace(signature, labels=remaining(_rename_labels(facts.labels, feeds), signature))
    return _with_interface(signature, facts.interface, feeds), feeds, named


def _with_interface(signature: PolicySignature, stated: Interface | None, feeds: Mapping[str, str]) -> PolicySignature:
    """The signature with what sources state of its numbers, and their names where no labels are given."""
    if not stated:
        return signature
    fitted, notes = fit_interface(stated, signature, feeds)
    return name_numbers(replace(signature, interface=fitted, notes=(*signature.notes, *notes)))


def _rename_labels(labels: Mapping[str, Any], feeds: Mapping[str, str]) -> dict[str, Any]:
    """Labels whose observations are placeholders, under the names that the inputs have now."""
    named = labels.get("observations", {})
    return {**labels, "observations": {name: named[node] for name, node in feeds.items() if node in named}}


def _preprocessing(layout: str, highest: int) -> dict[str, object]:
    """What is done to a camera's image before it is fed."""
    done = "divide by 255" if highest == 1 else "as they are: the policy scales them itself"
    return {"layout": layout, "range": [0, highest], "from_bytes": done}


# ------------------------------------------------------------------ notes that follow from the signature


#: Said of noise that was drawn in the graph; its group is the input's name.
LIFTED = re.compile(r"the noise drawn inside the graph \(.*\) is now the input (.+); feed N\(0, 1\)")


def _unknown_input(name: str) -> str:
    return f"{name} is an input whose meaning is not known; it must be fed, or fixed with --set"


def _no_memory_input(name: str) -> str:
    return f"{name} is computed without a memory input"


def _lost_memory(name: str) -> str:
    return (
        f"the source takes a memory ({name}) but does not give it back: its recurrent_out was lost in the export, so "
        "every step starts from the memory that is fed"
    )


def derived_notes(signature: PolicySignature) -> set[str]:
    """Notes that ``build_signature`` makes again wherever the policy is read back, under the names it then has."""
    notes = {_unknown_input(s.name) for s in signature.inputs if s.role is Role.PARAMETER}
    memory = signature.memory
    if memory is not None and memory.input is None and memory.output is not None:
        notes.add(_no_memory_input(memory.output))
    if memory is not None and memory.input is not None and memory.output is None:
        notes.add(_lost_memory(memory.input))
    return notes


# ------------------------------------------------------------------ outputs


def _outputs(compiled: Compilation, types: Types) -> tuple[list[TensorSpec], dict[str, str]]:
    roles = _output_roles(compiled)
    fetches = compiled.fetches
    order = sorted(fetches, key=lambda n: _OUTPUT_ORDER.index(n) if n in _OUTPUT_ORDER else len(_OUTPUT_ORDER))
    specs = []
    for name in order:
        kind = types[fetches[name]]
        _check_batch(name, kind.shape, compiled)
        specs.append(
            TensorSpec(
                _output_name(compiled, name),
                roles[name],
                kind.dtype.name,
                static_shape(kind.shape) or (None,),
                compiled.sources.get(name),
            )
        )
    return specs, {spec.name: fetches[name] for spec, name in zip(specs, order, strict=True)}


def _output_roles(compiled: Compilation) -> dict[str, Role]:
    canonical = compiled.brain.canonical
    roles = {canonical[base]: role for base, role, _ in compiled.brain.outputs if base in canonical}
    for head in compiled.brain.heads:
        roles[head.name] = compiled.meanings[head.name].role
        roles[head.deterministic] = Role.DETERMINISTIC
    roles[LOG_PROBS] = Role.LOG_PROBS
    return roles


def _output_name(compiled: Compilation, name: str) -> str:
    """The output's name in the artefacts: canonical, or what the trainer called it."""
    if compiled.options.names != "source":
        return name
    # A number is no trainer's name but PyTorch's way of counting, and TensorFlow.js sorts such keys.
    brain = compiled.brain
    own = {
        brain.canonical.get(base): (base, node_of(tensor)) for base, _, tensor in brain.outputs if not base.isdigit()
    }
    if name not in own:
        return name
    base, node = own[name]
    return brain.scope + base if node.startswith(brain.scope) else base


def _check_batch(name: str, shape: tuple[int | str, ...] | None, compiled: Compilation) -> None:
    if shape is None or (shape and isinstance(shape[0], str)):
        return
    source = compiled.sources.get(name)
    taken = {n: compiled.graph[n].attrs["shape"].dims for n in compiled.roles if n in compiled.graph}
    if taken and all(dims is not None and None not in dims for dims in taken.values()):
        shown = ", ".join(f"{n} {list(dims)}" for n, dims in taken.items())
        raise SignatureError(
            f"the graph has no axis for any number of agents: {shown}",
            why=f"{name!r} ({source}) comes as {list(shape)}, and what computes it cannot be told row by row",
            fix="freeze it from placeholders with a free first axis ([None, n])",
        )
    raise SignatureError(
        f"output {name!r} ({source}) has shape {list(shape)}, without the batch axis",
        why="every output of a policy has one row per agent (TF Serving asks for it)",
        fix=f"export the outputs that do: --output NAME=ROLE leaves {name!r} out",
    )


def branch_sizes(types: Types, branches: Sequence[str]) -> tuple[int, ...]:
    """Lengths of the last axes of ``branches``; empty where one is not known."""
    sizes = [(types[b].shape or (None,))[-1] for b in branches if b in types]
    known = tuple(s for s in sizes if isinstance(s, int))
    return known if len(known) == len(branches) else ()


# ------------------------------------------------------------------ inputs


def _inputs(compiled: Compilation, types: Types, notes: list[str]) -> tuple[dict[str, str], list[TensorSpec]]:
    """(name → placeholder, specs) of what is left to feed, in the contract's order."""
    graph, roles, scope = compiled.graph, compiled.roles, compiled.brain.scope
    needed = graph.ancestors([compiled.fetches[head.name] for head in compiled.brain.heads])
    ranked = sorted(
        (n for n in graph.nodes if n.op == "Placeholder"),
        key=lambda n: (
            _INPUT_ORDER.index(roles.get(n.name, Role.NOISE)),
            # draws behind the action come first, so that it is the action's noise that is called epsilon
            roles.get(n.name, Role.NOISE) is Role.NOISE and n.name not in needed,
            _trailing_number(n.name),
        ),
    )
    feeds: dict[str, str] = {}
    specs: list[TensorSpec] = []
    counts: dict[Role, int] = {}
    for node in ranked:
        role = roles.get(node.name, Role.NOISE)
        number = counts.get(role, 0)
        counts[role] = number + 1
        name = canonical_name(role, number, node.name.removeprefix(scope))
        if compiled.options.names == "source" and node.name not in compiled.draws and not node.name.isdigit():
            name = node.name
        if name in feeds:
            raise SignatureError(
                f"two inputs would be called {name!r}: {feeds[name]} and {node.name}",
                fix="give one of them another role: --input NAME=ROLE",
            )
        feeds[name] = node.name
        facts = compiled.facts
        distribution = facts.distributions.get(node.name) or _distribution(graph, types, node, role, facts)
        if node.name in facts.bounds:
            distribution = _within(distribution, facts.bounds[node.name])
        specs.append(TensorSpec(name, role, node.attrs["dtype"].name, _known_shape(node), node.origin, distribution))
        if node.name in compiled.draws:
            notes.append(f"the noise drawn inside the graph ({node.origin}) is now the input {name}; feed N(0, 1)")
        if role is Role.PARAMETER:
            notes.append(_unknown_input(name))
    return feeds, specs


def _known_shape(node: Node) -> tuple[int | None, ...]:
    if node.dims is None:
        raise SignatureError(
            f"the shape of input {node.name!r} is not known",
            why="the file does not say it, and nothing that reads it says it",
            fix=f"if it has one value for all runs, give it: --set {node.name}=VALUE",
        )
    return node.dims


def _trailing_number(name: str) -> int:
    digits = name[len(name.rstrip("0123456789")) :]
    return int(digits) if digits else -1


def _distribution(graph: Graph, types: Types, node: Node, role: Role, facts: SourceFacts) -> dict[str, object] | None:
    if role is Role.NOISE:
        return {"kind": "normal", "mean": 0.0, "std": 1.0}
    if role is Role.MASKS:
        return {"kind": "mask", "allowed": 1, "forbidden": 0}
    if role is Role.VISUAL:
        return {"kind": "uniform", "low": 0.0, "high": float(highest_colour(graph, node.name))}
    if role in (Role.VECTOR, Role.ENTITIES):
        normal = normaliser(graph, node.name) if role is Role.VECTOR else None
        return normal or id_distribution(graph, types, node, from_end=facts.from_end)
    return None


def _within(distribution: Mapping[str, Any] | None, bounds: tuple[int, int]) -> Mapping[str, Any]:
    """A distribution of integers, where a bound is not known that of their dtype."""
    known = dict(distribution or {"kind": "integer", "low": None, "high": None})
    for key, bound in zip(("low", "high"), bounds, strict=True):
        given = known.get(key)
        known[key] = (
            [bound if n is None else n for n in given] if isinstance(given, list) else bound if given is None else given
        )
    return known


# ------------------------------------------------------------------ facts


def _algorithm(compiled: Compilation, family: str) -> str | None:
    """The trainer of ML-Agents that writes such a graph, where only one does; of others none is guessed.

    SAC squashes its sample with tanh and has no critic in the export; PPO clips it (0.4 on) or not (0.1-0.3); cloned
    behaviour has no noise. Discrete graphs of PPO and SAC do not differ.
    """
    if not family.startswith("ML-Agents"):
        return None
    head: Head = compiled.brain.heads[0]
    meaning = compiled.meanings[head.name]
    if meaning.role is Role.DETERMINISTIC and not compiled.options.deterministic:
        return "DQN" if meaning.branches else None
    if meaning.role is not Role.CONTINUOUS:
        return None
    if not compiled.draws and Role.NOISE not in compiled.roles.values():
        return "BC" if head.base == "action" and compiled.facts.family is None else None
    return "SAC" if compiled.squashed else "PPO"


def _memory(
    compiled: Compilation,
    inputs: list[TensorSpec],
    outputs: list[TensorSpec],
    feeds: Mapping[str, str],
    notes: list[str],
) -> Memory | None:
    taken = next((s for s in inputs if s.role is Role.MEMORY_IN), None)
    given = next((s for s in outputs if s.role is Role.MEMORY_OUT), None)
    if taken is None:
        if given is not None:
            notes.append(_no_memory_input(given.name))
            return Memory(int(given.shape[-1] or 0), None, given.name)
        return None
    if given is None:
        notes.append(_lost_memory(taken.name))
    layout = compiled.facts.memory_layout or memory_layout(compiled.graph, feeds[taken.name])
    return Memory(int(taken.shape[-1] or 0), taken.name, None if given is None else given.name, layout)


def branch_origins(c: Compilation, branches: Sequence[str]) -> tuple[str | None, ...]:
    """The source's tensors that a sampled action is drawn from."""
    known = {n.origin for n in c.source.nodes}
    found: list[str | None] = []
    for branch in branches:
        origin = c.graph.producer(branch).origin if split_ref(branch)[1] == 0 else None
        found.append(origin if isinstance(origin, str) and origin in known else None)
    return tuple(found)


def source_map(c: Compilation) -> SourceMap:
    """How to run the source beside its export, of a compilation that is signed."""
    assert c.signature is not None
    inputs, outputs, source = c.signature.inputs, c.signature.outputs, c.source
    fixed = {
        tensor_of(source[n]): constant_value(source[n], 1) for n, r in c.roles.items() if r is Role.SEQUENCE_LENGTH
    }
    given = {tensor_of(c.original[n]): constant_value(c.original[n], v) for n, v in c.options.values.items()}
    parts = {s.name: c.parts[s.role] for s in (*inputs, *outputs) if s.role in c.parts}
    given_rows = [n for n in c.options.values if source.get(n) is None and (c.original[n].dims or (0,))[0] is None]
    return SourceMap(
        feeds=sources(inputs, parts),
        fetches=sources(outputs, parts),
        fixed={**fixed, **given},
        batch_sizes={
            tensor_of(source[n]): batch_size_rank(source, source[n]) for n, r in c.roles.items() if r is Role.BATCH_SIZE
        },
        noise=dict(c.noise),
        noise_kept=c.options.noise == "keep" and not c.options.deterministic,
        branches=c.branch_origins,
        rows=c.facts.rows,
        parts=parts,
        fixed_rows=tuple(tensor_of(c.original[n]) for n in given_rows),
    )
