"""API version 3: what ML-Agents' C# side looks up from release 17 on (2021), and still does in Unity 6.

``obs_i`` for every sensor, ``action_masks``, ``prev_action`` (not in 3.0 and 4.0, whose players cannot feed it),
``recurrent_in`` [B, 1, M]; ``continuous_actions`` and
``discrete_actions``, both drawn in the model, ``deterministic_…`` of both, ``recurrent_out`` [B, 1, M]; constants as
float32 outputs (BarracudaModelParamLoader.cs 2.3.0-exp.3, SentisModelInfo.cs 3.0.0 and 4.0.0; measured, see
``converters/consumers/unity``). Every input is float32: the Editor of release 22 takes no other.
"""

from __future__ import annotations

import numpy as np

from export_model.converters.consumers.mlagents import input_mapping as feeding
from export_model.converters.consumers.mlagents.memory import (
    DRAWN_KEPT,
    give_memory,
    is_deterministic,
    previous_action,
    take_memory,
)
from export_model.converters.consumers.mlagents.names import CONTINUOUS, DETERMINISTIC, DISCRETE
from export_model.converters.consumers.mlagents.naming import Dressing
from export_model.converters.consumers.mlagents.output_mapping import branches, continuous_rows, heads, samples
from export_model.converters.policy.policy import Policy
from export_model.signatures.roles import CONTINUOUS_SHAPE, DISCRETE_SHAPE, MEMORY_SIZE, VERSION_NUMBER, Role

_VERSION = 3


def dress(policy: Policy, profile: str, *, feeds_previous: bool = True, transposes_buffers: bool = False) -> Policy:
    """The policy under the names of API version 3; the last action is kept with the memory unless it is fed.

    ``transposes_buffers``: observations of two axes arrive transposed (``input_mapping.take_observation``). Raises
    ProfileError where it cannot be held.
    """
    dressing = Dressing(policy, profile)
    feeding.refuse_parameters(dressing)
    for name, spec in feeding.observation_names(dressing):
        feeding.take_observation(dressing, name, spec, transposed=transposes_buffers)
    masks = feeding.take_masks(dressing)
    carried = None if feeds_previous else previous_action(dressing)
    if carried is None:
        feeding.take_previous_action(dressing)
    state = take_memory(dressing, carried, _rows)
    dressing.take_over(lambda spec: feeding.drawn_inside(dressing, spec))
    found = heads(dressing)
    dressing.constants[VERSION_NUMBER] = np.array([_VERSION], np.float32)
    dressing.constants[MEMORY_SIZE] = np.array([state.size], np.float32)
    plain: list[tuple[str, str]] = []
    if found.continuous is not None:
        drawn, without, width = continuous_rows(dressing, found.continuous)
        dressing.constants[CONTINUOUS_SHAPE] = np.array([width], np.float32)
        dressing.give(CONTINUOUS, drawn, Role.CONTINUOUS, found.continuous.source)
        plain.append((CONTINUOUS, without))
    if found.discrete is not None:
        scores = branches(dressing, found.discrete, masks)
        drawn, best = samples(dressing, scores)
        role = Role.DETERMINISTIC if found.discrete.role is Role.DETERMINISTIC else Role.SAMPLED
        dressing.constants[DISCRETE_SHAPE] = np.array([scores.sizes], np.float32)
        dressing.give(DISCRETE, drawn, role, found.discrete.source)
        plain.append((DISCRETE, best))
    if carried and not is_deterministic(dressing) and dressing.fetches[plain[-1][0]] != plain[-1][1]:
        dressing.notes.append(DRAWN_KEPT)
    for name, without in plain:  # behind the actions, which a signature has first
        dressing.give(f"{DETERMINISTIC}{name}", without, Role.DETERMINISTIC)
    return dressing.finish(give_memory(dressing, state, _rows))


def _rows(size: int) -> tuple[int | None, ...]:
    return (None, 1, size)
