"""The players of ML-Agents as tables: what comes of each form of an input or output, release by release.

A player is ML-Agents' own code that fills the inputs, runs the model, reads the outputs and keeps the memory. It is not
the checker: what the Inspector says nothing to may throw at the first decision, or act on the wrong numbers. Each row
was measured with a small model, named in ``evidence`` (87 of them, with one agent and with three, over three steps, in
each release); a row without one was read in ML-Agents' code, and says so.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import StrEnum

from msgspec import Struct

from converters.consumers.mlagents.names import (
    ACTION,
    CONTINUOUS,
    DETERMINISTIC,
    DISCRETE,
    EPSILON,
    MASKS,
    PREVIOUS,
    RECURRENT_IN,
    RECURRENT_OUT,
    SEQUENCE,
    VALUE,
)
from converters.consumers.unity import forms
from converters.consumers.unity.consumers import CONSUMERS, Engine
from converters.consumers.unity.scene import Port, Scene
from signatures.roles import MEMORY_SIZE

#: Every observation that one of the agent's sensors is written into; every input but those of one number.
OBSERVATION, ANY = "(observation)", "(any input)"
BATCH = "batch_size"
#: Inputs that a player fills without a sensor.
FED = frozenset({MASKS, PREVIOUS, RECURRENT_IN, EPSILON, SEQUENCE, BATCH, VALUE})
ONE_NUMBER = frozenset({SEQUENCE, BATCH})
CONTINUOUS_ACTIONS = (CONTINUOUS, DETERMINISTIC + CONTINUOUS)
DISCRETE_ACTIONS = (DISCRETE, DETERMINISTIC + DISCRETE)
_ACTIONS = (*CONTINUOUS_ACTIONS, *DISCRETE_ACTIONS, ACTION)


class Outcome(StrEnum):
    """What comes of playing a model, the worst first."""

    DIES = "the process dies"
    REFUSED = "refused at import"
    LOADING = "throws at loading"
    FIRST = "throws at the first decision"
    NOTHING = "no action comes out"
    WRONG = "silently wrong"
    WARNS = "plays, with a warning"


class Row(Struct, frozen=True):
    """A form of an input or an output, and what comes of it; ``form`` says it in words.

    ``when`` tells the form. ``exception`` is the class and text in Unity's words, with fields of ``forms.fields``, and
    so are ``says`` and ``fix``.
    """

    of: tuple[str, ...]
    form: str
    outcome: Outcome
    when: Callable[[Port, Scene], bool]
    says: str
    fix: str
    evidence: str = ""
    exception: str = ""


class Player(Struct, frozen=True):
    """The player of one release. ``absent`` is what it throws where an output that it fetches is not there.

    ``played`` says whether this very release was run, or its code read, or that of another release run in its place.
    """

    name: str
    inputs: tuple[Row, ...]
    outputs: tuple[Row, ...]
    absent: str
    played: str


_INDEX = "IndexOutOfRangeException: Index was outside the bounds of the array."
_ASSERT = "AssertionException: Assertion failure. Value was False"
UNKNOWN = "UnityAgentsException: Unknown tensorProxy expected as input : {name}"
_TO_INT = (
    "InvalidCastException: Unable to cast object of type '{namespace}.Tensor`1[System.Single]' "
    "to type '{namespace}.Tensor`1[System.Int32]'."
)
_TO_FLOAT = (
    "InvalidCastException: Unable to cast object of type '{namespace}.Tensor`1[System.Int32]' "
    "to type '{namespace}.Tensor`1[System.Single]'."
)
_NEVER = "the memory is always zero: nothing is kept from step to step"
_PROFILE = "--for {profile} writes it so"

#: The memory's size matters only in whether it is 0.
_MEMORY = (
    Row(
        (RECURRENT_IN,),
        f"{MEMORY_SIZE} 0",
        Outcome.WRONG,
        lambda port, scene: scene.model.memory_size == 0,
        f"{MEMORY_SIZE} is 0, so that no player fetches {RECURRENT_OUT}: {_NEVER}",
        f"set {MEMORY_SIZE} to {{size}}, the length of {RECURRENT_IN}; --for {{profile}} does",
        "mem_size_zero",
    ),
    Row(
        (RECURRENT_IN,),
        f"{MEMORY_SIZE} of another length",
        Outcome.WARNS,
        lambda port, scene: scene.model.memory_size not in (0, port.size),
        f"{MEMORY_SIZE} says {{memory_size}} and {RECURRENT_IN} has {{size}} numbers: players go by the latter",
        f"set {MEMORY_SIZE} to {{size}}",
        "mem_size_small, mem_size_big",
    ),
)
_NARROW_OUTPUT = Row(
    _ACTIONS,
    "fewer columns than the agent has actions",
    Outcome.WRONG,
    forms.gives_too_few,
    "{name} has {size} columns and the agent {wanted}: the rest stays 0",
    "make the constant, the output and the agent agree; --for {profile} does",
    "cont_out_narrow",
)
_WIDE_OUTPUT = Row(
    _ACTIONS,
    "more columns than the agent has actions",
    Outcome.FIRST,
    forms.gives_too_many,
    "{name} has {size} columns and the agent {wanted}",
    "make the constant, the output and the agent agree; --for {profile} does",
    "cont_out_wide",
    _INDEX,
)
_NO_MASKS = "{name} has {size} columns, and the agent's branches together {wanted} (not run)"
_MASKS_WIDTH = Row(
    (MASKS,),
    "another number of columns",
    Outcome.WARNS,
    forms.masks_of_another_size,
    _NO_MASKS,
    f"a mask has one column per action of each branch; {_PROFILE}",
)

_SENTIS_INPUTS = (
    Row(
        (OBSERVATION,),
        "fewer axes than the sensor: [N, 12] for a BufferSensor of 3x4",
        Outcome.DIES,
        lambda port, scene: forms.lacks_axes(port),
        "{name} is {shape}, and a sensor of {sensor} is written by {axes} axes: numbers land outside of the tensor",
        "declare {name} as {declare}, with a Reshape behind it",
        "obs_rank2_for_buffer",
    ),
    Row(
        (OBSERVATION,),
        "numbers outside of the last axes: [N, 4, 1, 1] for a vector",
        Outcome.WRONG,
        lambda port, scene: forms.outside_last(port, len(port.sensor)),
        "{name} is {shape}: with more than one agent their observations are written over each other",
        "declare {name} as {declare}, with a Reshape behind it",
        "obs_rank4_for_vector",
    ),
    Row(
        (OBSERVATION,),
        "narrower than the sensor",
        Outcome.WARNS,
        lambda port, scene: port.size < forms.sensor_size(port),
        "{name} holds {size} numbers and the sensor gives {wanted}: what is too much is written behind the agent's "
        "row, for the last agent behind the tensor",
        "set the sensor to what the file was trained with",
        "obs_narrow",
    ),
    Row(
        (MASKS,),
        "numbers outside of the last axis: [N, K, 1, 1]",
        Outcome.WRONG,
        lambda port, scene: forms.outside_last(port, 1),
        "{name} is {shape}: with more than one agent their masks are written over each other (read, not run)",
        "declare {name} as [N, {size}]",
    ),
    _MASKS_WIDTH,
    Row(
        (PREVIOUS,),
        "float32",
        Outcome.FIRST,
        lambda port, scene: bool(scene.brain.branches),
        "{name} is written as integers into a tensor of floats: it cannot be used in this release",
        "carry the drawn action in the memory; --for {profile} does",
        "prev_float",
        _TO_INT,
    ),
    Row(
        (SEQUENCE, BATCH),
        "float32",
        Outcome.FIRST,
        lambda port, scene: True,
        "{name} is written as an integer into a tensor of floats: it cannot be used in this release",
        "make it a constant, or take it from the shape of an observation; --for {profile} does",
        "seq_float1, batch_float1",
        _TO_INT,
    ),
    Row(
        (RECURRENT_IN,),
        "[N, M]",
        Outcome.WRONG,
        lambda port, scene: len(port.lengths) < 2,
        f"{{name}} is {{shape}}: {_NEVER}",
        f"declare {RECURRENT_IN} and {RECURRENT_OUT} as [N, 1, {{size}}]; --for {{profile}} does",
        "mem_NM",
    ),
    Row(
        (RECURRENT_IN,),
        "[N, L, M] with several rows",
        Outcome.WRONG,
        lambda port, scene: forms.outside_last(port, 1),
        "{name} is {shape}: a player keeps the last axis alone (read, not run)",
        f"join the rows: declare {RECURRENT_IN} and {RECURRENT_OUT} as [N, 1, {{size}}]; --for {{profile}} does",
    ),
    *_MEMORY,
    Row(
        (ANY,),
        "a fixed batch",
        Outcome.FIRST,
        lambda port, scene: bool(port.dims) and (port.dims or (None,))[0] is not None,
        "{name} is declared for {batch} agents: with any other number deciding at once the player throws",
        "leave the first length free; --names canonical and every --for do",
        "obs_fixed_batch, obs_fixed_batch2, mem_1NM",
        f"{_ASSERT} Cannot set input tensor {{index}} as shapes are not compatible, expected {{expected}} "
        "received {received}",
    ),
)
_SENTIS_OUTPUTS = (
    Row(
        CONTINUOUS_ACTIONS,
        "integers",
        Outcome.FIRST,
        lambda port, scene: port.whole,
        "{name} is given out as integers, and read as floats",
        "cast it to float32",
        "cont_out_int32",
        _TO_FLOAT,
    ),
    Row(
        DISCRETE_ACTIONS,
        "floats",
        Outcome.FIRST,
        lambda port, scene: not port.whole and port.dims is not None,
        "{name} is given out as floats, and read as integers",
        "cast it to int64",
        "disc_out_float, disc_out_double",
        _TO_INT,
    ),
    Row(
        (RECURRENT_OUT,),
        "integers",
        Outcome.FIRST,
        lambda port, scene: port.whole,
        "{name} is given out as integers, and read as floats",
        "cast it to float32",
        "mem_out_int",
        _TO_FLOAT,
    ),
    Row(
        (RECURRENT_OUT,),
        "[N, M]",
        Outcome.WRONG,
        lambda port, scene: port.dims is not None and len(port.dims) < 3,
        f"{{name}} is {{shape}}: {_NEVER}",
        "give out {name} as [N, 1, {size}]; --for {profile} does",
        "mem_out_NM",
    ),
    Row(
        _ACTIONS,
        "one axis: [N x A]",
        Outcome.WRONG,
        lambda port, scene: port.dims is not None and len(port.dims) < 2,
        "{name} has one axis: every action is 0",
        "give out {name} as [N, {wanted}]; --for {profile} does",
        "cont_out_flat, disc_out_flat",
    ),
    Row(
        CONTINUOUS_ACTIONS,
        "numbers outside of the last axis: [N, A, 1, 1]",
        Outcome.WRONG,
        lambda port, scene: port.dims is not None and forms.outside_last(port, 1),
        "{name} is {shape}: with more than one agent their actions are mixed",
        "give out {name} as [N, {wanted}]; --for {profile} does",
        "cont_out_NA11",
    ),
    Row(
        DISCRETE_ACTIONS,
        "numbers outside of the last axis: [N, B, 1, 1]",
        Outcome.WARNS,
        lambda port, scene: port.dims is not None and forms.outside_last(port, 1),
        "{name} is {shape}: it was seen to work where all agents do the same; continuous actions so given are mixed",
        "give out {name} as [N, {wanted}]; --for {profile} does",
        "disc_out_NB11",
    ),
    _WIDE_OUTPUT,
    _NARROW_OUTPUT,
)

_LAID_OUT = "{name} is {shape}, which Barracuda lays out on another axis than the channels"
_BARRACUDA_OBSERVATIONS = (
    Row(
        (OBSERVATION,),
        "less room than the sensor needs",
        Outcome.FIRST,
        forms.written_outside,
        "{name} holds {shape}, and a sensor of {sensor} is written beyond it",
        "set the sensor to what the file was trained with, and see how the importer lays out its input",
        "obs_narrow; cases/gray_camera_barracuda-1.0",
        _INDEX,
    ),
    Row(
        (OBSERVATION,),
        "a picture of other lengths",
        Outcome.WRONG,
        forms.turned_picture,
        "{name} is laid out as {shape}, and a picture of {sensor} is written into it: rows and columns are mixed "
        "(read, not run)",
        "declare pictures as [N, C, H, W]; --for {profile} does",
    ),
    Row(
        (OBSERVATION,),
        "entities read as the file declares them: [N, E, F]",
        Outcome.WRONG,
        forms.reads_entities_transposed,
        "{name} is {shape}, which Barracuda lays out transposed, and ML-Agents writes it flat: the model sees the "
        "observation transposed",
        "put Transpose (0, 2, 1) and Reshape [-1, {sensor_lengths}] right behind the input; --for {profile} does",
        "rank2_flat, rank2_per_entity, rank2_mul",
    ),
)
_BARRACUDA_MASKS = (
    Row(
        (MASKS,),
        "[N, 1, K]",
        Outcome.WRONG,
        lambda port, scene: forms.off_channels(port),
        f"{_LAID_OUT}: only the first action's mask arrives",
        f"declare {{name}} as [N, {{size}}]; {_PROFILE}",
        "mask_rank3",
    ),
    _MASKS_WIDTH,
)
_PREVIOUS_ACTIONS = Row(
    (PREVIOUS,),
    "more columns than branches",
    Outcome.FIRST,
    lambda port, scene: 0 < len(scene.brain.branches) < port.size,
    "{name} has {size} columns, and the agent fewer branches",
    "give the agent {size} discrete branches",
    "prev_wide",
    _INDEX,
)
_BARRACUDA_INPUTS = (
    *_BARRACUDA_OBSERVATIONS,
    *_BARRACUDA_MASKS,
    _PREVIOUS_ACTIONS,
    Row(
        (RECURRENT_IN,),
        "[1, N, M]",
        Outcome.FIRST,
        lambda port, scene: port.dims is not None and len(port.dims) == 3 and None in port.dims[1:2],
        "{name} is {shape}: the batch is the second axis, and the player throws with more than one agent",
        "declare it as [N, 1, M]; --for {profile} does",
        "mem_1NM",
        _INDEX,
    ),
    Row(
        (RECURRENT_IN,),
        "[N, M]",
        Outcome.WRONG,
        lambda port, scene: port.view is not None and port.view.channels > 1,
        "{name} is {shape}: only the first number of the memory is kept",
        f"declare {RECURRENT_IN} and {RECURRENT_OUT} as [N, 1, {{size}}]; --for {{profile}} does",
        "mem_NM",
    ),
    *_MEMORY,
)
_BARRACUDA_ACTIONS = (
    Row(
        _ACTIONS,
        "one axis, or columns on another axis than the second: [N, 1, A]",
        Outcome.WRONG,
        forms.given_off_channels,
        "{name} is {shape}: of each agent only the first action arrives",
        "give out {name} as [N, {wanted}]; --for {profile} does",
        "cont_out_N1A, cont_out_flat, disc_out_N1B, disc_out_flat",
    ),
    _WIDE_OUTPUT,
    _NARROW_OUTPUT,
)
_BARRACUDA_OUTPUTS = (
    Row(
        (RECURRENT_OUT,),
        "[N, M]",
        Outcome.WRONG,
        lambda port, scene: port.dims is not None and len(port.dims) < 3,
        "{name} is {shape}: only the first number of the memory is kept",
        "give out {name} as [N, 1, {size}]; --for {profile} does",
        "mem_out_NM",
    ),
    *_BARRACUDA_ACTIONS,
)
_EARLIER_INPUTS = (
    *_BARRACUDA_OBSERVATIONS,
    *_BARRACUDA_MASKS,
    _PREVIOUS_ACTIONS,
    Row(
        (RECURRENT_IN,),
        "a plain input",
        Outcome.WRONG,
        lambda port, scene: True,
        f"nobody fetches {RECURRENT_OUT} before ML-Agents 2.0: {_NEVER} (read, not run)",
        "write a .nn, whose memories Barracuda keeps itself: --for {profile} --to nn",
    ),
)
_ABSENT = "KeyNotFoundException: The given key '{name}' was not present in the dictionary."

PLAYERS: Mapping[str, Player] = {
    player.name: player
    for player in (
        *(
            Player(
                release.name,
                _SENTIS_INPUTS,
                _SENTIS_OUTPUTS,
                f"{_ASSERT} Cannot peek output tensor {{name}} as model does not contain an output with that name",
                release.played,
            )
            for release in CONSUMERS.values()
            if release.engine is Engine.SENTIS
        ),
        Player("R20", _BARRACUDA_INPUTS, _BARRACUDA_OUTPUTS, _ABSENT, "run"),
        Player("2.0.1", _BARRACUDA_INPUTS, _BARRACUDA_OUTPUTS, _ABSENT, "run"),
        Player("1.9.1", _EARLIER_INPUTS, _BARRACUDA_ACTIONS, _ABSENT, "run in part, mostly read"),
        Player("1.0.8", _EARLIER_INPUTS, _BARRACUDA_ACTIONS, _ABSENT, "run with .nn, mostly read"),
    )
}
