"""From a source's graph to policies: the passes in their order, and the signature that comes out of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from converters.graph.editor import Editor
from converters.graph.passes.companions import DETERMINISTIC, LOG_PROBS, add_companions
from converters.graph.passes.fold import fold
from converters.graph.passes.inputs import batch_size_rank, complete_shapes, constant_value, set_values, settle_inputs
from converters.graph.passes.naming import name_tensors
from converters.graph.passes.noise import NoiseMode, lift_noise, samplers
from converters.graph.passes.normalise import normalise
from converters.graph.passes.simplify import collapse_views, drop_identities
from converters.graph.passes.stats import memory_layout, normaliser
from converters.graph.passes.straighten import straighten
from converters.graph.shapes import Types, infer_types
from converters.graph.types import static_shape
from signatures.eras import generation
from signatures.errors import SignatureError, UsageError
from signatures.graph import Graph, Node, TensorShape, node_of, topological
from signatures.infer import ActionMeaning, Brain, action_meaning, classify_inputs, find_brains
from signatures.roles import OBSERVATIONS, Role, canonical_name
from signatures.spec import Memory, Policy, PolicySignature, SourceMap, TensorSpec

#: The name of the string constant in which our GraphDefs carry their contract.
CONTRACT_NODE = "export_model_contract"

_INPUT_ORDER = (
    *OBSERVATIONS,
    Role.MASKS,
    Role.PREV_ACTION,
    Role.MEMORY_IN,
    Role.NOISE,
    Role.PARAMETER,
)
_OUTPUT_ORDER = ("action", DETERMINISTIC, LOG_PROBS, "action_probs", "value_estimate", "recurrent_out")


@dataclass(frozen=True)
class CompileOptions:
    """What the user may decide; the fields are the flags of the command line."""

    names: str = "canonical"  # canonical | source
    noise: NoiseMode = "lift"
    deterministic: bool = False
    brain: str | None = None
    inputs: Mapping[str, Role] = field(default_factory=dict)
    outputs: Mapping[str, Role] = field(default_factory=dict)
    values: Mapping[str, float] = field(default_factory=dict)


def compile_graph(graph: Graph, name: str, options: CompileOptions | None = None) -> list[Policy]:
    """Every policy in ``graph``, ready for the writers. ``name`` is the source's stem.

    Raises NotAPolicyError, SignatureError, UnsupportedOpError, GraphError, UsageError.
    """
    options = options or CompileOptions()
    original, graph = graph, set_values(graph, options.values)
    brains = find_brains(graph, options.outputs)
    chosen = _chosen_brains(brains, options.brain)
    return [
        _compile_brain(graph, original, brain, f"{name}-{brain.label}" if len(brains) > 1 else name, options)
        for brain in chosen
    ]


def _chosen_brains(brains: tuple[Brain, ...], wanted: str | None) -> tuple[Brain, ...]:
    if wanted is None:
        return brains
    chosen = tuple(b for b in brains if b.label == wanted)
    if not chosen:
        names = ", ".join(b.label or "(no scope)" for b in brains)
        raise UsageError(f"--brain {wanted}: there is no such brain", fix=f"this graph has: {names}")
    return chosen


def _compile_brain(graph: Graph, original: Graph, brain: Brain, name: str, options: CompileOptions) -> Policy:
    roles = classify_inputs(graph, brain, options.inputs)
    upstream = graph.pruned(brain.roots)
    ops = {n.op for n in upstream.nodes}
    pins = {f"__output_{i}": reference for i, (_, _, reference) in enumerate(brain.outputs)}
    pinned = Graph(
        topological([*upstream.nodes, *(Node(pin, "Identity", (r,), origin=_origin(r)) for pin, r in pins.items())])
    )
    work = normalise(settle_inputs(pinned, roles))
    work = straighten(complete_shapes(work, roles))
    fetches = {base: pin for pin, (base, _, _) in zip(pins, brain.outputs, strict=True)}
    work, fetches = drop_identities(fold(work).pruned(pins), fetches)
    work, fetches = collapse_views(work, fetches)

    types = infer_types(work)
    action = next(base for base, role, _ in brain.outputs if role is Role.ACTION)
    meaning = action_meaning(work, fetches[action], types[fetches[action]].dtype, Role.MASKS in roles.values())
    work, fetches = _settle_single_draws(work, fetches, meaning, types)
    draws = {n.name: _dims(types, n.name) for n in samplers(work)}
    kept = options.noise == "keep" and not options.deterministic
    work = lift_noise(work, "keep" if kept else "zero" if options.deterministic else options.noise)
    fed_noise = {n: _dims(types, n) for n, role in roles.items() if role is Role.NOISE and n in work}
    noise = {**draws, **fed_noise}
    work, fetches = add_companions(work, _renamed_action(fetches, action), meaning, noise)
    origins = tuple(work.producer(b).origin if b in work else None for b in meaning.branches)
    if options.deterministic:
        fetches["action"] = fetches[DETERMINISTIC]
        meaning = ActionMeaning(_deterministic_role(meaning), meaning.branches)
        fetches.pop(LOG_PROBS, None)
    work, fetches = drop_identities(fold(work).pruned(fetches.values()), fetches)
    policy = _finish(work, fetches, brain, name, options, roles, meaning, draws, ops)
    return replace(policy, source=_source_map(policy, pinned, roles, options, origins, noise, original))


def _source_map(
    policy: Policy,
    source: Graph,
    roles: Mapping[str, Role],
    options: CompileOptions,
    branches: tuple[str | None, ...],
    noise: Mapping[str, tuple[int | None, ...]],
    original: Graph,
) -> SourceMap:
    """How to run the source, from what became of its placeholders."""
    fixed = {f"{name}:0": constant_value(source[name], 1) for name, r in roles.items() if r is Role.SEQUENCE_LENGTH}
    return SourceMap(
        feeds={s.name: s.source for s in policy.signature.inputs if isinstance(s.source, str)},
        fetches={s.name: s.source for s in policy.signature.outputs if isinstance(s.source, str)},
        fixed={**fixed, **{_origin(name): constant_value(original[name], v) for name, v in options.values.items()}},
        batch_sizes={f"{n}:0": batch_size_rank(source, source[n]) for n, r in roles.items() if r is Role.BATCH_SIZE},
        noise={_origin(name): dims for name, dims in noise.items()},
        noise_kept=options.noise == "keep" and not options.deterministic,
        branches=tuple(b if b is not None and node_of(b) in source else None for b in branches),
    )


def _settle_single_draws(
    graph: Graph, fetches: dict[str, str], meaning: ActionMeaning, types: Types
) -> tuple[Graph, dict[str, str]]:
    """A draw from a single class is always class 0: an ArgMax says so (TensorFlow.js refuses to draw from one)."""
    single = {
        sampler
        for sampler, branch in zip(meaning.samplers, meaning.branches, strict=False)
        if (types[branch].shape or (None,))[-1] == 1
    }
    if not single:
        return graph, fetches
    editor = Editor(graph)
    for node in graph.nodes:
        if node.name not in single:
            editor.keep(node)
            continue
        axis = editor.const(np.array(1, np.int32), f"{node.name}/axis")
        best = editor.add("ArgMax", [node.inputs[0], axis], f"{node.name}/only", output_type=node.attrs["output_dtype"])
        shape = editor.const(np.array([-1, 1], np.int32), f"{node.name}/column_shape")
        editor.redirect(node.name, editor.add("Reshape", [best, shape], f"{node.name}/column", node.origin))
    return editor.graph(), {base: editor.resolve(reference) for base, reference in fetches.items()}


def _origin(reference: str) -> str:
    return reference if ":" in reference else f"{reference}:0"


def _dims(types: Types, name: str) -> tuple[int | None, ...]:
    return static_shape(types[name].shape) or ()


def _renamed_action(fetches: Mapping[str, str], action: str) -> dict[str, str]:
    """The action under its canonical name (own models call it something else)."""
    return {("action" if base == action else base): reference for base, reference in fetches.items()}


def _deterministic_role(meaning: ActionMeaning) -> Role:
    return Role.CONTINUOUS if meaning.role is Role.CONTINUOUS else Role.DETERMINISTIC


# ------------------------------------------------------------------ the signature


def _finish(
    graph: Graph,
    fetches: dict[str, str],
    brain: Brain,
    name: str,
    options: CompileOptions,
    roles: Mapping[str, Role],
    meaning: ActionMeaning,
    draws: Mapping[str, tuple[int | None, ...]],
    ops: set[str],
) -> Policy:
    types = infer_types(graph)
    notes: list[str] = []
    feeds, inputs = _inputs(graph, types, brain, options, roles, draws, fetches["action"], notes)
    sources = {base: _origin(reference) for base, _, reference in brain.outputs}
    role_of = {base: role for base, role, _ in brain.outputs}
    action_source = next(base for base, role, _ in brain.outputs if role is Role.ACTION)
    sources["action"] = sources[action_source]
    role_of["action"] = meaning.role
    role_of.setdefault(DETERMINISTIC, Role.DETERMINISTIC)
    role_of.setdefault(LOG_PROBS, Role.LOG_PROBS)
    order = sorted(fetches, key=lambda n: _OUTPUT_ORDER.index(n) if n in _OUTPUT_ORDER else len(_OUTPUT_ORDER))
    outputs = []
    for base in order:
        shape = types[fetches[base]].shape
        _check_batch(base, shape, sources.get(base))
        outputs.append(
            TensorSpec(
                _output_name(base, action_source, brain, options),
                role_of[base],
                types[fetches[base]].dtype.name,
                static_shape(shape) or (None,),
                sources.get(base),
            )
        )
    named = {spec.name: fetches[base] for spec, base in zip(outputs, order, strict=True)}
    memory = _memory(graph, inputs, outputs, feeds, notes)
    continuous = meaning.role is Role.CONTINUOUS
    signature = PolicySignature(
        inputs=tuple(inputs),
        outputs=tuple(outputs),
        family=generation(brain.constants, [n[len(brain.scope) :] for n in roles], ops),
        action_space="continuous" if continuous else "discrete",
        branches=() if continuous else _branch_sizes(types, meaning, outputs),
        algorithm=_algorithm(graph, fetches["action"], meaning, [s.role for s in inputs], bool(draws), brain),
        memory=memory,
        preprocess={
            s.name: {"layout": "NHWC", "range": [0, 1], "from_bytes": "divide by 255"}
            for s in inputs
            if s.role is Role.VISUAL
        },
        constants=dict(brain.constants),
        notes=tuple(notes),
    )
    graph = name_tensors(graph, feeds, named, (CONTRACT_NODE, *_constant_names(brain, options)))
    if options.names == "source":
        constants = [
            Node(brain.scope + key, "Const", value=np.array(value, np.int32), origin=f"{brain.scope}{key}:0")
            for key, value in brain.constants.items()
        ]
        graph = Graph((*graph.nodes, *constants))
    return Policy(name, graph, signature, {s.name: s.name for s in inputs}, {s.name: s.name for s in outputs})


def _algorithm(
    graph: Graph, action: str, meaning: ActionMeaning, roles: list[Role], drawn: bool, brain: Brain
) -> str | None:
    """The trainer that writes such a graph, where only one does.

    SAC squashes its sample with tanh and has no critic in the export; PPO clips it (0.4 on) or not (0.1-0.3); cloned
    behaviour has no noise. Discrete graphs of PPO and SAC do not differ.
    """
    if meaning.role is Role.DETERMINISTIC:
        return "DQN" if meaning.branches else None
    if meaning.role is not Role.CONTINUOUS:
        return None
    if not drawn and Role.NOISE not in roles:
        return "BC" if any(base == "action" for base, _, _ in brain.outputs) else None
    return "SAC" if graph.producer(action).op == "Tanh" else "PPO"


def _constant_names(brain: Brain, options: CompileOptions) -> tuple[str, ...]:
    return tuple(brain.scope + key for key in brain.constants) if options.names == "source" else ()


def _output_name(base: str, action_source: str, brain: Brain, options: CompileOptions) -> str:
    if options.names == "canonical":
        return base
    if base == "action":
        base = action_source
    return base if base in (DETERMINISTIC, LOG_PROBS) else brain.scope + base


def _inputs(
    graph: Graph,
    types: Types,
    brain: Brain,
    options: CompileOptions,
    roles: Mapping[str, Role],
    draws: Mapping[str, tuple[int | None, ...]],
    action: str,
    notes: list[str],
) -> tuple[dict[str, str], list[TensorSpec]]:
    """(canonical name → placeholder, specs) of what is left to feed, in the contract's order."""
    placeholders = [n for n in graph.nodes if n.op == "Placeholder"]
    action_needs = graph.ancestors([action])
    ranked = sorted(
        placeholders,
        key=lambda n: (
            _INPUT_ORDER.index(roles.get(n.name, Role.NOISE)),
            # draws behind the action come first, so that it is the action's noise that is called epsilon
            roles.get(n.name, Role.NOISE) is Role.NOISE and n.name not in action_needs,
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
        own = node.name[len(brain.scope) :] if node.name.startswith(brain.scope) else node.name
        name = canonical_name(role, number, own)
        if options.names == "source" and node.name not in draws:
            name = node.name
        if name in feeds:
            raise SignatureError(
                f"two inputs would be called {name!r}: {feeds[name]} and {node.name}",
                fix="give one of them another role: --input NAME=ROLE",
            )
        shape: TensorShape = node.attrs["shape"]
        if shape.dims is None:
            raise SignatureError(
                f"the shape of input {node.name!r} is not known",
                why="the file does not say it, and nothing that reads it tells",
                fix=f"if it has one value for all runs, give it: --set {node.name}=VALUE",
            )
        feeds[name] = node.name
        specs.append(
            TensorSpec(
                name, role, node.attrs["dtype"].name, shape.dims, node.origin, _distribution(graph, types, node, role)
            )
        )
        if node.name in draws:
            notes.append(f"the noise drawn inside the graph ({node.origin}) is now the input {name}; feed N(0, 1)")
        if role is Role.PARAMETER:
            notes.append(f"{name} is an input whose meaning is not known; it must be fed, or fixed with --set")
    return feeds, specs


def _trailing_number(name: str) -> int:
    digits = name[len(name.rstrip("0123456789")) :]
    return int(digits) if digits else -1


def _distribution(graph: Graph, types: Types, node: Node, role: Role) -> dict[str, object] | None:
    if role is Role.NOISE:
        return {"kind": "normal", "mean": 0.0, "std": 1.0}
    if role is Role.MASKS:
        return {"kind": "mask", "allowed": 1, "forbidden": 0}
    if role is Role.VISUAL:
        return {"kind": "uniform", "low": 0.0, "high": 1.0}
    if role is Role.VECTOR and node.attrs["dtype"].kind in "iu":
        depth = _one_hot_depth(graph, types, node)
        return None if depth is None else {"kind": "integer", "low": 0, "high": depth - 1}
    if role is Role.VECTOR:
        return normaliser(graph, node.name)
    return None


def _one_hot_depth(graph: Graph, types: Types, node: Node) -> int | None:
    for reader in graph.nodes:
        if reader.op == "OneHot" and node.name in graph.ancestors([reader.inputs[0]]):
            depth = types[reader.inputs[1]].constant
            return None if depth is None else int(depth)
    return None


def _check_batch(base: str, shape: tuple[int | str, ...] | None, source: str | None) -> None:
    if shape is None or (shape and isinstance(shape[0], str)):
        return
    raise SignatureError(
        f"output {base!r} ({source}) has shape {list(shape)}, without the batch axis",
        why="every output of a policy has one row per agent (TF Serving asks for it)",
        fix=f"export the outputs that do: --output NAME=ROLE leaves {base!r} out",
    )


def _branch_sizes(types: Types, meaning: ActionMeaning, outputs: list[TensorSpec]) -> tuple[int, ...]:
    sizes = []
    for branch in meaning.branches:
        kind = types.get(branch)
        last = None if kind is None or not kind.shape else kind.shape[-1]
        if isinstance(last, int):
            sizes.append(last)
    if len(sizes) == len(meaning.branches) and sizes:
        return tuple(sizes)
    return ()


def _memory(
    graph: Graph, inputs: list[TensorSpec], outputs: list[TensorSpec], feeds: Mapping[str, str], notes: list[str]
) -> Memory | None:
    taken = next((s for s in inputs if s.role is Role.MEMORY_IN), None)
    given = next((s for s in outputs if s.role is Role.MEMORY_OUT), None)
    if taken is None and given is None:
        return None
    if taken is not None and given is None:
        notes.append(
            f"the source takes a memory ({taken.name}) but does not give it back: its recurrent_out was lost in the "
            "export, so every step starts from the memory that is fed"
        )
    if taken is None and given is not None:
        notes.append(f"{given.name} is computed without a memory input")
    size = (taken or given).shape[-1]  # type: ignore[union-attr]
    return Memory(
        int(size or 0),
        None if taken is None else taken.name,
        None if given is None else given.name,
        () if taken is None else memory_layout(graph, feeds[taken.name]),
    )
