"""Policies in the names of Isaac Lab (rsl_rl), Godot RL Agents and PX4: one row of observations in, one of actions out.

Both are deployed without chance: the mean of continuous actions, the scores of discrete ones.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from msgspec.structs import replace

from export_model.converters.consumers.mlagents import input_mapping as feeding
from export_model.converters.consumers.mlagents.naming import Dressing, row
from export_model.converters.consumers.mlagents.output_mapping import (
    branches,
    continuous_rows,
    heads,
    log_probabilities,
)
from export_model.converters.consumers.robots.loaders import ACTIONS, CELL, HIDDEN, OBS, OUTPUT, STATE
from export_model.converters.formats.registry import LITERT, ONNX
from export_model.converters.graph.types import BATCH
from export_model.converters.policy.policy import Policy
from export_model.signatures.roles import Role
from export_model.signatures.spec import Memory, TensorSpec

ISAAC_LAB, GODOT_RL, PX4 = "isaac-lab", "godot-rl", "px4"
_PARTS = {"h": HIDDEN, "c": CELL}


def name_for_isaac_lab(policy: Policy) -> Policy:
    """The policy as rsl_rl's exporter names it: ``obs`` to ``actions``, the mean.

    A memory is ``h_in``, ``c_in`` to ``h_out``, ``c_out``, [1, 1, size] each. Raises ProfileError for actions that are
    not continuous, and memories of other forms.
    """
    dressing = Dressing(policy, ISAAC_LAB)
    _take_row(dressing)
    memory = policy.signature.memory
    if memory is not None:
        _take_states(dressing, memory)
    _give_mean(dressing, "rsl_rl's policies give the mean of a Gaussian, a number for each joint or motor", ONNX.key)
    return dressing.finish(None if memory is None else _give_states(dressing, memory))


def name_for_px4(policy: Policy) -> Policy:
    """The policy as PX4's mc_nn_control has it: ``obs`` [1, 15] to ``actions`` [1, 4], the mean.

    It feeds, in this order (``PopulateInputTensor``): the position's error (3) east, north, up; the first two rows (6)
    of the rotation from the body (front, left, up) to that; the linear velocity (3) as the error; the angular velocity
    (3) of the body. It clamps what it gets to -1 … 1 (``RescaleActions``).
    Raises ProfileError for policies with memory and for actions that are not continuous.
    """
    dressing = Dressing(policy, PX4)
    if policy.signature.memory is not None:
        dressing.refuse(
            "it has a memory",
            why="mc_nn_control feeds one row of numbers, and keeps none",
            fix="train without memory, or take --to litert or --to c into another module",
        )
    _take_row(dressing)
    _give_mean(dressing, "mc_nn_control takes a number for each of four motors", LITERT.key)
    dressing.notes.append(
        "mc_nn_control feeds the position error (3, east-north-up), rows 1 and 2 of the body's rotation (6), the "
        "linear velocity (3, east-north-up) and the angular velocity (3, front-left-up); it clamps actions to -1 … 1"
    )
    return dressing.finish(None)


def _give_mean(dressing: Dressing, why: str, target: str) -> None:
    """Give ``actions``, the mean of continuous actions; refuse others."""
    dressing.take_over(None)
    found = heads(dressing)
    if found.continuous is None or found.discrete is not None:
        dressing.refuse(
            "its actions are not continuous alone", why=why, fix=f"write the policy for your own runner: --to {target}"
        )
    _, mean, _ = continuous_rows(dressing, found.continuous)
    dressing.give(ACTIONS, mean, Role.DETERMINISTIC, found.continuous.source)


def name_for_godot_rl(policy: Policy) -> Policy:
    """The policy as Godot RL Agents' exporter names it: ``obs``, ``state_ins`` to ``output``, ``state_outs``.

    ``output`` is the mean of continuous actions, or the probabilities of each branch of discrete ones: sync.gd takes
    the largest, and begins to look at 0, so that logits below 0 would all be action 0. Raises ProfileError for
    policies with memory and for continuous and discrete actions at once.
    """
    dressing = Dressing(policy, GODOT_RL)
    if policy.signature.memory is not None:
        dressing.refuse(
            "it has a memory",
            why="sync.gd feeds 1 as state_ins at every step, and drops state_outs",
            fix="train without memory, or call the .onnx from your own script: --to onnx",
        )
    _take_row(dressing)
    state = TensorSpec(STATE[0], Role.PARAMETER, "float32", (None,))
    passed = dressing.take(STATE[0], state, (None,))
    dressing.take_over(None)
    found = heads(dressing)
    if found.continuous is not None and found.discrete is None:
        _, mean, _ = continuous_rows(dressing, found.continuous)
        dressing.give(OUTPUT, mean, Role.DETERMINISTIC, found.continuous.source)
        dressing.notes.append("sync.gd clips continuous actions to -1 … 1")
    elif found.discrete is not None and found.continuous is None:
        scores = branches(dressing, found.discrete, None, masked=False)
        builder = dressing.builder
        rows = log_probabilities(dressing, found.discrete, scores)
        ends = np.cumsum([0, *scores.sizes]).tolist()
        parts = [builder.slice(rows, 1, a, b) for a, b in pairwise(ends)]
        chances = [builder.add("Softmax", [part], "probabilities") for part in parts]
        dressing.give(OUTPUT, builder.concat(chances, 1), Role.PROBS, found.discrete.source)
    else:
        dressing.refuse(
            "it has continuous and discrete actions",
            why="sync.gd then reads a deviation behind each continuous action, whose keys the policy does not know",
            fix="train with one kind of actions, or call the .onnx from your own script: --to onnx",
        )
    dressing.give(STATE[1], passed, Role.OTHER)
    return dressing.finish(None)


def _take_row(dressing: Dressing) -> None:
    """Take ``obs`` [B, n] for all vectors; refuse whatever else the policy takes."""
    signature = dressing.policy.signature
    vectors = [s for s in signature.observations if s.role is Role.VECTOR]
    known = (Role.VECTOR, Role.NOISE, Role.MEMORY_IN, Role.MASKS)
    unknown = [s.name for s in signature.inputs if s.role not in known]
    if unknown or not vectors:
        dressing.refuse(
            f"it takes {', '.join(unknown)}" if unknown else "it takes no vector of observations",
            why="the loader feeds one row of numbers, called obs",
            fix="write the policy for your own loader: --to onnx",
        )
    feeding.take_joined(dressing, OBS, vectors)
    for spec in signature.inputs:
        if spec.role is Role.MASKS:
            dressing.notes.append(f"{dressing.profile} knows no masks: every action is allowed")
            width, builder = int(spec.shape[-1] or 1), dressing.builder
            allowed = builder.floats(np.ones((1, width)), "all_allowed")
            dressing.give_in(spec, builder.broadcast(allowed, (BATCH, width)))


def _take_states(dressing: Dressing, memory: Memory) -> None:
    """Take ``h_in`` and ``c_in`` [B, 1, size] for the policy's memory [B, n], part after part of its layout."""
    own = next(s for s in dressing.policy.signature.inputs if s.role is Role.MEMORY_IN)
    if memory.output is None:
        feeding.refuse_lost_memory(dressing, own.name)
    if sorted(memory.layout) not in (["h"], ["c", "h"]) or _layers(dressing.policy) > 1:
        dressing.refuse(
            f"its memory is [{'|'.join(memory.layout) or 'of unknown parts'}]"
            + (f" of {_layers(dressing.policy)} layers" if _layers(dressing.policy) > 1 else ""),
            why="h_in and c_in are the states of one LSTM layer, h_in alone that of one GRU layer",
            fix="write the policy for your own runner, which keeps recurrent_in: --to onnx",
        )
    width = memory.size // len(memory.layout)
    taken = {part: dressing.take(_PARTS[part][0], own, _rows(width)) for part in sorted(memory.layout, reverse=True)}
    rows = [row(dressing.builder, taken[part], width) for part in memory.layout]
    dressing.give_in(own, dressing.builder.concat(rows, 1))


def _give_states(dressing: Dressing, memory: Memory) -> Memory:
    """Give ``h_out`` and ``c_out``; returns the memory as the consumer has it."""
    assert memory.output is not None, "refused before"
    builder, width = dressing.builder, memory.size // len(memory.layout)
    whole = row(builder, dressing.own(memory.output), memory.size)
    order = sorted(memory.layout, reverse=True)
    for part in order:
        begin = memory.layout.index(part) * width
        shape = builder.ints([-1, 1, width], "state")
        state = builder.add("Reshape", [builder.slice(whole, 1, begin, begin + width), shape], _PARTS[part][1])
        dressing.give(_PARTS[part][1], state, Role.MEMORY_OUT)
    first, *others = (_PARTS[part] for part in order)
    return replace(memory, input=first[0], output=first[1], layout=tuple(order), others=tuple(others))


def _rows(width: int) -> tuple[int | None, ...]:
    return (None, 1, width)


def _layers(policy: Policy) -> int:
    """Layers of the memory, as far as the source's own tensors tell: [layers, B, size]."""
    parts = [p for given in policy.source.parts.values() for p in given]
    return max((int(np.prod([d or 1 for d in p.shape[: p.axis]])) for p in parts), default=1)
