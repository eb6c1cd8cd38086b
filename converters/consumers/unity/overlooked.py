"""What Unity's checks do not look at, and a player trips over: widths, the memory's shapes, outputs that are not there.

None of this is in the Inspector's list; all of it was accepted there, in files that do not act.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator, Mapping

from converters.consumers.unity.consumers import Consumer, Engine
from converters.consumers.unity.findings import Finding, Thrown, UnityThrows, warning
from converters.consumers.unity.model import (
    ACTION,
    CONTINUOUS,
    DETERMINISTIC,
    DISCRETE,
    DISCRETE_SHAPE,
    LAST_VERSION,
    MEMORY_SIZE,
    RECURRENT_IN,
    RECURRENT_OUT,
    CheckedModel,
)
from converters.consumers.unity.onnx_file import OnnxFile
from converters.consumers.unity.rules import MASKS, SEQUENCE
from converters.consumers.unity.settings import Brain

#: Value → shape, the batch first; None for a length that is not known.
Shapes = Mapping[str, tuple[int | None, ...]]
_INTEGERS = frozenset({2, 3, 4, 5, 6, 7, 9, 12, 13})  # TensorProto.DataType


def overlooked(
    model: CheckedModel,
    brain: Brain,
    fetched: Mapping[str, tuple[str, ...] | Thrown],
    silent: Collection[str],
    consumer: Consumer,
    file: OnnxFile | None = None,
) -> tuple[Finding, ...]:
    """All that is found, each once.

    ``fetched`` has a player's outputs by mode, ``silent`` the modes whose list is empty; ``file`` is there for an ONNX.
    """
    shapes = _shapes(file, consumer.strips_zero)
    profile = consumer.profile
    found = [
        *_outputs(model, fetched, profile),
        *_kinds(brain, {mode: names for mode, names in fetched.items() if mode in silent}),
    ]
    # a constant that is not there, or of another type, is in the verdict already
    with contextlib.suppress(UnityThrows):
        found += [*_widths(model, shapes, profile), *_masks(model, profile), *_memory(model, shapes, profile)]
        if file is not None and consumer.engine is Engine.SENTIS and model.version == LAST_VERSION:
            found += _types(file, consumer.strips_zero)
    if file is not None:
        found += _batches(file)
    return tuple(dict.fromkeys(found))


def _shapes(file: OnnxFile | None, strips_zero: bool) -> Shapes:
    if file is None:
        return {}
    return {n.removesuffix(":0") if strips_zero else n: shape for n, shape in file.shapes.items()}


def _outputs(model: CheckedModel, fetched: Mapping[str, tuple[str, ...] | Thrown], profile: str) -> Iterator[Finding]:
    for names in fetched.values():
        if isinstance(names, Thrown):
            text = f"a player throws {names.exception} when it looks for the outputs to fetch"
            yield warning(text, names.where, names.fix)
            continue
        for name in names:
            if name not in model.outputs and not (name == RECURRENT_OUT and model.memories):
                yield warning(
                    f"a player fetches the output {name}, which the file does not have",
                    f"output {name}",
                    f"name the output {name}; --for {profile} does",
                )


def _kinds(brain: Brain, fetched: Mapping[str, tuple[str, ...] | Thrown]) -> Iterator[Finding]:
    for mode, names in fetched.items():
        if isinstance(names, Thrown) or ACTION in names:
            continue
        for kind, wanted in ((CONTINUOUS, brain.continuous > 0), (DISCRETE, bool(brain.branches))):
            if wanted and not any(name.endswith(kind) for name in names):
                yield warning(
                    f"no {kind} are fetched ({mode} inference), and the agent has some: they stay 0",
                    f"output {kind}",
                    f"give the file {kind} for this mode, or take them off the agent",
                )


def _widths(model: CheckedModel, shapes: Shapes, profile: str) -> Iterator[Finding]:
    branches = model.constant(DISCRETE_SHAPE)
    expected = {CONTINUOUS: model.continuous_size}
    if model.version == LAST_VERSION and branches is not None:
        expected[DISCRETE] = len(branches)
    if not model.names_kinds:
        expected = {ACTION: model.continuous_size or model.discrete_size}
    for name, width in expected.items():
        for output in (name, DETERMINISTIC + name):
            shape = shapes.get(output, ())
            if output in model.outputs and width and shape and shape[-1] not in (None, width):
                yield warning(
                    f"the output {output} has {shape[-1]} columns, and the file's constant says {width}",
                    f"output {output}",
                    f"make the constant and the output agree; --for {profile} does",
                )


def _masks(model: CheckedModel, profile: str) -> Iterator[Finding]:
    for view in model.inputs:
        if view.name == MASKS and model.discrete_size and view.last not in (0, 1, model.discrete_size):
            yield warning(
                f"{MASKS} has {view.last} columns, and the branches together {model.discrete_size}",
                f"input {MASKS}",
                f"a mask has one column per action of each branch; --for {profile} writes it so",
            )


def _memory(model: CheckedModel, shapes: Shapes, profile: str) -> Iterator[Finding]:
    size = model.memory_size
    if RECURRENT_IN in shapes and RECURRENT_IN in model.input_names and not size:
        yield warning(
            f"the file has {RECURRENT_IN}, and {MEMORY_SIZE} is 0: no memory is kept from step to step",
            f"constant {MEMORY_SIZE}",
            f"set {MEMORY_SIZE} to the length of {RECURRENT_IN}; --for {profile} does",
        )
    for name in (RECURRENT_IN, RECURRENT_OUT):
        shape = shapes.get(name)
        there = name in model.input_names or name in model.outputs
        if size <= 0 or shape is None or not there:
            continue
        if len(shape) != 3 or shape[1] != 1 or shape[2] != size:
            yield warning(
                f"{name} is {_text(shape)}, and a memory of {MEMORY_SIZE} {size} is carried as [N, 1, {size}]",
                f"{'input' if name == RECURRENT_IN else 'output'} {name}",
                f"give {name} the shape [N, 1, {size}]; --for {profile} does",
            )


def _batches(file: OnnxFile) -> Iterator[Finding]:
    for given in file.inputs:
        if given.dims and len(given.dims) > 1 and (given.dims[0] or 0) > 0 and SEQUENCE not in given.name:
            yield warning(
                f"{given.name} is declared for {given.dims[0]} agents, and a player feeds as many as decide at once",
                f"input {given.name}",
                "leave the first length free; --names canonical and every --for do",
            )


def _types(file: OnnxFile, strips_zero: bool) -> Iterator[Finding]:
    for value in file.model.graph.output:
        name = value.name.removesuffix(":0") if strips_zero else value.name
        whole = value.type.tensor_type.elem_type in _INTEGERS
        for kind, wants_whole in ((CONTINUOUS, False), (DISCRETE, True)):
            if name in (kind, DETERMINISTIC + kind) and whole is not wants_whole:
                yield warning(
                    f"the output {name} is given out as {'integers' if whole else 'floats'}, and ML-Agents reads "
                    f"{'integers' if wants_whole else 'floats'} (not run)",
                    f"output {name}",
                    f"cast it to {'int64' if wants_whole else 'float32'}",
                )


def _text(shape: tuple[int | None, ...]) -> str:
    return f"[{', '.join(['N', *('?' if d is None else str(d) for d in shape[1:])])}]"
