"""An actor's state dictionary as a graph: which generation it is of, and its parts put together as that computes them.

Source: mlagents/trainers/torch_entities/{networks,action_model,model_serialization}.py of 1.1.0, trainers/torch/…
before 0.30. What the weights say of a generation:

======== ============================================================================================
0.20     ``distribution.*`` and a step counter of floats (0.20, 0.21); the same lists as 0.22
0.22     ``distribution.*``; vectors joined before images (``vector_processors``, ``visual_processors``)
0.23     ``action_model.*``, the same lists
0.24     ``processors``, one list in the order of the sensors; attention over lists of entities
0.25     the list in an ``observation_encoder``, and again beside it
0.26     ``_body_endoder`` in place of ``linear_encoder``, ``version_number`` 3; the same up to 1.1
======== ============================================================================================

What they do not say is fixed: the activation (Swish), the clip of a continuous action (±3, divided by 3) for PPO and
POCA (none at all in 0.20 and 0.21), tanh for SAC, which alone has a deviation that depends on the observation
(``log_sigma.weight``); bound.py says what decides where they contradict each other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from export_model.converters.files.fetch import Fetched
from export_model.converters.graph.nn.activations import clip, leaky_relu, swish
from export_model.converters.policy.facts import SourceFacts
from export_model.converters.policy.generations import SAC_MEAN, TORCH_VERSION_3
from export_model.converters.policy.rules import RoleDecision
from export_model.converters.trainers.mlagents.body import attend, body_width, goal_width, hidden_layers
from export_model.converters.trainers.mlagents.bound import Bound, find_bound, trainer_of
from export_model.converters.trainers.mlagents.sensors import (
    SensorInput,
    dense_name,
    encoder_of,
    find_goals,
    find_sensors,
)
from export_model.converters.trainers.mlagents.state import State
from export_model.converters.trainers.pytorch.activations import LEAKY_SLOPE
from export_model.converters.trainers.pytorch.network import Network
from export_model.converters.trainers.pytorch.weights import pytorch_alone
from export_model.converters.trainers.trainer import Modules, Rebuilt
from export_model.signatures.roles import (
    ACTION_SHAPE,
    CONTINUOUS_SHAPE,
    DISCRETE_SHAPE,
    IS_CONTINUOUS,
    MEMORY_SIZE,
    VERSION_NUMBER,
    Role,
)

_BODY = "network_body"
#: Facts that the saver keeps among the weights; what of them is exported is computed from the weights here.
_FACTS = (
    "is_continuous_int",
    "act_size_vector",
    "continuous_act_size_vector",
    "discrete_act_size_vector",
    "memory_size_vector",
)


class _Generation(Struct, frozen=True):
    """Where things are in the state dictionary, and which versions put them there."""

    span: str
    version: int
    #: module lists of the sensors, in the order in which the first layer reads them
    lists: tuple[str, ...]
    body: str
    #: what holds the attention over entities
    encoder: str
    continuous: str
    discrete: str
    #: 0.20 and 0.21: no clip, other masks
    preview: bool = False

    @property
    def by_sensor(self) -> bool:
        """Whether each sensor is an input (``obs_0``, …)."""
        return self.version >= TORCH_VERSION_3

    @property
    def first(self) -> bool:
        """Whether the action is not named by its kind (0.22)."""
        return self.continuous == "distribution"


def _generation(state: State) -> _Generation:
    """What wrote the checkpoint. Raises SourceError for what is not read, by its name."""
    version = int(np.clip(np.nan_to_num(state.number(VERSION_NUMBER)), 0, 99))
    body = f"{_BODY}.linear_encoder"
    if state.under(f"{_BODY}._body_endoder."):  # a parameter like the number may have been trained, or drawn
        version, body = max(version, TORCH_VERSION_3), f"{_BODY}._body_endoder"
    encoder = f"{_BODY}.observation_encoder" if state.under(f"{_BODY}.observation_encoder.rsa.") else _BODY
    preview = state.step_is_float
    if state.under("distribution."):
        heads = ("distribution", "distribution")
    else:
        heads = ("action_model._continuous_distribution", "action_model._discrete_distribution")
    two: tuple[str, ...] = (f"{_BODY}.vector_processors.", f"{_BODY}.visual_processors.")
    one: tuple[str, ...] = (f"{_BODY}.processors.",)
    if version >= TORCH_VERSION_3:
        span, lists = "0.26-1.1", one
    elif heads[0] == "distribution":
        span, lists = "0.20-0.21" if preview else "0.22", two
    elif state.indices(two[0]) or state.indices(two[1]):
        span, lists = "0.23", two
    elif state.indices(f"{_BODY}.observation_encoder.processors."):
        span, lists = "0.25", one
    elif state.indices(f"{_BODY}.processors."):
        span, lists = "0.24", one
    else:
        span, lists = "0.23-0.25", one
    return _Generation(span, version, lists, body, encoder, *heads, preview=preview and heads[0] == "distribution")


def rebuild(state: State, given: Fetched, told: Sequence[tuple[int, ...]], goals: Sequence[int] = ()) -> Rebuilt:
    """The policy of the checkpoint ``given`` and what is known of it.

    ``told`` are the shapes of the sensors, where the user gives them, ``goals`` the places of those that are goals.
    Raises SourceError and its kinds, UsageError.
    """
    generation = _generation(state)
    state.forget(f"{_BODY}.observation_encoder.processors.")  # the same modules as processors
    state.forget(*_FACTS)
    width, condition = body_width(state, generation.body), goal_width(state, generation.body)
    sensors, joined = find_sensors(state, generation.lists, generation.encoder, width, told)
    goals = find_goals(state, sensors, condition, goals, joined=joined)
    net = Network(state)
    x, goal = _encode_sensors(net, generation, sensors, goals, told)
    x = hidden_layers(net, x, goal, generation.body)
    memory = None
    if f"{_BODY}.lstm.lstm.weight_hh_l0" in state:
        size = 2 * state.length(f"{_BODY}.lstm.lstm.weight_hh_l0", -1)
        x, memory = net.lstm(x, net.input("recurrent_in", 1, size), f"{_BODY}.lstm.lstm")
    net.fact(VERSION_NUMBER, np.array([generation.version]))
    net.fact(MEMORY_SIZE, np.array([0 if memory is None else net.width(memory)]))
    bound = find_bound(state, given, generation.continuous)
    names = _actions(net, generation, x, squashed=bound.squashed)
    if memory is not None:
        net.output("recurrent_out", memory)
        names.append("recurrent_out")
    state.check_all_read()
    facts = SourceFacts(
        family=f"ML-Agents {generation.span} (PyTorch)",
        algorithm=trainer_of(state),
        image_layout="NCHW",
        memory_layout=() if memory is None else ("h", "c"),
        outputs=dict.fromkeys((VERSION_NUMBER, MEMORY_SIZE, *names)),
        notes=tuple(_notes(generation, sensors, joined, bound)),
        decisions=_reasons(generation, sensors),
    )
    plain = generation.by_sensor and not told and goal is None and all(len(s.shape) == 1 for s in sensors)
    modules = _modules(state, generation, sensors, squashed=bound.squashed) if plain else None
    return Rebuilt(net.graph(), facts, bound.files, modules)


def _modules(state: State, generation: _Generation, sensors: Sequence[SensorInput], *, squashed: bool) -> Modules:
    """What PyTorch builds of a policy that observes rows of numbers alone."""
    told = {
        "sensors": [s.module for s in sensors],
        "body": f"{generation.body}.{'seq_layers' if state.indices(f'{generation.body}.seq_layers.') else 'layers'}",
        "branches": len(state.indices(f"{generation.discrete}.branches.")),
        "squashed": squashed,
    }
    return Modules("mlagents", state, told)


def _notes(generation: _Generation, sensors: Sequence[SensorInput], joined: bool, bound: Bound) -> list[str]:
    notes = [pytorch_alone("ML-Agents", "a checkpoint")]
    if bound.squashed and generation.by_sensor:
        notes.append(SAC_MEAN)
    notes.extend(bound.notes)
    vectors = [s for s in sensors if len(s.shape) == 1 and not s.places]
    if vectors and (joined or (not generation.by_sensor and (len(vectors) > 1 or len(generation.lists) > 1))):
        size = sum(s.shape[0] for s in vectors)
        notes.append(
            f"the checkpoint does not say how many vector sensors the {size} numbers come from; they are one input, "
            "in the order of the sensors; --sensors, a shape for each, makes an input of each"
        )
    return notes


# ------------------------------------------------------------------ observations


#: All vectors of 0.20 to 0.22, one behind the other.
_JOINED = "vector_observation"
_SENSOR_ROLES = {1: Role.VECTOR, 2: Role.ENTITIES, 3: Role.VISUAL}


def _input_names(generation: _Generation, sensors: Sequence[SensorInput]) -> list[str]:
    """What the generation calls the input of each sensor."""
    names, images = list[str](), 0
    for index, sensor in enumerate(sensors):
        image = len(sensor.shape) == 3
        by_number = generation.by_sensor or len(sensor.shape) == 2
        names.append(f"obs_{index}" if by_number else f"visual_observation_{images}" if image else _JOINED)
        images += image
    return names


def _reasons(generation: _Generation, sensors: Sequence[SensorInput]) -> dict[str, RoleDecision]:
    """Input → why it is an observation, and what of."""
    pairs = [(f"obs_{place}", s) for s in sensors for place in s.places]
    pairs = pairs or list(zip(_input_names(generation, sensors), sensors, strict=True))
    return {name: RoleDecision(name, _SENSOR_ROLES.get(len(s.shape), Role.VECTOR), s.says) for name, s in pairs}


def _sensor_inputs(
    net: Network, generation: _Generation, sensors: Sequence[SensorInput], told: Sequence[tuple[int, ...]]
) -> list[str]:
    """The numbers of each sensor: an input of its own, a slice of one for all vectors, or inputs joined."""
    if told:
        inputs = [net.input(f"obs_{place}", *shape) for place, shape in enumerate(told)]
        net.at(_BODY)
        return [net.concat([inputs[place] for place in sensor.places], 1) for sensor in sensors]
    widths = [s.shape[0] for s in sensors if len(s.shape) == 1]
    shared = net.input(_JOINED, sum(widths)) if widths and not generation.by_sensor else None
    found, start = list[str](), 0
    for sensor, name in zip(sensors, _input_names(generation, sensors), strict=True):
        if shared is None or len(sensor.shape) > 1:
            found.append(net.input(name, *sensor.shape))
            continue
        net.at(sensor.module or _BODY)
        end = start + sensor.shape[0]
        found.append(shared if len(widths) == 1 else net.slice(shared, 1, start, end))
        start = end
    return found


def _encode_sensors(
    net: Network,
    generation: _Generation,
    sensors: Sequence[SensorInput],
    goals: Sequence[int],
    told: Sequence[tuple[int, ...]],
) -> tuple[str, str | None]:
    """All sensors, encoded and joined: what the first layer reads; and the goals alone, where there are some."""
    parts: dict[int, str] = {}
    entities: list[tuple[str, str]] = []
    for index, (sensor, x) in enumerate(zip(sensors, _sensor_inputs(net, generation, sensors, told), strict=True)):
        if len(sensor.shape) == 2:
            assert sensor.module is not None
            entities.append((sensor.module, x))
            continue
        if sensor.module is not None:
            image = len(sensor.shape) == 3
            x = _image(net, x, sensor.module) if image else net.normalise(x, f"{sensor.module}.normalizer")
        parts[index] = x
    net.at(_BODY)
    columns = [net.concat(list(parts.values()), 1)] if parts else []
    if entities:
        columns.append(attend(net, columns[0] if columns else None, entities, generation.encoder))
    net.at(_BODY)
    return net.concat(columns, 1), net.concat([parts[i] for i in goals], 1) if goals else None


def _image(net: Network, x: str, module: str) -> str:
    """A visual encoder on an image [B, C, H, W]: its features [B, hidden]."""
    state = net.state
    encoder = encoder_of(state, module)
    assert encoder is not None
    net.at(module)
    if encoder.key == "fully_connected":
        flat = net.reshape(x, (-1, math.prod(net.length(x, axis) for axis in (1, 2, 3))))
    elif encoder.key == "resnet":
        flat = _resnet(net, net.nhwc(x), f"{module}.sequential")
        return net.add("Relu", [net.linear(flat, dense_name(state, module))])
    else:
        image = net.nhwc(x)
        for index, (_, stride) in enumerate(encoder.windows):
            image = leaky_relu(net, net.convolution(image, f"{module}.conv_layers.{2 * index}", stride), LEAKY_SLOPE)
        flat = net.flat(image)
    return leaky_relu(net, net.linear(flat, dense_name(state, module)), LEAKY_SLOPE)


def _resnet(net: Network, image: str, module: str) -> str:
    """Three stacks of a convolution, a pool and two residual blocks; a Swish at the end."""
    for stack in range(3):
        first = 4 * stack
        image = net.max_pool(net.convolution(image, f"{module}.{first}", 1, "SAME"))
        for block in (first + 2, first + 3):
            inner = net.convolution(swish(net, image), f"{module}.{block}.layers.1", 1, "SAME")
            inner = net.convolution(swish(net, inner), f"{module}.{block}.layers.3", 1, "SAME")
            image = net.add("Add", [image, inner])
    return net.flat(swish(net, image))


# ------------------------------------------------------------------ actions


def _actions(net: Network, generation: _Generation, x: str, *, squashed: bool) -> list[str]:
    """The outputs that act, by the names of the generation; the continuous ones are ``squashed`` by tanh, as SAC's."""
    names: list[str] = []
    made: dict[str, str] = {}
    if f"{generation.continuous}.mu.weight" in net.state:
        mean, draw = net.gaussian(x, generation.continuous)
        if squashed:
            value = net.add("Tanh", [draw])
        else:
            value = draw if generation.preview else net.add("RealDiv", [clip(net, draw, -3, 3), net.floats(3)])
        made["continuous"] = value
        size = net.width(mean)
        if not generation.first:
            net.output("continuous_actions", value)
            net.fact(CONTINUOUS_SHAPE, np.array([size]))
            names += ["continuous_actions", CONTINUOUS_SHAPE]
            if squashed and generation.by_sensor:
                net.output("deterministic_continuous_actions", mean)
                names.append("deterministic_continuous_actions")
    branches = [f"{generation.discrete}.branches.{i}" for i in net.state.indices(f"{generation.discrete}.branches.")]
    if branches:
        value, sizes = _discrete(net, generation, x, branches)
        made["discrete"] = value
        if not generation.first:
            net.output("discrete_actions", value)
            shape = np.array([sizes]) if generation.by_sensor else np.array([sum(sizes)])
            net.fact(DISCRETE_SHAPE, shape)
            names += ["discrete_actions", DISCRETE_SHAPE]
    if not made:
        raise net.state.damaged_error("its Policy has no action", "neither a mean nor a branch is in it")
    if not generation.by_sensor and len(made) == 1:  # 0.22 to 0.25 called the one action by its old name, too
        kind, value = next(iter(made.items()))
        net.output("action", value)
        net.fact(IS_CONTINUOUS, np.array([kind == "continuous"]))
        net.fact(ACTION_SHAPE, np.array([net.width(value)]))
        names = ["action", IS_CONTINUOUS, ACTION_SHAPE, *names]
    return names


def _discrete(net: Network, generation: _Generation, x: str, branches: Sequence[str]) -> tuple[str, list[int]]:
    """Up to 0.25 log-probabilities [B, ΣB], from 0.26 on drawn actions [B, branches] (int64); and the branch sizes."""
    sizes = [net.state.length(f"{b}.weight", 0) for b in branches]
    masks = net.input("action_masks", sum(sizes))
    parts, start = [], 0
    for branch, size in zip(branches, sizes, strict=True):
        probs = net.branch(x, branch, masks, start, twice=generation.first, preview=generation.preview)
        start += size
        if generation.by_sensor:
            parts.append(net.choice(net.add("Log", [probs])))
        else:
            parts.append(net.add("Log", [probs]) if generation.preview else net.log(probs))
    return net.concat(parts, 1), sizes
