"""API version 2: what ML-Agents' C# side looks up from 0.7 to release 16.

``vector_observation`` (all vectors joined), ``visual_observation_i``, ``action_masks``, ``prev_action``; ``action``:
continuous actions, or log-probabilities of all branches, which the C# side draws from (GeneratorImpl.cs, ApplierImpl.cs
1.0 to 1.9). A policy with both kinds has ``continuous_actions`` and ``discrete_actions``, from release 11 on. Constants
are float32 outputs, as the torch exporter wrote them.

A ``.nn`` has more than an ONNX of these years: memories in parts, which Barracuda carries itself, noise as ``epsilon``,
and what the policy gives besides (BarracudaModelParamLoader.cs and TensorGenerator.cs of 0.7 to release 20).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from msgspec.structs import replace

from export_model.converters.compiler.passes.broadcast_constants import broadcast_rows
from export_model.converters.consumers.mlagents import input_mapping as feeding
from export_model.converters.consumers.mlagents.memory import give_parts, take_parts
from export_model.converters.consumers.mlagents.names import (
    ACTION,
    ACTION_PROBS,
    CONTINUOUS,
    DISCRETE,
    EPSILON,
    VALUE,
    VECTOR,
    VISUAL,
)
from export_model.converters.consumers.mlagents.naming import Dressing
from export_model.converters.consumers.mlagents.output_mapping import (
    Heads,
    branches,
    continuous_rows,
    heads,
    log_probabilities,
)
from export_model.converters.policy.policy import Policy
from export_model.signatures.roles import (
    ACTION_NAMES,
    ACTION_SHAPE,
    CONTINUOUS_SHAPE,
    DISCRETE_SHAPE,
    IS_CONTINUOUS,
    MEMORY_SIZE,
    VERSION_NUMBER,
    Role,
)
from export_model.signatures.spec import PolicySignature, TensorSpec

_VERSION = 2
#: What is taken from the scores of a forbidden action in a ``.nn``: e to the power of it is 0, and a half can hold it.
_FORBIDDEN_IN_NN = 1e4


def dress(policy: Policy, profile: str) -> Policy:
    """The policy as an ONNX under the names of API version 2. Raises ProfileError where it cannot be held."""
    dressing = _begin(policy, profile)
    if policy.signature.memory is not None:
        dressing.refuse(
            "it has a memory",
            why="the ONNX of API version 2 gave no memory back, or one that was right for a single agent alone",
            fix="write a .nn, which has memories (--to nn), or use release 17 or later (--for barracuda-3)",
        )
    sequences = [s.name for s in policy.signature.observations if s.is_sequence]
    masks = _take_inputs(dressing, sequences)
    dressing.take_over(lambda spec: feeding.drawn_inside(dressing, spec))
    _give_actions(dressing, heads(dressing), masks, memory=0)
    return dressing.finish(None)


def dress_nn(policy: Policy, profile: str) -> Policy:
    """The policy as a ``.nn`` under the names of API version 2. Raises ProfileError where it cannot be held."""
    dressing = _begin(policy, profile)
    dressing.forbidden = _FORBIDDEN_IN_NN
    masks = _take_inputs(dressing, [s.name for s in policy.signature.observations if s.role is Role.ENTITIES])
    for spec in policy.signature.noise[:1]:
        dressing.give_in(spec, dressing.take(EPSILON, spec, (None, *spec.shape[1:])))
    parts = take_parts(dressing)
    dressing.take_over(lambda spec: feeding.drawn_inside(dressing, spec))
    found = heads(dressing)
    _give_actions(dressing, found, masks, memory=sum(p.size for p in parts))
    for name, spec in companions(policy.signature):
        dressing.give(name, dressing.own(spec.name), spec.role, spec.source)
    give_parts(dressing, parts)
    return dressing.finish(None, unread=True)


def observations(signature: PolicySignature) -> Iterator[tuple[str, list[TensorSpec]]]:
    """Yield each input for observations and the policy's own that are fed through it, side by side."""
    for number, spec in enumerate(s for s in signature.observations if s.role is Role.VISUAL):
        yield f"{VISUAL}{number}", [spec]
    vectors = [s for s in signature.observations if s.role is Role.VECTOR]
    if vectors:
        yield VECTOR, vectors


def companions(signature: PolicySignature) -> Iterator[tuple[str, TensorSpec]]:
    """Yield what a ``.nn`` gives beside the actions and the memory: its name there, and the policy's output.

    An action without chance is one where the source has it itself: of some trainers, not the one at no noise.
    """
    named = {Role.VALUE: VALUE, Role.ACTION_PROBS: ACTION_PROBS}
    for spec in signature.outputs:
        plain = spec.name.rpartition("/")[2]
        own = spec.role is Role.DETERMINISTIC and spec.source is not None and spec.dtype == "float32"
        if spec.role in named:
            yield named.pop(spec.role), spec
        elif own and plain not in ACTION_NAMES:
            yield plain, spec


def _begin(policy: Policy, profile: str) -> Dressing:
    # Barracuda 1.1 has no Tile to repeat a constant for every agent with.
    graph = broadcast_rows(policy.graph, [*policy.feeds.values(), *policy.fetches.values()])
    dressing = Dressing(replace(policy, graph=graph), profile)
    feeding.refuse_parameters(dressing)
    return dressing


def _take_inputs(dressing: Dressing, sequences: list[str]) -> str | None:
    """Take observations, masks and the last action; return the masks, None where the policy has none."""
    if sequences:
        dressing.refuse(
            f"its observation {sequences[0]} is a list of entities or a history",
            why="ML-Agents before 1.8 has no sensor of variable length, and no Barracuda of 1.x was seen to read one",
            fix="use a project of release 17 or later (--for barracuda-1.4, barracuda-3, unity6)",
        )
    for name, specs in observations(dressing.policy.signature):
        if name == VECTOR:
            feeding.take_joined(dressing, VECTOR, specs)
        else:
            feeding.take_observation(dressing, name, specs[0])
    masks = feeding.take_masks(dressing)
    feeding.take_previous_action(dressing)
    return masks


def _give_actions(dressing: Dressing, found: Heads, masks: str | None, memory: int) -> None:
    both = found.continuous is not None and found.discrete is not None
    constants = dressing.constants
    constants[VERSION_NUMBER] = np.array([_VERSION], np.float32)
    constants[MEMORY_SIZE] = np.array([memory], np.float32)
    if found.continuous is not None:
        drawn, _, width = continuous_rows(dressing, found.continuous)
        constants[CONTINUOUS_SHAPE if both else ACTION_SHAPE] = np.array([width], np.float32)
        dressing.give(CONTINUOUS if both else ACTION, drawn, Role.CONTINUOUS, found.continuous.source)
    if found.discrete is not None:
        scores = branches(dressing, found.discrete, masks)
        total = np.array([sum(scores.sizes)], np.float32)
        constants[DISCRETE_SHAPE if both else ACTION_SHAPE] = total
        given = log_probabilities(dressing, found.discrete, scores)
        dressing.give(DISCRETE if both else ACTION, given, Role.LOG_PROBS, found.discrete.source)
    if both:
        dressing.notes.append("continuous_actions and discrete_actions are read by release 11 and later")
    else:
        constants[IS_CONTINUOUS] = np.array([found.continuous is not None], np.float32)
