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

from export_model.converters.consumers.mlagents.names import (
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
from export_model.converters.consumers.unity import forms
from export_model.converters.consumers.unity.consumers import CONSUMERS, Engine
from export_model.converters.consumers.unity.scene import Scene, ScenePort
from export_model.signatures.roles import MEMORY_SIZE

#: Every observation that one of the agent's sensors is written into; every input but those of one number.
OBSERVATION, ANY = "(observation)", "(any input)"
BATCH = "batch_size"
#: Inputs that a player fills without a sensor.
FED = frozenset({MASKS, PREVIOUS, RECURRENT_IN, EPSILON, SEQUENCE, BATCH, VALUE})
ONE_NUMBER = frozenset({SEQUENCE, BATCH})
CONTINUOUS_ACTIONS = (CONTINUOUS, DETERMINISTIC + CONTINUOUS)
DISCRETE_ACTIONS = (DISCRETE, DETERMINISTIC + DISCRETE)
_ACTIONS = (*CONTINUOUS_ACTIONS, *DISCRETE_ACTIONS, ACTION)


class PlayOutcome(StrEnum):
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
    outcome: PlayOutcome
    when: Callable[[ScenePort, Scene], bool]
    says: str
    fix: str
    evidence: str = ""
    exception: str = ""


class ReleasePlayer(Struct, frozen=True):
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
        of=(RECURRENT_IN,),
        form=f"{MEMORY_SIZE} 0",
        outcome=PlayOutcome.WRONG,
        when=lambda port, scene: scene.model.memory_size == 0,
        says=f"{MEMORY_SIZE} is 0, so that no player fetches {RECURRENT_OUT}: {_NEVER}",
        fix=f"set {MEMORY_SIZE} to {{size}}, the length of {RECURRENT_IN}; --for {{profile}} does",
        evidence="mem_size_zero",
    ),
    Row(
        of=(RECURRENT_IN,),
        form=f"{MEMORY_SIZE} of another length",
        outcome=PlayOutcome.WARNS,
        when=lambda port, scene: scene.model.memory_size not in (0, port.size),
        says=f"{MEMORY_SIZE} says {{memory_size}} and {RECURRENT_IN} has {{size}} numbers: players go by the latter",
        fix=f"set {MEMORY_SIZE} to {{size}}",
        evidence="mem_size_small, mem_size_big",
    ),
)
_NARROW_OUTPUT = Row(
    of=_ACTIONS,
    form="fewer columns than the agent has actions",
    outcome=PlayOutcome.WRONG,
    when=forms.gives_too_few,
    says="{name} has {size} columns and the agent {wanted}: the rest stays 0",
    fix="make the constant, the output and the agent agree; --for {profile} does",
    evidence="cont_out_narrow",
)
_WIDE_OUTPUT = Row(
    of=_ACTIONS,
    form="more columns than the agent has actions",
    outcome=PlayOutcome.FIRST,
    when=forms.gives_too_many,
    says="{name} has {size} columns and the agent {wanted}",
    fix="make the constant, the output and the agent agree; --for {profile} does",
    evidence="cont_out_wide",
    exception=_INDEX,
)
_NO_MASKS = "{name} has {size} columns, and the agent's branches together {wanted} (not run)"
_MASKS_WIDTH = Row(
    of=(MASKS,),
    form="another number of columns",
    outcome=PlayOutcome.WARNS,
    when=forms.masks_of_another_size,
    says=_NO_MASKS,
    fix=f"a mask has one column per action of each branch; {_PROFILE}",
)

_SENTIS_INPUTS = (
    Row(
        of=(OBSERVATION,),
        form="fewer axes than the sensor: [N, 12] for a BufferSensor of 3x4",
        outcome=PlayOutcome.DIES,
        when=lambda port, scene: forms.lacks_axes(port),
        says="{name} is {shape}, and a sensor of {sensor} is written by {axes} axes: numbers land outside of the "
        "tensor",
        fix="declare {name} as {declare}, with a Reshape behind it",
        evidence="obs_rank2_for_buffer",
    ),
    Row(
        of=(OBSERVATION,),
        form="numbers outside of the last axes: [N, 4, 1, 1] for a vector",
        outcome=PlayOutcome.WRONG,
        when=lambda port, scene: forms.outside_last(port, len(port.sensor)),
        says="{name} is {shape}: with more than one agent their observations are written over each other",
        fix="declare {name} as {declare}, with a Reshape behind it",
        evidence="obs_rank4_for_vector",
    ),
    Row(
        of=(OBSERVATION,),
        form="narrower than the sensor",
        outcome=PlayOutcome.WARNS,
        when=lambda port, scene: port.size < forms.sensor_size(port),
        says="{name} holds {size} numbers and the sensor gives {wanted}: what is too much is written behind the "
        "agent's row, for the last agent behind the tensor",
        fix="set the sensor to what the file was trained with",
        evidence="obs_narrow",
    ),
    Row(
        of=(MASKS,),
        form="numbers outside of the last axis: [N, K, 1, 1]",
        outcome=PlayOutcome.WRONG,
        when=lambda port, scene: forms.outside_last(port, 1),
        says="{name} is {shape}: with more than one agent their masks are written over each other (read, not run)",
        fix="declare {name} as [N, {size}]",
    ),
    _MASKS_WIDTH,
    Row(
        of=(PREVIOUS,),
        form="float32",
        outcome=PlayOutcome.FIRST,
        when=lambda port, scene: bool(scene.brain.branches),
        says="{name} is written as integers into a tensor of floats: it cannot be used in this release",
        fix="carry the drawn action in the memory; --for {profile} does",
        evidence="prev_float",
        exception=_TO_INT,
    ),
    Row(
        of=(SEQUENCE, BATCH),
        form="float32",
        outcome=PlayOutcome.FIRST,
        when=lambda port, scene: True,
        says="{name} is written as an integer into a tensor of floats: it cannot be used in this release",
        fix="make it a constant, or take it from the shape of an observation; --for {profile} does",
        evidence="seq_float1, batch_float1",
        exception=_TO_INT,
    ),
    Row(
        of=(RECURRENT_IN,),
        form="[N, M]",
        outcome=PlayOutcome.WRONG,
        when=lambda port, scene: len(port.lengths) < 2,
        says=f"{{name}} is {{shape}}: {_NEVER}",
        fix=f"declare {RECURRENT_IN} and {RECURRENT_OUT} as [N, 1, {{size}}]; --for {{profile}} does",
        evidence="mem_NM",
    ),
    Row(
        of=(RECURRENT_IN,),
        form="[N, L, M] with several rows",
        outcome=PlayOutcome.WRONG,
        when=lambda port, scene: forms.outside_last(port, 1),
        says="{name} is {shape}: a player keeps the last axis alone (read, not run)",
        fix=f"join the rows: declare {RECURRENT_IN} and {RECURRENT_OUT} as [N, 1, {{size}}]; --for {{profile}} does",
    ),
    *_MEMORY,
    Row(
        of=(ANY,),
        form="a fixed batch",
        outcome=PlayOutcome.FIRST,
        when=lambda port, scene: bool(port.dims) and (port.dims or (None,))[0] is not None,
        says="{name} is declared for {batch} agents: with any other number deciding at once the player throws",
        fix="leave the first length free; --names canonical and every --for do",
        evidence="obs_fixed_batch, obs_fixed_batch2, mem_1NM",
        exception=f"{_ASSERT} Cannot set input tensor {{index}} as shapes are not compatible, expected {{expected}} "
        "received {received}",
    ),
)
_SENTIS_OUTPUTS = (
    Row(
        of=CONTINUOUS_ACTIONS,
        form="integers",
        outcome=PlayOutcome.FIRST,
        when=lambda port, scene: port.whole,
        says="{name} is given out as integers, and read as floats",
        fix="cast it to float32",
        evidence="cont_out_int32",
        exception=_TO_FLOAT,
    ),
    Row(
        of=DISCRETE_ACTIONS,
        form="floats",
        outcome=PlayOutcome.FIRST,
        when=lambda port, scene: not port.whole and port.dims is not None,
        says="{name} is given out as floats, and read as integers",
        fix="cast it to int64",
        evidence="disc_out_float, disc_out_double",
        exception=_TO_INT,
    ),
    Row(
        of=(RECURRENT_OUT,),
        form="integers",
        outcome=PlayOutcome.FIRST,
        when=lambda port, scene: port.whole,
        says="{name} is given out as integers, and read as floats",
        fix="cast it to float32",
        evidence="mem_out_int",
        exception=_TO_FLOAT,
    ),
    Row(
        of=(RECURRENT_OUT,),
        form="[N, M]",
        outcome=PlayOutcome.WRONG,
        when=lambda port, scene: port.dims is not None and len(port.dims) < 3,
        says=f"{{name}} is {{shape}}: {_NEVER}",
        fix="give out {name} as [N, 1, {size}]; --for {profile} does",
        evidence="mem_out_NM",
    ),
    Row(
        of=_ACTIONS,
        form="one axis: [N x A]",
        outcome=PlayOutcome.WRONG,
        when=lambda port, scene: port.dims is not None and len(port.dims) < 2,
        says="{name} has one axis: every action is 0",
        fix="give out {name} as [N, {wanted}]; --for {profile} does",
        evidence="cont_out_flat, disc_out_flat",
    ),
    Row(
        of=CONTINUOUS_ACTIONS,
        form="numbers outside of the last axis: [N, A, 1, 1]",
        outcome=PlayOutcome.WRONG,
        when=lambda port, scene: port.dims is not None and forms.outside_last(port, 1),
        says="{name} is {shape}: with more than one agent their actions are mixed",
        fix="give out {name} as [N, {wanted}]; --for {profile} does",
        evidence="cont_out_NA11",
    ),
    Row(
        of=DISCRETE_ACTIONS,
        form="numbers outside of the last axis: [N, B, 1, 1]",
        outcome=PlayOutcome.WARNS,
        when=lambda port, scene: port.dims is not None and forms.outside_last(port, 1),
        says="{name} is {shape}: it was seen to work where all agents do the same; continuous actions so given are "
        "mixed",
        fix="give out {name} as [N, {wanted}]; --for {profile} does",
        evidence="disc_out_NB11",
    ),
    _WIDE_OUTPUT,
    _NARROW_OUTPUT,
)

_LAID_OUT = "{name} is {shape}, which Barracuda lays out on another axis than the channels"
_BARRACUDA_OBSERVATIONS = (
    Row(
        of=(OBSERVATION,),
        form="less room than the sensor needs",
        outcome=PlayOutcome.FIRST,
        when=forms.written_outside,
        says="{name} holds {shape}, and a sensor of {sensor} is written beyond it",
        fix="set the sensor to what the file was trained with, and see how the importer lays out its input",
        evidence="obs_narrow; cases/gray_camera_barracuda-1.0",
        exception=_INDEX,
    ),
    Row(
        of=(OBSERVATION,),
        form="a picture of other lengths",
        outcome=PlayOutcome.WRONG,
        when=forms.turned_picture,
        says="{name} is laid out as {shape}, and a picture of {sensor} is written into it: rows and columns are mixed "
        "(read, not run)",
        fix="declare pictures as [N, C, H, W]; --for {profile} does",
    ),
    Row(
        of=(OBSERVATION,),
        form="entities read as the file declares them, [N, E, F], or of a file whose pictures are channels last",
        outcome=PlayOutcome.WRONG,
        when=forms.misreads_entities,
        says="{name} is {shape}, which Barracuda lays out {entities}",
        fix="put Transpose (0, 2, 1) and Reshape [-1, {sensor_lengths}] right behind the input; --for {profile} does",
        evidence="rank2_flat, rank2_per_entity, rank2_mul, r4/cam_buffer",
    ),
)
_BARRACUDA_MASKS = (
    Row(
        of=(MASKS,),
        form="[N, 1, K]",
        outcome=PlayOutcome.WRONG,
        when=lambda port, scene: forms.off_channels(port),
        says=f"{_LAID_OUT}: only the first action's mask arrives",
        fix=f"declare {{name}} as [N, {{size}}]; {_PROFILE}",
        evidence="mask_rank3",
    ),
    _MASKS_WIDTH,
)
_PREVIOUS_ACTIONS = Row(
    of=(PREVIOUS,),
    form="more columns than branches",
    outcome=PlayOutcome.FIRST,
    when=lambda port, scene: 0 < len(scene.brain.branches) < port.size,
    says="{name} has {size} columns, and the agent fewer branches",
    fix="give the agent {size} discrete branches",
    evidence="prev_wide",
    exception=_INDEX,
)
_BARRACUDA_INPUTS = (
    *_BARRACUDA_OBSERVATIONS,
    *_BARRACUDA_MASKS,
    _PREVIOUS_ACTIONS,
    Row(
        of=(RECURRENT_IN,),
        form="[1, N, M]",
        outcome=PlayOutcome.FIRST,
        when=lambda port, scene: port.dims is not None and len(port.dims) == 3 and None in port.dims[1:2],
        says="{name} is {shape}: the batch is the second axis, and the player throws with more than one agent",
        fix="declare it as [N, 1, M]; --for {profile} does",
        evidence="mem_1NM",
        exception=_INDEX,
    ),
    Row(
        of=(RECURRENT_IN,),
        form="[N, M]",
        outcome=PlayOutcome.WRONG,
        when=lambda port, scene: port.view is not None and port.view.channels > 1,
        says="{name} is {shape}: only the first number of the memory is kept",
        fix=f"declare {RECURRENT_IN} and {RECURRENT_OUT} as [N, 1, {{size}}]; --for {{profile}} does",
        evidence="mem_NM",
    ),
    *_MEMORY,
)
_BARRACUDA_ACTIONS = (
    Row(
        of=_ACTIONS,
        form="one axis, or columns on another axis than the second: [N, 1, A]",
        outcome=PlayOutcome.WRONG,
        when=forms.given_off_channels,
        says="{name} is {shape}: of each agent only the first action arrives",
        fix="give out {name} as [N, {wanted}]; --for {profile} does",
        evidence="cont_out_N1A, cont_out_flat, disc_out_N1B, disc_out_flat",
    ),
    _WIDE_OUTPUT,
    _NARROW_OUTPUT,
)
_BARRACUDA_OUTPUTS = (
    Row(
        of=(RECURRENT_OUT,),
        form="[N, M]",
        outcome=PlayOutcome.WRONG,
        when=lambda port, scene: port.dims is not None and len(port.dims) < 3,
        says="{name} is {shape}: only the first number of the memory is kept",
        fix="give out {name} as [N, 1, {size}]; --for {profile} does",
        evidence="mem_out_NM",
    ),
    *_BARRACUDA_ACTIONS,
)
_EARLIER_INPUTS = (
    *_BARRACUDA_OBSERVATIONS,
    *_BARRACUDA_MASKS,
    _PREVIOUS_ACTIONS,
    Row(
        of=(RECURRENT_IN,),
        form="a plain input",
        outcome=PlayOutcome.WRONG,
        when=lambda port, scene: True,
        says=f"nobody fetches {RECURRENT_OUT} before ML-Agents 2.0: {_NEVER} (read, not run)",
        fix="write a .nn, whose memories Barracuda keeps itself: --for {profile} --to nn",
    ),
)
_ABSENT = "KeyNotFoundException: The given key '{name}' was not present in the dictionary."

PLAYERS: Mapping[str, ReleasePlayer] = {
    player.name: player
    for player in (
        *(
            ReleasePlayer(
                release.name,
                _SENTIS_INPUTS,
                _SENTIS_OUTPUTS,
                f"{_ASSERT} Cannot peek output tensor {{name}} as model does not contain an output with that name",
                release.played,
            )
            for release in CONSUMERS.values()
            if release.engine is Engine.SENTIS
        ),
        ReleasePlayer("R20", _BARRACUDA_INPUTS, _BARRACUDA_OUTPUTS, _ABSENT, "run"),
        ReleasePlayer("2.0.1", _BARRACUDA_INPUTS, _BARRACUDA_OUTPUTS, _ABSENT, "run"),
        ReleasePlayer("1.9.1", _EARLIER_INPUTS, _BARRACUDA_ACTIONS, _ABSENT, "run in part, mostly read"),
        ReleasePlayer("1.0.8", _EARLIER_INPUTS, _BARRACUDA_ACTIONS, _ABSENT, "run with .nn, mostly read"),
    )
}
