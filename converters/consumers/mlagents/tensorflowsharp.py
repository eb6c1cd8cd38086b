"""ML-Agents 0.1 to 0.6 in TensorFlowSharp: a frozen graph whose nodes are looked up by their trainer's names.

What CoreBrainInternal.cs (0.1 to 0.5) and TFSharpInferenceEngine.cs (0.6) feed and fetch: images NHWC, ``prev_action``
int32 [B] in 0.3 and 0.4, [B, branches] from 0.5 on (0.1 and 0.2 do not feed it: there it goes with the memory),
``action_masks`` from 0.5 on, memory [B, M]. Up to 0.5 a discrete ``action`` is int64, drawn in the graph; from 0.6 on
it is log-probabilities that the C# side draws from. Noise is drawn in the graph, as the trainers of 0.3 on did it: the
*Graph Placeholders* of the Inspector stay empty.
"""

from __future__ import annotations

import numpy as np

from converters.consumers.mlagents import input_mapping as feeding
from converters.consumers.mlagents.naming import Dressing, row
from converters.consumers.mlagents.output_mapping import (
    Heads,
    branches,
    continuous_rows,
    heads,
    log_probabilities,
    samples,
)
from converters.graph.nodes import Node, TensorShape
from converters.graph.types import BATCH, FLOAT32, INT32
from converters.policy.policy import Policy
from signatures.records import dataclass
from signatures.roles import Role
from signatures.spec import Memory, TensorSpec


@dataclass(frozen=True, slots=True)
class Generation:
    """What tells a generation from the others: names of observations, and what it knows."""

    name: str
    vector: str = "vector_observation"
    visual: str = "visual_observation_"
    masks: bool = False
    branches: bool = False
    #: prev_action is fed
    previous: bool = True
    #: what is wrong with its pictures
    pictures: str | None = None
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
    size = _take_memory(dressing, carried)
    dressing.take_over(lambda spec: feeding.drawn_inside(dressing, spec))
    found = heads(dressing)
    if found.continuous is not None and found.discrete is not None:
        dressing.refuse(
            "it has continuous and discrete actions",
            why="a brain of ML-Agents 0.1 to 0.6 has one kind of actions",
            fix="use a project of release 17 or later (--for barracuda-1.4, barracuda-3, unity6)",
        )
    width = _give_action(dressing, generation, found, masks)
    memory = None
    if size:
        own = policy.signature.memory
        assert own is not None and own.output is not None
        given = row(dressing.builder, dressing.own(own.output), own.size)
        if carried is not None:
            given = dressing.builder.concat([given, dressing.builder.cast(dressing.fetches["action"], FLOAT32)], 1)
        dressing.give("recurrent_out", given, Role.MEMORY_OUT)
        memory = Memory(size, "recurrent_in", "recurrent_out", own.layout if carried is None else ())
    return dressing.finished(memory, _beside(generation, found, width, size))


def _take_observations(dressing: Dressing, generation: Generation) -> None:
    signature = dressing.policy.signature
    if any(s.role is Role.ENTITIES for s in signature.observations):
        dressing.refuse(
            "one of its observations is a list of entities",
            why="ML-Agents 0.1 to 0.6 has vectors and cameras alone",
            fix="use a project of release 17 or later (--for barracuda-1.4, barracuda-3, unity6)",
        )
    for number, spec in enumerate(s for s in signature.observations if s.role is Role.VISUAL):
        feeding.take_image(dressing, f"{generation.visual}{number}", spec, "NHWC")
    if dressing.images and generation.pictures is not None:
        dressing.notes.append(f"pictures are taken from 0 to 1; {generation.pictures}")
    vectors = [s for s in signature.observations if s.role is Role.VECTOR]
    if len(vectors) == 1 and np.dtype(vectors[0].dtype).kind in "iu":
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
    spec = next((s for s in dressing.policy.signature.inputs if s.role is Role.PREV_ACTION), None)
    if spec is None:
        return None
    if not generation.previous:
        return spec
    shape: tuple[int | None, ...] = (None, _columns(spec)) if generation.branches else (None,)
    dressing.give_in(spec, dressing.take("prev_action", spec, shape, INT32))
    return None


def _columns(previous: TensorSpec) -> int:
    return int(previous.shape[1] or 1) if len(previous.shape) > 1 else 1


def _take_memory(dressing: Dressing, carried: TensorSpec | None) -> int:
    """Take ``recurrent_in``: the policy's memory, and behind it the last action where that is ``carried``."""
    memory = dressing.policy.signature.memory
    if memory is None or memory.input is None:
        if carried is not None:
            dressing.refuse(
                f"nothing feeds its input {carried.name}",
                why="ML-Agents 0.1 and 0.2 do not feed the last action, and the policy has no memory to keep it in",
                fix="use a project of 0.3 or later (--for tfsharp-0.3)",
            )
        return 0
    if memory.output is None:
        feeding.refuse_lost_memory(dressing, memory.input)
    spec = dressing.policy.signature.input(memory.input)
    if carried is None:
        dressing.give_in(spec, dressing.take("recurrent_in", spec, (None, memory.size)))
        return memory.size
    size, builder = memory.size + _columns(carried), dressing.builder
    taken = dressing.take("recurrent_in", spec, (None, size))
    dressing.give_in(spec, builder.slice(taken, 1, 0, memory.size))
    dressing.give_in(carried, builder.slice(taken, 1, memory.size, size))
    dressing.notes.append(
        f"{dressing.profile} does not feed the last action: it is kept as the last number of the memory, "
        f"so that the Memory Size of the brain is {size}"
    )
    return size


def _give_action(dressing: Dressing, generation: Generation, found: Heads, masks: str | None) -> int:
    """Give ``action``; returns its width: continuous actions, or the sum of branches."""
    if found.continuous is not None:
        drawn, _, width = continuous_rows(dressing, found.continuous)
        dressing.give("action", drawn, Role.CONTINUOUS, found.continuous.source)
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
        dressing.give("action", log_probabilities(dressing, spec, scores), Role.LOG_PROBS, spec.source)
    else:
        role = Role.DETERMINISTIC if spec.role is Role.DETERMINISTIC else Role.SAMPLED
        dressing.give("action", samples(dressing, scores)[0], role, spec.source)
    return sum(scores.sizes)


def _beside(generation: Generation, found: Heads, width: int, size: int) -> list[Node]:
    """Nodes that the C# side looks up and that no other node reads."""
    constants: dict[str, int] = {}
    if size and generation.memory_constant:
        constants["memory_size"] = size
    if generation.version is not None:
        constants = {
            "version_number": generation.version,
            "memory_size": size,
            "is_continuous_control": int(found.continuous is not None),
            "action_output_shape": width,
        }
    nodes = [Node(name, "Const", value=np.array(value, np.int32)) for name, value in constants.items()]
    if size and generation.memory_constant and generation.version is None:
        nodes.append(Node("sequence_length", "Placeholder", attrs={"dtype": INT32, "shape": TensorShape(())}))
    return nodes
