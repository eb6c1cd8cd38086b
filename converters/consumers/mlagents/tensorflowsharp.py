"""ML-Agents 0.1 to 0.6 in TensorFlowSharp: a frozen graph whose nodes are looked up by their trainer's names.

What CoreBrainInternal.cs (0.1 to 0.5) and TFSharpInferenceEngine.cs (0.6) feed and fetch: images NHWC, ``prev_action``
int32 [B] in 0.3 and 0.4, [B, branches] from 0.5 on (0.1 and 0.2 do not feed it: there it goes with the memory),
``action_masks`` from 0.5 on, memory [B, M]. Up to 0.5 a discrete ``action`` is int64, drawn in the graph; from 0.6 on
it is log-probabilities that the C# side draws from. Noise is drawn in the graph, as the trainers of 0.3 on did it: the
*Graph Placeholders* of the Inspector stay empty. In 0.1 and 0.2 it is an input: their documentation has each scene of
continuous control made with a Graph Placeholder ``epsilon``, floating point, 0 to 0, which feeds float32 [1] for all.
"""

from __future__ import annotations

import numpy as np
from msgspec import Struct

from export_model.converters.consumers.mlagents import input_mapping as feeding
from export_model.converters.consumers.mlagents.memory import action_columns, give_memory, previous_action, take_memory
from export_model.converters.consumers.mlagents.names import ACTION, EPSILON, PREVIOUS, SEQUENCE, VECTOR, VISUAL
from export_model.converters.consumers.mlagents.naming import Dressing
from export_model.converters.consumers.mlagents.output_mapping import (
    Heads,
    branches,
    continuous_rows,
    heads,
    log_probabilities,
    samples,
)
from export_model.converters.graph.nodes import Node, TensorShape
from export_model.converters.graph.types import BATCH, FLOAT32, INT32
from export_model.converters.policy.policy import Policy
from export_model.signatures.roles import ACTION_SHAPE, IS_CONTINUOUS, MEMORY_SIZE, VERSION_NUMBER, Role
from export_model.signatures.spec import TensorSpec


class Generation(Struct, frozen=True):
    """What tells a generation from the others: names of observations, and what it knows."""

    name: str
    vector: str = VECTOR
    visual: str = VISUAL
    masks: bool = False
    branches: bool = False
    #: prev_action is fed
    previous: bool = True
    #: what is wrong with its pictures
    pictures: str | None = None
    #: the scene feeds epsilon
    noise: bool = False
    #: memory_size is read before the first step; sequence_length is fed whether the graph has it or not
    memory_constant: bool = True
    #: the four constants of 0.6, and log-probabilities as the action
    version: int | None = None


def dress(policy: Policy, generation: Generation) -> Policy:
    """The policy under the names of a generation. Raises ProfileError where it cannot be held."""
    dressing = Dressing(policy, generation.name)
    feeding.refuse_parameters(dressing)
    _take_observations(dressing, generation)
    masks = _take_masks(dressing, generation)
    carried = _take_previous_action(dressing, generation)
    state = take_memory(dressing, carried, _rows)
    if generation.noise:
        _take_noise(dressing)
    dressing.take_over(lambda spec: feeding.drawn_inside(dressing, spec))
    found = heads(dressing)
    if found.continuous is not None and found.discrete is not None:
        dressing.refuse(
            "it has continuous and discrete actions",
            why="a brain of ML-Agents 0.1 to 0.6 has one kind of actions",
            fix="use a project of release 17 or later (--for barracuda-1.4, barracuda-3, unity6)",
        )
    width = _give_action(dressing, generation, found, masks)
    memory = give_memory(dressing, state, _rows)
    nodes = _lookup_nodes(generation, found, width, state.size)
    if generation.noise and found.continuous is not None and EPSILON not in dressing.feeds:
        nodes.append(Node(EPSILON, "Placeholder", attrs={"dtype": FLOAT32, "shape": TensorShape((None, width))}))
    return dressing.finish(memory, nodes)


def _rows(size: int) -> tuple[int | None, ...]:
    return (None, size)


def _take_observations(dressing: Dressing, generation: Generation) -> None:
    signature = dressing.policy.signature
    if any(s.is_sequence for s in signature.observations):
        dressing.refuse(
            "one of its observations is a list of entities or a history",
            why="ML-Agents 0.1 to 0.6 has vectors and cameras alone",
            fix="use a project of release 17 or later (--for barracuda-1.4, barracuda-3, unity6)",
        )
    for number, spec in enumerate(s for s in signature.observations if s.role is Role.VISUAL):
        feeding.take_image(dressing, f"{generation.visual}{number}", spec, "NHWC")
    if dressing.images and generation.pictures is not None:
        dressing.notes.append(f"pictures are taken from 0 to 1; {generation.pictures}")
    vectors = [s for s in signature.observations if s.role is Role.VECTOR]
    if len(vectors) == 1 and np.dtype(vectors[0].dtype).kind in "iu" and vectors[0].shape[1:] in ((), (1,)):
        # a discrete state space is fed as int32 [B, 1] up to 0.4
        whole = generation.masks
        taken = dressing.take(generation.vector, vectors[0], (None, 1), FLOAT32 if whole else INT32)
        dressing.give_in(vectors[0], taken)
    elif vectors:
        feeding.take_joined(dressing, generation.vector, vectors)


def _take_masks(dressing: Dressing, generation: Generation) -> str | None:
    spec = next((s for s in dressing.policy.signature.inputs if s.role is Role.MASKS), None)
    if spec is None or generation.masks:
        return feeding.take_masks(dressing)
    # a row for each agent: TensorFlow 1.x' Select, and Concat, take one for all as an error
    width, builder = int(spec.shape[-1] or 1), dressing.builder
    dressing.give_in(spec, builder.broadcast(builder.floats(np.ones((1, width)), "all_allowed"), (BATCH, width)))
    dressing.notes.append(f"{generation.name} knows no masks: every action is allowed")
    return None


def _take_previous_action(dressing: Dressing, generation: Generation) -> TensorSpec | None:
    """Take ``prev_action``; returned where it is not fed and has to be kept with the memory."""
    spec = previous_action(dressing)
    if spec is None:
        return None
    if not generation.previous:
        return spec
    shape: tuple[int | None, ...] = (None, action_columns(spec)) if generation.branches else (None,)
    dressing.give_in(spec, dressing.take(PREVIOUS, spec, shape, INT32))
    return None


def _take_noise(dressing: Dressing) -> None:
    """Take the noise of a continuous action as ``epsilon``, of which the scene feeds a single number for all.

    It becomes a row for each agent, whatever reads it. Noise of another shape is drawn inside.
    """
    spec = next(iter(dressing.policy.signature.noise), None)
    if spec is None or len(spec.shape) != 2 or spec.shape[1] is None or not _is_continuous(dressing.policy):
        return
    builder, width = dressing.builder, spec.shape[1]
    rows = builder.broadcast(builder.floats(np.zeros((1, width)), "no_noise"), (BATCH, width))
    taken = dressing.take(EPSILON, spec, (None, width))
    dressing.give_in(spec, builder.add("Add", [rows, taken], f"{spec.name}/for_each"))


def _is_continuous(policy: Policy) -> bool:
    return any(s.role is Role.CONTINUOUS for s in policy.signature.outputs)


def _give_action(dressing: Dressing, generation: Generation, found: Heads, masks: str | None) -> int:
    """Give ``action``; returns its width: continuous actions, or the sum of branches."""
    if found.continuous is not None:
        drawn, _, width = continuous_rows(dressing, found.continuous)
        dressing.give(ACTION, drawn, Role.CONTINUOUS, found.continuous.source)
        return width
    spec: TensorSpec | None = found.discrete
    if spec is None:
        dressing.refuse("it has no action", why="action is what the brain fetches", fix="name it: --output NAME=action")
    scores = branches(dressing, spec, masks, masked=generation.masks)
    if len(scores.sizes) > 1 and not generation.branches:
        dressing.refuse(
            f"its discrete action has {len(scores.sizes)} branches",
            why="a discrete action is a single number up to ML-Agents 0.4",
            fix="use a project of 0.5 or later (--for tfsharp-0.5)",
        )
    if generation.version is not None:
        dressing.give(ACTION, log_probabilities(dressing, spec, scores), Role.LOG_PROBS, spec.source)
    else:
        role = Role.DETERMINISTIC if spec.role is Role.DETERMINISTIC else Role.SAMPLED
        dressing.give(ACTION, samples(dressing, scores)[0], role, spec.source)
    return sum(scores.sizes)


def _lookup_nodes(generation: Generation, found: Heads, width: int, size: int) -> list[Node]:
    """Nodes that the C# side looks up and that no other node reads."""
    constants: dict[str, int] = {}
    if size and generation.memory_constant:
        constants[MEMORY_SIZE] = size
    if generation.version is not None:
        constants = {
            VERSION_NUMBER: generation.version,
            MEMORY_SIZE: size,
            IS_CONTINUOUS: int(found.continuous is not None),
            ACTION_SHAPE: width,
        }
    nodes = [Node(name, "Const", value=np.array(value, np.int32)) for name, value in constants.items()]
    if size and generation.memory_constant and generation.version is None:
        nodes.append(Node(SEQUENCE, "Placeholder", attrs={"dtype": INT32, "shape": TensorShape(())}))
    return nodes
