"""Roles of a policy's inputs and outputs, their canonical names, and what ML-Agents called them.

Names by version: ML-Agents ``python/unitytrainers`` 0.1–0.5, ``mlagents/trainers`` 0.6–0.23 and its torch exporter
(``model_serialization.py``) from 0.20 on.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from enum import StrEnum
from typing import TypeAlias


class Role(StrEnum):
    """What a tensor is for. The value is what policy.json, ``--input`` and ``--output`` say."""

    # inputs
    VECTOR = "vector_observation"
    VISUAL = "visual_observation"
    ENTITIES = "variable_length_observation"
    NOISE = "noise"
    MASKS = "masks"
    PREV_ACTION = "prev_action"
    MEMORY_IN = "memory_in"
    PARAMETER = "parameter"
    # inputs that are removed on the way
    SEQUENCE_LENGTH = "sequence_length"
    BATCH_SIZE = "batch_size"
    # what ``action`` can mean
    CONTINUOUS = "continuous"
    SAMPLED = "sampled"
    LOG_PROBS = "log_probs"
    PROBS = "probs"
    DETERMINISTIC = "deterministic"
    # other outputs
    ACTION = "action"
    ACTION_PROBS = "action_probs"
    VALUE = "value_estimate"
    #: a value of each action of a discrete policy, [B, actions]: the action is the largest
    Q_VALUES = "q_values"
    MEMORY_OUT = "memory_out"
    #: the spread of a Gaussian policy whose action is the mean, [B, size]; and its logarithm
    STD = "std"
    LOG_STD = "log_std"
    #: the log-probability of the action that was taken, one number a row
    LOG_PROB = "log_prob"
    OTHER = "other"


OBSERVATIONS = (Role.VECTOR, Role.VISUAL, Role.ENTITIES)
#: As Unity orders sensors by the names that it gives them: BufferSensor, CameraSensor, VectorSensor.
SENSOR_ORDER = (Role.ENTITIES, Role.VISUAL, Role.VECTOR)
INPUT_ROLES = (
    *OBSERVATIONS,
    Role.NOISE,
    Role.MASKS,
    Role.PREV_ACTION,
    Role.MEMORY_IN,
    Role.PARAMETER,
    Role.SEQUENCE_LENGTH,
    Role.BATCH_SIZE,
)
OUTPUT_ROLES = (
    *(Role.ACTION, Role.ACTION_PROBS, Role.VALUE, Role.MEMORY_OUT),
    *(Role.Q_VALUES, Role.STD, Role.LOG_STD, Role.LOG_PROB, Role.OTHER),
)
#: Roles of outputs that say what is done.
ACTING = (Role.ACTION, Role.Q_VALUES)

#: Canonical names that are accepted in place of a role on the command line.
ALIASES = {
    "state": Role.VECTOR,
    "observation": Role.VISUAL,
    "entities": Role.ENTITIES,
    "epsilon": Role.NOISE,
    "action_masks": Role.MASKS,
    "recurrent_in": Role.MEMORY_IN,
    "recurrent_out": Role.MEMORY_OUT,
}

#: Name patterns of inputs (scope removed), with the ranks they may have (None: any), and who calls them so.
INPUT_PATTERNS: tuple[tuple[re.Pattern[str], Role, tuple[int, ...] | None, str], ...] = (
    (re.compile(r"state(_\d+)?"), Role.VECTOR, (1, 2), "ML-Agents 0.1 and 0.2"),
    (re.compile(r"vector_observation(_\d+)?"), Role.VECTOR, (1, 2), "ML-Agents 0.3 to 0.23"),
    (re.compile(r"obs_\d+"), Role.VECTOR, (2,), "ML-Agents from PyTorch on"),
    (re.compile(r"(visual_)?observation(_?\d+)?"), Role.VISUAL, (4,), "ML-Agents 0.1 to 0.23"),
    (re.compile(r"obs_\d+"), Role.VISUAL, (4,), "ML-Agents from PyTorch on"),
    (re.compile(r"obs_\d+|entities_\d+"), Role.ENTITIES, (3,), "ML-Agents from PyTorch on"),
    # PyTorch's own is input.1
    (re.compile(r"(actor_)?obs|observations?|inputs?(\.\d+)?"), Role.VECTOR, (2,), "trainers on PyTorch"),
    (re.compile(r"(actor_)?obs|observations?|inputs?(\.\d+)?"), Role.VISUAL, (4,), "trainers on PyTorch"),
    # lerobot 0.4 (utils/constants.py: OBS_STATE, OBS_ENV_STATE, OBS_IMAGE, OBS_IMAGES)
    (re.compile(r"observation\.(environment_)?state"), Role.VECTOR, (2, 3), "LeRobot"),
    (re.compile(r"observation\.images?(\..+)?"), Role.VISUAL, (4,), "LeRobot"),
    (re.compile(r"epsilon(_\d+)?"), Role.NOISE, None, "ML-Agents 0.1 to 0.23"),
    (re.compile(r"action_masks"), Role.MASKS, (2,), "ML-Agents"),
    (re.compile(r"prev_action"), Role.PREV_ACTION, (1, 2), "ML-Agents"),
    (re.compile(r"recurrent_in|memories"), Role.MEMORY_IN, (2, 3), "ML-Agents"),
    # 0.10 and 0.14 SAC name the placeholder sequence_length_1.
    (re.compile(r"sequence_length(_\d+)?"), Role.SEQUENCE_LENGTH, (0, 1), "ML-Agents 0.3 to 0.23"),
    (re.compile(r"batch_size(_\d+)?"), Role.BATCH_SIZE, (0, 1), "ML-Agents"),
)

#: Output names (scope removed) of the TensorFlow and torch generations.
OUTPUT_NAMES = {
    "action": Role.ACTION,
    "continuous_actions": Role.ACTION,
    "discrete_actions": Role.ACTION,
    "action_probs": Role.ACTION_PROBS,
    "value_estimate": Role.VALUE,
    "recurrent_out": Role.MEMORY_OUT,
    # Stable-Baselines3, CleanRL, and what this tool writes of any network that values actions
    "q_values": Role.Q_VALUES,
    # what this tool writes beside them, so that our own graphs are read back as what they were
    "action_log_probs": Role.LOG_PROBS,
    "deterministic_action": Role.DETERMINISTIC,
    "deterministic_continuous_actions": Role.DETERMINISTIC,
    "deterministic_discrete_actions": Role.DETERMINISTIC,
    "action_std": Role.STD,
    "action_log_std": Role.LOG_STD,
    "action_log_prob": Role.LOG_PROB,
}

#: What trainers and tutorials call the values of actions (CleanRL, Stable-Baselines3, Keras and TensorFlow.js games) …
Q_NAMES = re.compile(
    r"q|qs|q_?val(ue)?s?|q_?outs?|q_?outputs?|outputs?_q|q_?net(work)?|q_?func(tion)?|q_?head|d+qn(_outputs?|_head)?"
    r"|(state_)?action_?values?|(main|target|online|local|policy|eval)_q|q_(main|target|online|local|policy|eval)"
)
#: … and the value of a state, one number a row (CleanRL, rsl_rl, Stable-Baselines3, RLlib).
STATE_VALUE_NAMES = re.compile(
    r"v|vf|values?|value_estimate|v_?values?|state_?values?|critic|baseline|value_?(net(work)?|head|func(tion)?|outputs?)"
    r"|critic_?(net(work)?|head|values?|outputs?)|(value|vf)_?pred(iction)?s?"
)

#: What the action is called: alone, or (hybrid policies, torch exports) by its kind.
ACTION_NAMES = tuple(name for name, role in OUTPUT_NAMES.items() if role is Role.ACTION)

# What ML-Agents calls the constants in its graphs, which its players and checkers look up: memory_size from 0.3 on, the
# others from 0.6, the trainer's version from 0.17; the last two in torch's exports, 0.23 on.
VERSION_NUMBER, MEMORY_SIZE = "version_number", "memory_size"
IS_CONTINUOUS, ACTION_SHAPE = "is_continuous_control", "action_output_shape"
CONTINUOUS_SHAPE, DISCRETE_SHAPE = "continuous_action_output_shape", "discrete_action_output_shape"
TRAINER_VERSION = ("trainer_major_version", "trainer_minor_version", "trainer_patch_version")
CONSTANT_NAMES = (
    VERSION_NUMBER,
    IS_CONTINUOUS,
    MEMORY_SIZE,
    ACTION_SHAPE,
    *TRAINER_VERSION,
    CONTINUOUS_SHAPE,
    DISCRETE_SHAPE,
)

#: The constants that may hold several numbers: the sizes of the branches (a row of float32 in torch exports).
LISTED_CONSTANTS = (DISCRETE_SHAPE,)
#: What a constant is in policy.json.
Constant: TypeAlias = int | float | list[int]

#: Canonical names; numbered ones get ``_0``, ``_1``… or a suffix from the second on.
CANONICAL = {
    Role.NOISE: "epsilon",
    Role.MASKS: "action_masks",
    Role.PREV_ACTION: "prev_action",
    Role.MEMORY_IN: "recurrent_in",
    Role.MEMORY_OUT: "recurrent_out",
    Role.ACTION_PROBS: "action_probs",
    Role.VALUE: "value_estimate",
    Role.Q_VALUES: "q_values",
    Role.STD: "action_std",
    Role.LOG_STD: "action_log_std",
    Role.LOG_PROB: "action_log_prob",
}


def plain_name(name: str) -> str:
    """A tensor's name without scope, index and number, in small letters: ``net/QValues_1:0`` as q_values."""
    base = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=Q)(?=[A-Z][a-z])", "_", name.rpartition("/")[2].partition(":")[0])
    return re.sub(r"_\d+$", "", base.lower())


def canonical_name(role: Role, number: int, own: str) -> str:
    """The name of the ``number``-th (from 0) tensor of ``role``; ``own`` is the source's name, for parameters."""
    if role is Role.VECTOR:
        return "state" if number == 0 else f"state_{number}"
    if role is Role.VISUAL:
        return f"observation_{number}"
    if role is Role.ENTITIES:
        return f"entities_{number}"
    name = CANONICAL.get(role, own)
    return name if number == 0 or role in (Role.PARAMETER, Role.OTHER) else f"{name}_{number}"


def parse_role(text: str) -> Role | None:
    """The role that a word on the command line names, or None."""
    if text in ALIASES:
        return ALIASES[text]
    return Role(text) if text in Role._value2member_map_ else None


def numbers(constants: Mapping[str, Constant]) -> dict[str, int | float]:
    """The constants that are single numbers."""
    return {name: value for name, value in constants.items() if not isinstance(value, list)}
