"""API version 2: what ML-Agents' C# side looks up from 0.7 to release 16.

``vector_observation`` (all vectors joined), ``visual_observation_i``, ``action_masks``, ``prev_action``; ``action``:
continuous actions, or log-probabilities of all branches, which the C# side draws from (GeneratorImpl.cs, ApplierImpl.cs
1.0 to 1.9). A policy with both kinds has ``continuous_actions`` and ``discrete_actions``, from release 11 on. Constants
are float32 outputs, as the torch exporter wrote them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from converters.compiler.passes.broadcast_constants import broadcast_rows
from converters.consumers.mlagents import input_mapping as feeding
from converters.consumers.mlagents.naming import Dressing
from converters.consumers.mlagents.output_mapping import Heads, branches, continuous_rows, heads, log_probabilities
from converters.policy.policy import Policy
from signatures.roles import (
    ACTION_SHAPE,
    CONTINUOUS_SHAPE,
    DISCRETE_SHAPE,
    IS_CONTINUOUS,
    MEMORY_SIZE,
    VERSION_NUMBER,
    Role,
)

_VERSION = 2
VECTOR = "vector_observation"


def dress(policy: Policy, profile: str) -> Policy:
    """The policy under the names of API version 2. Raises ProfileError where it cannot be held."""
    # Barracuda 1.1 has no Tile to repeat a constant for every agent with.
    graph = broadcast_rows(policy.graph, [*policy.feeds.values(), *policy.fetches.values()])
    dressing = Dressing(replace(policy, graph=graph), profile)
    feeding.refuse_parameters(dressing)
    if policy.signature.memory is not None:
        dressing.refuse(
            "it has a memory",
            why="the ONNX of API version 2 gave no memory back, or one that was right for a single agent alone",
            fix="write a .nn, which has memories (--to nn), or use release 17 or later (--for barracuda-3)",
        )
    _take_observations(dressing)
    masks = feeding.take_masks(dressing)
    feeding.take_previous_action(dressing)
    dressing.take_over(lambda spec: feeding.drawn_inside(dressing, spec))
    dressing.constants[VERSION_NUMBER] = np.array([_VERSION], np.float32)
    dressing.constants[MEMORY_SIZE] = np.array([0], np.float32)
    _give_actions(dressing, heads(dressing), masks)
    return dressing.finish(None)


def _take_observations(dressing: Dressing) -> None:
    signature = dressing.policy.signature
    entities = [s.name for s in signature.observations if s.is_sequence]
    if entities:
        dressing.refuse(
            f"its observation {entities[0]} is a list of entities or a history",
            why="ML-Agents before 1.8 has no sensor of variable length, and no Barracuda of 1.x was seen to read one",
            fix="use a project of release 17 or later (--for barracuda-1.4, barracuda-3, unity6)",
        )
    for number, spec in enumerate(s for s in signature.observations if s.role is Role.VISUAL):
        feeding.take_observation(dressing, f"visual_observation_{number}", spec)
    vectors = [s for s in signature.observations if s.role is Role.VECTOR]
    if vectors:
        feeding.take_joined(dressing, VECTOR, vectors)


def _give_actions(dressing: Dressing, found: Heads, masks: str | None) -> None:
    both = found.continuous is not None and found.discrete is not None
    constants = dressing.constants
    if found.continuous is not None:
        drawn, _, width = continuous_rows(dressing, found.continuous)
        constants[CONTINUOUS_SHAPE if both else ACTION_SHAPE] = np.array([width], np.float32)
        dressing.give("continuous_actions" if both else "action", drawn, Role.CONTINUOUS, found.continuous.source)
    if found.discrete is not None:
        scores = branches(dressing, found.discrete, masks)
        total = np.array([sum(scores.sizes)], np.float32)
        constants[DISCRETE_SHAPE if both else ACTION_SHAPE] = total
        given = log_probabilities(dressing, found.discrete, scores)
        dressing.give("discrete_actions" if both else "action", given, Role.LOG_PROBS, found.discrete.source)
    if both:
        dressing.notes.append("continuous_actions and discrete_actions are read by release 11 and later")
    else:
        constants[IS_CONTINUOUS] = np.array([found.continuous is not None], np.float32)
