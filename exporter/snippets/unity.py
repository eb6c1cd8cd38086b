"""What to set in Unity for the ``.bytes``: the Internal Brain of ML-Agents 0.1 to 0.5, the Learning Brain of 0.6.

Sources: the ML-Agents documentation of 0.1 to 0.3 ("Using TensorFlowSharp in Unity") and CoreBrainInternal.cs of those
versions (names are typed by the user, so that any will do; shapes and dtypes are fixed), and for 0.6
BarracudaModelParamLoader's forerunner, TensorFlowSharp's InferenceBrain/ModelParamLoader.cs (names are fixed).
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec import Struct

from export_model.exporter.snippets.contract import SnippetBundle, branch_lines, chance_text, number_names
from export_model.signatures.roles import ACTION_SHAPE, IS_CONTINUOUS, MEMORY_SIZE, VERSION_NUMBER, Role
from export_model.signatures.spec import TensorSpec


class VersionSpan(Struct, frozen=True):
    """A span of ML-Agents versions and what its brain can do with a graph."""

    name: str
    vector_field: str
    observation_field: str
    memory: bool = True
    previous_rank: int | None = None
    masks: bool = False
    branches: bool = False
    #: whether it feeds sequence_length and reads memory_size wherever there is a memory
    asks: bool = False


_STATE = ("State Node Name", "Observation Placeholder Name")
_VECTOR = ("Vector Observation Node Name", "Visual Observation Placeholder Name")
_INTERNAL = (
    VersionSpan("0.1", *_STATE, memory=False),
    VersionSpan("0.2", *_STATE),
    VersionSpan("0.3-0.4", *_VECTOR, previous_rank=1, asks=True),
    VersionSpan("0.5", *_VECTOR, previous_rank=2, masks=True, branches=True, asks=True),
)
_NOISE = "epsilon"
_FIXED = ("vector_observation", "prev_action", _NOISE, "action_masks", "recurrent_in")
_NEEDED = (VERSION_NUMBER, IS_CONTINUOUS, MEMORY_SIZE, ACTION_SHAPE)


def internal_brain(bundle: SnippetBundle) -> str:
    """The settings, and for which versions they hold."""
    able = [g for g in _INTERNAL if not _faults(bundle, g)]
    lines = [
        f"The policy {bundle.name} in Unity, as the TensorFlowSharp plugin runs it",
        f"(Player Settings: .NET 4.x and the symbol ENABLE_TENSORFLOW; copy {bundle.name}.bytes into Assets)",
        "",
    ]
    if able:
        lines += [f"ML-Agents {', '.join(g.name for g in able)}: Brain Type Internal", *_settings(bundle, able), ""]
    for generation in _INTERNAL:
        if faults := _faults(bundle, generation):
            lines.append(f"ML-Agents {generation.name}: not this policy: {'; '.join(faults)}")
    lines.append(_learning_brain(bundle))
    lines.append(
        "ML-Agents 0.7 to release 20: their Barracuda reads .nn (--to nn), and .onnx of fixed names "
        "(--for barracuda-1.0, barracuda-1.4, barracuda-3)"
    )
    lines.append("newer: .onnx of --for unity6; without ML-Agents, export-model snippets --for inference-engine")
    return "\n".join([*lines, ""])


def _settings(bundle: SnippetBundle, able: Sequence[VersionSpan]) -> list[str]:
    signature = bundle.signature
    scope = _scope(bundle)
    vectors = [s for s in signature.inputs if s.role is Role.VECTOR]
    images = [s for s in signature.inputs if s.role is Role.VISUAL]
    newest = next((g for g in able if bundle.made_for == f"tfsharp-{g.name[-3:]}"), able[-1])  # whose fields they are
    rows: list[tuple[str, str]] = [
        ("Graph Model", bundle.name),
        ("Graph Scope", scope.rstrip("/") + ("/ (0.3 and newer add the slash themselves)" if scope else "(empty)")),
        *_placeholders(bundle, scope),
        *((newest.vector_field, s.name.removeprefix(scope)) for s in vectors),
        *((f"{newest.observation_field} {i}", s.name.removeprefix(scope)) for i, s in enumerate(images)),
    ]
    if bundle.memory is not None:
        rows.append(("Recurrent Input Node Name", bundle.memory[0].name.removeprefix(scope)))
        rows.append(("Recurrent Output Node Name", bundle.memory[1].removeprefix(scope)))
    rows.append(("Action Node Name", _action(bundle).name.removeprefix(scope)))
    rows += _brain(bundle, vectors, images)
    width = max(len(name) for name, _ in rows)
    lines = [f"  {name.ljust(width)}  {value}" for name, value in rows]
    names = signature.labels.get("observations", {})
    lines += [f"  {s.name}: {', '.join(number_names(names[s.name]))}" for s in vectors if s.name in names]
    if "actions" in signature.labels:
        lines.append(f"  actions: {', '.join(number_names(signature.labels['actions']))}")
    chance = "" if _action(bundle).is_continuous else chance_text(bundle, bundle.heads[0])
    return [*lines, *(f"  {line}" for line in filter(None, [*branch_lines(bundle), chance]))]


def _placeholders(bundle: SnippetBundle, scope: str) -> list[tuple[str, str]]:
    """Inputs that the brain does not know are drawn from a range, one number for all; a node must have each name."""
    rows = []
    for spec in bundle.signature.inputs:
        name, kind = spec.name.removeprefix(scope), "Floating Point" if spec.dtype == "float32" else "Integer"
        if spec.role is Role.NOISE:
            text = f"{name}: {kind}, Min Value 0, Max Value 0 (deterministic; -1 and 1: with noise)"
            rows.append(("Graph Placeholder", text))
        elif spec.role is Role.PARAMETER:
            rows.append(("Graph Placeholder", f"{name}: {kind}, Min Value and Max Value: its value"))
    unread = "" if rows or f"{scope}{_NOISE}" not in bundle.nodes else f" ({_NOISE} may stay there: nothing reads it)"
    return [("Graph Placeholders", f"Size {len(rows)}{unread}"), *rows]


def _brain(bundle: SnippetBundle, vectors: list[TensorSpec], images: list[TensorSpec]) -> list[tuple[str, str]]:
    rows = []
    for spec in vectors:
        known = spec.distribution or {}
        if isinstance(known.get("high"), int):
            rows.append(("Vector Observation", f"Space Type Discrete, Space Size {int(known['high']) + 1}"))
            continue
        size = spec.shape[-1] or 0
        splits = [f"{size // n} x {n}" for n in range(2, 10) if size % n == 0 and size > n]
        stacked = f"; or, as it was trained, Space Size x Stacked Vectors: {', '.join(splits)}" if splits else ""
        rows.append(("Vector Observation", f"Space Type Continuous, Space Size {size}, Stacked Vectors 1{stacked}"))
    if not vectors:
        rows.append(("Vector Observation", "Space Size 0"))
    for spec in images:
        height, width, channels = spec.shape[1:]
        colour = "Black And White" if channels == 1 else "colour"
        rows.append(("Camera Observation", f"Width {width}, Height {height}, {colour}"))
    head = bundle.heads[0]
    if head.is_continuous:
        rows.append(("Vector Action", f"Space Type Continuous, Space Size {head.shape[-1]}"))
    else:
        sizes = bundle.signature.branches
        text = (
            f"Space Size {sizes[0]}" if len(sizes) == 1 else f"Branches Size {len(sizes)}: {', '.join(map(str, sizes))}"
        )
        rows.append(("Vector Action", f"Space Type Discrete, {text}"))
    return rows


def _action(bundle: SnippetBundle) -> TensorSpec:
    """The node of the deterministic action, or of the one that the proposed noise of 0 makes so."""
    head = bundle.heads[0]
    return head if head.is_continuous and bundle.signature.noise else bundle.plain(head)


def _scope(bundle: SnippetBundle) -> str:
    names = [s.name for s in (*bundle.signature.inputs, *bundle.heads)]
    scope = names[0].rpartition("/")[0]
    return f"{scope}/" if scope and all(n.startswith(f"{scope}/") for n in names) else ""


def _faults(bundle: SnippetBundle, generation: VersionSpan) -> list[str]:
    signature, previous = bundle.signature, bundle.previous
    roles = [s.role for s in signature.inputs]
    board = any(s.role is Role.VECTOR and len(s.shape) > 2 for s in signature.inputs)
    hybrid, remembers = len(bundle.heads) > 1, signature.memory is not None
    counted = not bundle.heads[0].is_continuous and _action(bundle).dtype != "int64"
    asked = [n for n in (MEMORY_SIZE, "sequence_length") if f"{_scope(bundle)}{n}" not in bundle.nodes]
    wanted = f"export with --for tfsharp-{generation.name[-3:]}"
    unfed = "" if previous is None else f"{previous.name} {list(previous.shape)}".replace("None", "agents")
    told = (
        (hybrid, "it has no hybrid actions"),
        (counted and not hybrid, "it reads discrete actions as int64"),
        (len(signature.branches) > 1 and not generation.branches, "it has one branch of discrete actions"),
        (Role.MASKS in roles and not generation.masks, "it does not feed action masks"),
        (Role.ENTITIES in roles or roles.count(Role.VECTOR) > 1 or board, "it feeds one vector observation"),
        (remembers and not generation.memory, "its memory does not work"),
        (remembers and generation.asks and asked, f"it asks a policy with memory for {' and '.join(asked)}: {wanted}"),
        (previous and generation.previous_rank != len(previous.shape), f"it does not feed {unfed}"),
        (any(p.get("layout") == "NCHW" for p in signature.preprocess.values()), "its images have the channels last"),
    )
    return [text for wrong, text in told if wrong]


def _learning_brain(bundle: SnippetBundle) -> str:
    signature = bundle.signature
    odd = [s.name for s in signature.inputs if s.name not in _FIXED and not s.name.startswith("visual_observation_")]
    missing = [name for name in _NEEDED if name not in bundle.nodes]
    if not odd and not missing and signature.constants.get(VERSION_NUMBER) == 1:
        return f"ML-Agents 0.6: drop {bundle.name}.bytes on the Model of the Learning Brain; it finds the rest itself"
    wrong = f"it wants {', '.join(missing)}" if missing else "it wants version_number 1"
    why = f"it does not know {', '.join(odd)}" if odd else wrong
    return f"ML-Agents 0.6: not this bundle: {why} (export it with --for tfsharp-0.6)"
