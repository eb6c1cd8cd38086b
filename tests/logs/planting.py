"""Logs with a known fault: an agent whose policy is given something else than what is logged, or logs something else.

The agent is run in onnxruntime or numpy by ``load_policy``; what it observes is a walk over values such as the policy
was trained on. ``Fault`` says what stands between the log and the policy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from export_model.exporter.acting.policy import LoadedPolicy
from export_model.signatures.roles import Role
from export_model.signatures.sampling import draw_typical

Array = np.ndarray
Arrays = dict[str, Array]


def _same(inputs: Arrays) -> Arrays:
    return inputs


@dataclass(frozen=True)
class Fault:
    """``given``: what was logged → what the policy was given; ``logged``: [steps, …] actions as the log has them."""

    given: Callable[[Arrays], Arrays] = _same
    logged: Callable[[Array], Array] = field(default=lambda actions: actions)
    previous: bool = True
    memory: str = "kept"  # kept | not reset | late | dropped


def observations(policy: LoadedPolicy, steps: int, seed: int) -> Arrays:
    """Inputs of ``steps`` steps: observations and masks, each row another."""
    cases = draw_typical(policy.signature, seed=seed, count=steps)
    wanted = {Role.VECTOR, Role.VISUAL, Role.ENTITIES, Role.MASKS}
    names = [s.name for s in policy.signature.inputs if s.role in wanted]
    return {n: np.concatenate([case.feeds[n] for case in cases])[:steps] for n in names}


def recorded(
    policy: LoadedPolicy, fault: Fault, *, episodes: int = 4, length: int = 50, seed: int = 0, drawn: bool = False
) -> Arrays:
    """A log: observations, masks, the action, and the episode of each step."""
    whole = observations(policy, episodes * length, seed)
    actions = []
    kept: list[Array | None] = [None, None]
    previous: Array | None = None
    policy.seed(seed)
    for step in range(episodes * length):
        if step % length == 0 and fault.memory != "not reset":
            kept = [None, None]
        row = {n: a[step : step + 1] for n, a in whole.items()}
        given = fault.given(row)
        memory = {"kept": kept[-1], "not reset": kept[-1], "late": kept[-2], "dropped": None}[fault.memory]
        masks = next((given.pop(s.name) for s in policy.signature.inputs if s.role is Role.MASKS), None)
        recurrent = {"memory": memory} if policy.takes(Role.MEMORY_IN) else {}
        if policy.takes(Role.PREV_ACTION):
            recurrent["previous"] = None if step % length == 0 else previous
        decision = policy.decide(given, masks=masks, deterministic=not drawn, **recurrent)
        previous = decision.discrete if fault.previous else None
        kept = [*kept, decision.memory][-2:]
        actions.append(decision.action[0])
    head = policy.signature.heads[0].name
    episode = np.repeat(np.arange(episodes), length)
    return {**whole, head: fault.logged(np.stack(actions)), "episode": episode}
