"""A TorchScript module as a source: its ``forward``, translated op by op for one agent.

What a scripted module does not say is how long its input is: what reads it tells, and the program is walked through
again. Buffers that it writes to (``hidden_state[:] = h``) are its memory: an input and an output of their own.
"""

from __future__ import annotations

import ast
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.files.fetch import Fetched
from export_model.converters.files.pickled_objects import Instance
from export_model.converters.files.torch_archive import Storage
from export_model.converters.files.torchscript_archive import ScriptArchive
from export_model.converters.files.unpickle import PickledTensor as Stored
from export_model.converters.formats.source import OriginalRun, ReadOptions, SourceModel
from export_model.converters.formats.torchscript.code import ArchiveCode
from export_model.converters.formats.torchscript.interpreter import Interpreter
from export_model.converters.formats.torchscript.machine import MEMORY_IN, MEMORY_OUT, Machine
from export_model.converters.formats.torchscript.values import LengthFoundError, Module, ScriptTensor, ShapeFoundError
from export_model.converters.graph.types import FLOAT32
from export_model.converters.policy.facts import DOUBLES_NARROWED, SourceFacts
from export_model.converters.policy.memories import part_of, stem_of
from export_model.signatures.errors import NotAPolicyError, SourceError, UnsupportedOpError, UsageError
from export_model.signatures.roles import Role

_MAX_INPUTS, _MAX_AXES = 16, 5
#: Times that a program is walked through: once more for each length and for its memory.
_MOST_WALKS = 3 * _MAX_INPUTS
_FORWARD = "forward"

Shape = tuple[int | None, ...]
Memory = dict[str, tuple[int, ...]]
#: [layers, agents, hidden].
_STATE_AXES = 3
#: What is fed as it is; of other types a trace is fed floats.
_FED = {np.dtype(name).name: np.dtype(name) for name in ("int32", "int64", "bool")}


class _Input(Struct, frozen=True):
    """A tensor that the module is given: its name, and shape and dtype for one agent."""

    name: str
    shape: Shape
    dtype: np.dtype[Any] = FLOAT32


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """The one policy of a module.

    Raises SourceError, UnsupportedOpError for what is outside of the known, UsageError, DamagedFileError,
    NotAPolicyError.
    """
    archive = ScriptArchive(given.data)
    if not isinstance(archive.value, Instance):
        raise NotAPolicyError("holds no module", why="torch.jit.save writes one", fix="give the module itself")
    module, code = Module(archive.value), ArchiveCode(archive.code)
    names = _inputs(code.method(module.type_name, _FORWARD))
    inputs = _given_inputs(names, archive.traced, options.sensors)
    memory: Memory = {}
    budget = itertools.count()
    for _ in range(_MOST_WALKS):
        machine = Machine(archive, memory)
        try:
            result = _walk(Interpreter(code, machine, archive.constants, budget), machine, module, inputs, memory)
        except LengthFoundError as found:
            number, axis = machine.place_of(found.symbol)
            known = tuple(found.length if i == axis else d for i, d in enumerate(inputs[number].shape))
            inputs[number] = replace(inputs[number], shape=known)
            continue
        except ShapeFoundError as found:
            inputs[found.number] = replace(inputs[found.number], shape=found.shape)
            continue
        except UnsupportedOpError as error:
            if archive.traced or options.sensors:
                raise
            fix = (
                f"where it observes more than a row of numbers, say so: --sensors 3x84x84 (one per input); {error.fix}"
            )
            raise UnsupportedOpError(error.what, why=error.why, fix=fix, issues=error.issues) from error
        outputs = _outputs(result)
        found_states = {x.name: _lengths_of(x.shape) for x in _states(machine, inputs, outputs) if x.name not in memory}
        written = machine.written_buffers()
        if not found_states and written.keys() <= memory.keys():
            model = _model(given, machine, outputs, memory, inputs)
            run = _original(given, machine, memory, inputs) if options.trust_source else None
            return [replace(model, original=run)]
        memory |= {**found_states, **written}
    raise SourceError(
        "its inputs and memory do not come to rest", why="each walk through its code finds more", fix="give --sensors"
    )


def _walk(interpreter: Interpreter, machine: Machine, module: Module, inputs: Sequence[_Input], memory: Memory) -> Any:
    given = [
        machine.state(x.name) if x.name in memory else machine.input(x.name, i, x.shape, x.dtype)
        for i, x in enumerate(inputs)
    ]
    return interpreter.call_method(module, _FORWARD, given)


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


def _given_inputs(names: Sequence[str], traced: Any, sensors: Sequence[tuple[int, ...]]) -> list[_Input]:
    """The inputs for one agent: as the user says, as it was traced, or one row of what is to be found out."""
    if sensors:
        if len(sensors) != len(names):
            raise UsageError(
                f"--sensors has {len(sensors)} shapes, and the module {len(names)} inputs",
                why=", ".join(names),
                fix="give one for each, in that order",
            )
        return [_Input(name, (1, *shape)) for name, shape in zip(names, sensors, strict=True)]
    inputs = traced.get(_FORWARD) if isinstance(traced, dict) else None
    inputs = inputs if isinstance(inputs, list | tuple) else []
    stored = [i for i in inputs if isinstance(i, Stored) and isinstance(i.storage, Storage)]
    known = [i for i in stored if len(i.shape) <= _MAX_AXES]
    if len(known) == len(inputs) == len(names):
        rows = known[0].shape[0] if known[0].shape else 1
        dtypes = [_FED.get(i.storage.dtype, FLOAT32) for i in known]
        return [
            _Input(name, _for_one_agent(i.shape, rows, dtype, first=i is known[0]), dtype)
            for name, i, dtype in zip(names, known, dtypes, strict=True)
        ]
    return [_Input(name, (1, None)) for name in names]


def _for_one_agent(shape: tuple[int, ...], rows: int, dtype: np.dtype[Any], *, first: bool) -> Shape:
    """The shape of one agent's, of that of ``rows``: whole numbers alone are one each, states are [layers, rows, …]."""
    if len(shape) < 2:
        return shape if dtype == FLOAT32 else (1,) * len(shape)
    if not first and len(shape) == _STATE_AXES and shape[1] == rows and (shape[0] != rows or rows == 1):
        return (shape[0], 1, shape[2])
    return (1, *shape[1:])


def _states(machine: Machine, inputs: Sequence[_Input], outputs: Sequence[ScriptTensor]) -> Sequence[_Input]:
    """The inputs that are given back: the last of them, where all outputs but the first have their shapes in order."""
    count = len(outputs) - 1
    if not 0 < count < len(inputs):
        return ()
    ends = inputs[-count:]
    same = [x.shape == machine.b.shape(o.read()) for x, o in zip(ends, outputs[1:], strict=True)]
    return ends if all(same) else ()


def _lengths_of(shape: Shape) -> tuple[int, ...]:
    return tuple(length for length in shape if length is not None)


def _outputs(result: Any) -> list[ScriptTensor]:
    """What forward gives. Raises NotAPolicyError."""
    outputs = [result] if isinstance(result, ScriptTensor) else list(result) if isinstance(result, tuple) else []
    if not outputs or not all(isinstance(o, ScriptTensor) for o in outputs):
        raise NotAPolicyError(
            f"its forward gives a {type(result).__name__}", why="an action is a tensor", fix="give a policy"
        )
    return outputs


def _model(
    given: Fetched, machine: Machine, outputs: Sequence[ScriptTensor], memory: Memory, inputs: Sequence[_Input]
) -> SourceModel:
    machine.check_closed()
    states = [x.name for x in inputs if x.name in memory]
    ends = outputs[-len(states) :] if states else []
    machine.finish_memory(memory, {name: end.read() for name, end in zip(states, ends, strict=True)})
    acting = outputs[: len(outputs) - len(states)]
    machine.b.prefix = "output"
    names = ["action"] if len(acting) == 1 else [f"output_{i}" for i in range(len(acting))]
    for name, output in zip(names, acting, strict=True):
        machine.output(name, output.read())
    roles: dict[str, Role | None] = dict.fromkeys(names, Role.ACTION if len(names) == 1 else None)
    inside = [key for key in memory if key not in states]
    parts = [_part_of(key if key in states else machine.name_of(key).rpartition(".")[2]) for key in memory]
    facts = SourceFacts(
        roles={MEMORY_IN: Role.MEMORY_IN} if memory else {},
        family="TorchScript",
        algorithm="",
        image_layout="NCHW",
        memory_layout=tuple(parts) if all(parts) else (),
        outputs={**roles, **({MEMORY_OUT: Role.MEMORY_OUT} if memory else {})},
        notes=(
            "no runtime but PyTorch runs it: unless --trust-source --verify torch does, its "
            "formats are compared with each other only (self-consistent)",
            *([DOUBLES_NARROWED] if machine.narrowed else []),
            *([_memory_note(machine, inside)] if inside else []),
            *([f"its states {', '.join(states)} are one row for each agent: {MEMORY_IN}"] if states else []),
        ),
    )
    return SourceModel(machine.b.graph(), (given.path,), facts)


def _original(given: Fetched, machine: Machine, memory: Memory, inputs: Sequence[_Input]) -> OriginalRun:
    """How PyTorch runs the file, whose code it then runs."""
    states = [x.name for x in inputs if x.name in memory]
    told = {
        "kind": "script",
        "inputs": [(x.name, x.shape) for x in inputs],
        "buffers": [(machine.name_of(key), shape) for key, shape in memory.items() if key not in states],
        "states": states,
    }
    return OriginalRun("torch", given.path, told)


def _part_of(name: str) -> str:
    """What a buffer or a state is, as other sources call the parts of theirs; its own name where that says nothing."""
    return part_of(stem_of(name)) or name


def _memory_note(machine: Machine, memory: Sequence[str]) -> str:
    names = ", ".join(machine.name_of(key) for key in memory)
    firsts = [machine.first_value(key) for key in memory]
    zero = all(first is None or not np.any(first) for first in firsts)
    start = "zeros at the start of an episode" if zero else "as the file has it, it does not begin with zeros"
    return f"it keeps its memory inside ({names}); here that is {MEMORY_IN} and {MEMORY_OUT}: {start}"
