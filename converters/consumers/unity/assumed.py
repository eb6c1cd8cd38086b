"""The agent that a file seems made for, where nobody says which: its sensors and actions from inputs and constants."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Sequence

from export_model.converters.consumers.mlagents.names import EPSILON, MASKS, PREVIOUS, RECURRENT_IN, SEQUENCE, VECTOR
from export_model.converters.consumers.unity.findings import UnityThrows
from export_model.converters.consumers.unity.model import FIRST_VERSION, CheckedModel, InputView, truncate
from export_model.converters.consumers.unity.onnx_file import OnnxFile
from export_model.converters.consumers.unity.settings import Brain, sensors_of
from export_model.converters.formats.barracuda.format import NnModel, four_axes
from export_model.signatures.roles import DISCRETE_SHAPE, VERSION_NUMBER

_NOT_SENSED = frozenset({MASKS, PREVIOUS, EPSILON, SEQUENCE, RECURRENT_IN})
#: Cameras have up to so many channels.
_COLOURS = 4
_NUMBERED = re.compile("(?:visual_observation|obs)_([0-9]{1,6})")


def assumed_brain(model: CheckedModel, ranks: Sequence[int]) -> Brain:
    """Behavior Parameters that fit the file; ``ranks`` are the numbers of axes of its inputs, the batch included.

    Sensors are in the order of their numbers, a ``vector_observation`` last, as Unity sorts sensors by name.
    """
    sensed = []
    vector = 0
    for position, (view, rank) in enumerate(zip(model.inputs, ranks, strict=True)):
        if view.name in _NOT_SENSED or not 2 <= rank <= 4:
            continue
        entities = (view.width, view.channels) if view.kept else (view.channels, view.width)
        shapes = {2: (view.channels,), 3: entities, 4: _picture(view)}
        numbered = _NUMBERED.fullmatch(view.name)
        vector = view.channels if view.name == VECTOR else vector
        order = (0, int(numbered[1])) if numbered else (2 if view.name == VECTOR else 1, position)
        sensed.append((order, shapes[rank]))
    previous = next((view.last for view in model.inputs if view.name == PREVIOUS), 1)
    continuous, branches = _actions(model, previous)
    sensors = sensors_of([shape for _, shape in sorted(sensed)])
    return Brain(continuous, branches, vector, 1, sensors)


def _picture(view: InputView) -> tuple[int, ...]:
    """C, H, W of a camera; where the last length is that of colours and the first is not, the file is NHWC."""
    if view.width <= _COLOURS < view.channels:
        return view.width, view.channels, view.height
    return view.channels, view.height, view.width


def onnx_ranks(file: OnnxFile, model: CheckedModel) -> list[int]:
    """The numbers of axes of the inputs that the runtime kept."""
    ranks = {name: len(i.dims or ()) for i in file.inputs for name in (i.name, i.name.removesuffix(":0"))}
    return [ranks.get(view.name, 0) for view in model.inputs]


def nn_ranks(model: NnModel) -> list[int]:
    """A ``.nn`` has four axes everywhere; a vector is one with height and width 1, a list of entities has height 1."""
    shapes = [four_axes(i.shape, f"input {i.name!r}") for i in model.inputs]
    return [2 if shape[1:3] == (1, 1) else 3 if shape[1] == 1 else 4 for shape in shapes]


def _actions(model: CheckedModel, previous: int) -> tuple[int, tuple[int, ...]]:
    """(continuous actions, branches); a file of version 2 says the sum of the latter, and by ``previous`` how many."""
    continuous = together = 0
    with contextlib.suppress(UnityThrows):
        continuous = max(model.continuous_size, 0)
    with contextlib.suppress(UnityThrows):
        together = max(model.discrete_size, 0)
    version, branches = model.constant(VERSION_NUMBER), model.constant(DISCRETE_SHAPE)
    single = version is not None and bool(version.size) and truncate(version[0]) == FIRST_VERSION
    if not single and branches is not None:
        return continuous, tuple(max(truncate(n), 0) for n in branches)
    each, left = divmod(together, max(previous, 1))
    return continuous, tuple(each + (i < left) for i in range(max(previous, 1))) if together >= previous else ()
