"""A TorchScript module as a source: its ``forward``, translated op by op for one agent.

What a scripted module does not say is how long its input is: what reads it tells, and the program is walked through
again. Buffers that it writes to (``hidden_state[:] = h``) are its memory: an input and an output of their own.
"""

from __future__ import annotations

import ast
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from converters.files.fetch import Fetched
from converters.files.pickled_objects import Instance
from converters.files.torchscript_archive import ScriptArchive
from converters.files.unpickle import Tensor as Stored
from converters.formats.source import ReadOptions, SourceModel
from converters.formats.torchscript.code import Code
from converters.formats.torchscript.interpreter import Interpreter
from converters.formats.torchscript.machine import MEMORY_IN, MEMORY_OUT, Machine
from converters.formats.torchscript.values import LengthFoundError, Module, Tensor
from converters.policy.facts import DOUBLES_NARROWED, SourceFacts
from signatures.errors import NotAPolicyError, SourceError, UsageError
from signatures.roles import Role

_MAX_INPUTS, _MAX_AXES = 16, 5
#: Times that a program is walked through: once more for each length and for its memory.
_MOST_WALKS = 3 * _MAX_INPUTS
_FORWARD = "forward"
#: What the usual buffers of a memory are, as other sources call the parts of theirs.
_PARTS = {"hidden_state": "h", "cell_state": "c"}

Shape = tuple[int | None, ...]
Memory = dict[str, tuple[int, ...]]


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """The one policy of a module. Raises SourceError, UnsupportedOpError for what is outside of the known, UsageError,
    DamagedFileError, NotAPolicyError.
    """
    archive = ScriptArchive(given.data)
    if not isinstance(archive.value, Instance):
        raise NotAPolicyError("holds no module", why="torch.jit.save writes one", fix="give the module itself")
    module, code = Module(archive.value), Code(archive.code)
    names = _inputs(code.method(module.type_name, _FORWARD))
    shapes = _shapes(names, archive.traced, options.sensors)
    memory: Memory = {}
    budget = itertools.count()
    for _ in range(_MOST_WALKS):
        machine = Machine(archive, memory)
        try:
            result = _walk(Interpreter(code, machine, archive.constants, budget), machine, module, names, shapes)
        except LengthFoundError as found:
            number, axis = machine.place_of(found.symbol)
            shapes[number] = tuple(found.length if i == axis else d for i, d in enumerate(shapes[number]))
            continue
        written = machine.written_buffers()
        if written.keys() <= memory.keys():
            return [_model(given, machine, result, memory)]
        memory |= written
    raise SourceError(
        "its inputs and memory do not come to rest", why="each walk through its code finds more", fix="give --sensors"
    )


def _walk(
    interpreter: Interpreter, machine: Machine, module: Module, names: Sequence[str], shapes: Sequence[Shape]
) -> Any:
    inputs = [machine.input(name, i, shapes[i]) for i, name in enumerate(names)]
    return interpreter.call_method(module, _FORWARD, inputs)


def _inputs(forward: ast.FunctionDef) -> list[str]:
    """The names of the tensors that a module is given. Raises SourceError for what is no tensor."""
    parameters = forward.args.args[1:]
    needed = parameters[: len(parameters) - len(forward.args.defaults)]
    for parameter in needed:
        if not isinstance(parameter.annotation, ast.Name) or parameter.annotation.id != "Tensor":
            raise SourceError(
                f"its input {parameter.arg[:60]} is not a tensor",
                why="a policy is fed tensors",
                fix="wrap the module in one that takes tensors, and script that",
            )
    if not needed or len(needed) > _MAX_INPUTS:
        raise NotAPolicyError(
            f"its forward takes {len(needed)} tensors", why="a policy is fed its observations", fix="give a policy"
        )
    return [p.arg for p in needed]


def _shapes(names: Sequence[str], traced: Any, sensors: Sequence[tuple[int, ...]]) -> list[Shape]:
    """The shapes for one agent: as the user says, as it was traced, or one row of what is to be found out."""
    if sensors:
        if len(sensors) != len(names):
            raise UsageError(
                f"--sensors has {len(sensors)} shapes, and the module {len(names)} inputs",
                why=", ".join(names),
                fix="give one for each, in that order",
            )
        return [(1, *shape) for shape in sensors]
    inputs = traced.get(_FORWARD) if isinstance(traced, dict) else None
    inputs = inputs if isinstance(inputs, list | tuple) else []
    known = [i.shape for i in inputs if isinstance(i, Stored) and len(i.shape) <= _MAX_AXES]
    if len(known) == len(inputs) == len(names):
        return [(1, *shape[1:]) if len(shape) > 1 else shape for shape in known]
    return [(1, None)] * len(names)


def _model(given: Fetched, machine: Machine, result: Any, memory: Memory) -> SourceModel:
    machine.check_closed()
    machine.finish_memory(memory)
    outputs = [result] if isinstance(result, Tensor) else list(result) if isinstance(result, tuple) else []
    if not outputs or not all(isinstance(o, Tensor) for o in outputs):
        raise NotAPolicyError(
            f"its forward gives a {type(result).__name__}", why="an action is a tensor", fix="give a policy"
        )
    machine.b.prefix = "output"
    names = ["action"] if len(outputs) == 1 else [f"output_{i}" for i in range(len(outputs))]
    for name, output in zip(names, outputs, strict=True):
        machine.output(name, output.read())
    roles: dict[str, Role | None] = dict.fromkeys(names, Role.ACTION if len(names) == 1 else None)
    parts = [machine.name_of(key).rpartition(".")[2] for key in memory]
    facts = SourceFacts(
        roles={MEMORY_IN: Role.MEMORY_IN} if memory else {},
        family="TorchScript",
        algorithm="",
        image_layout="NCHW",
        memory_layout=tuple(_PARTS.get(part, part) for part in parts),
        outputs={**roles, **({MEMORY_OUT: Role.MEMORY_OUT} if memory else {})},
        notes=(
            "no runtime but PyTorch runs it: the verdict on the export is that its formats are self-consistent",
            *([DOUBLES_NARROWED] if machine.narrowed else []),
            *([_memory_note(machine, memory)] if memory else []),
        ),
    )
    return SourceModel(machine.b.graph(), (given.path,), facts)


def _memory_note(machine: Machine, memory: Mapping[str, tuple[int, ...]]) -> str:
    names = ", ".join(machine.name_of(key) for key in memory)
    firsts = [machine.first_value(key) for key in memory]
    zero = all(first is None or not np.any(first) for first in firsts)
    start = "zeros at the start of an episode" if zero else "as the file has it, it does not begin with zeros"
    return f"it keeps its memory inside ({names}); here that is {MEMORY_IN} and {MEMORY_OUT}: {start}"
