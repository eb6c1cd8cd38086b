"""What ML-Agents' C# side feeds, brought to what a policy takes: observations, masks, the last action, draws.

Sensors are fed in the order of their names, so that a policy of the TensorFlow trainers, which has its vectors joined
and its cameras numbered, gets buffers first, then cameras, then the vector (BufferSensor, CameraSensor, VectorSensor).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import NoReturn

import numpy as np
from msgspec.structs import replace

from export_model.converters.consumers.mlagents.names import MASKS, PREVIOUS
from export_model.converters.consumers.mlagents.naming import Dressing
from export_model.converters.graph.types import BATCH, FLOAT32, INT32
from export_model.signatures.roles import SENSOR_ORDER, Role
from export_model.signatures.spec import TensorSpec

_OBS = re.compile(r"(?:.*/)?obs_(\d+)(?::0)?")


def observation_names(dressing: Dressing) -> list[tuple[str, TensorSpec]]:
    """(``obs_i``, the policy's observation) by sensor: the numbers that the source has, else the order of sensors."""
    specs = dressing.policy.signature.observations
    numbers = [_OBS.fullmatch(s.source) if isinstance(s.source, str) else None for s in specs]
    if all(numbers) and len({m[1] for m in numbers if m}) == len(specs):
        return sorted(
            ((f"obs_{m[1]}", s) for m, s in zip(numbers, specs, strict=True) if m), key=lambda p: int(p[0][4:])
        )
    ranked = sorted(specs, key=lambda s: SENSOR_ORDER.index(s.role))
    if len(ranked) > 1 and {s.role for s in ranked} != {Role.VECTOR}:
        names = ", ".join(f"obs_{i} = {s.name}" for i, s in enumerate(ranked))
        dressing.notes.append(f"sensors are fed in the order of their names; this file takes {names}")
    return [(f"obs_{i}", s) for i, s in enumerate(ranked)]


def take_observation(dressing: Dressing, name: str, spec: TensorSpec, *, transposed: bool = False) -> None:
    """An input of the consumer for an observation: vectors [B, n], buffers [B, a, b], images [B, C, H, W].

    ``transposed``: the consumer writes a buffer's numbers one after the other into a tensor that holds [B, a, b] with
    its last two axes exchanged, so the model is given [B, a, b] back by a Transpose and a Reshape behind the input.
    """
    if spec.role is Role.VISUAL:
        take_image(dressing, name, spec, "NCHW")
        return
    shape = spec.shape if len(spec.shape) > 1 else (None, 1)
    sizes = [d for d in shape[1:] if d is not None]
    if len(sizes) < len(shape) - 1:
        _unknown_length(dressing, spec)
    if len(sizes) > 2:  # Unity takes three axes for an image
        _take_flat(dressing, name, spec)
        return
    taken = dressing.take(name, spec, (None, *sizes))
    if transposed and len(sizes) == 2 and min(sizes) > 1:
        builder = dressing.builder
        flat = builder.transpose(taken, (0, 2, 1))
        taken = builder.add("Reshape", [flat, builder.ints([-1, *sizes], "shape")], f"{spec.name}/as_written")
        dressing.notes.append(f"{name} is put in order behind the input, as this consumer writes it transposed")
    dressing.give_in(spec, taken)


def _take_flat(dressing: Dressing, name: str, spec: TensorSpec) -> None:
    """An input [B, n] for an observation of several axes, a history or a board."""
    sizes = [d or 0 for d in spec.shape[1:]]
    width, known = math.prod(sizes), dict(spec.distribution or {})
    for bound in ("low", "high", "mean", "std"):  # one for each number of the last axis
        if isinstance(known.get(bound), list):
            known[bound] = known[bound] * (width // sizes[-1])
    dressing.give_in(spec, dressing.take(name, replace(spec, distribution=known or None), (None, width)))
    shape = "x".join(map(str, sizes))
    dressing.notes.append(f"{name} takes the {shape} numbers of {spec.name} as a row, the last axis side by side")


#: Layout that the consumer has → the axes of an image of the other one in it, and the way back.
_TURNS = {"NCHW": ((2, 0, 1), (0, 2, 3, 1)), "NHWC": ((1, 2, 0), (0, 3, 1, 2))}


def take_image(dressing: Dressing, name: str, spec: TensorSpec, layout: str) -> None:
    """An input of the consumer for an image: [B, C, H, W], or as TensorFlow had it: [B, H, W, C]."""
    done: Mapping[str, object] = dressing.policy.signature.preprocess.get(spec.name, {})
    if len(spec.shape) != 4 or None in spec.shape[1:]:
        _unknown_length(dressing, spec)
    _, *sizes = spec.shape
    dressing.images[name] = {"layout": layout, "range": [0, 1], "from_bytes": "divide by 255"}
    same, (places, back) = done.get("layout", "NHWC") == layout, _TURNS[layout]
    tensor = dressing.take(name, spec, (None, *(sizes if same else (sizes[i] for i in places))))
    tensor = _as_colours(dressing, name, tensor, done)
    dressing.give_in(spec, tensor if same else dressing.builder.transpose(tensor, back))


def take_joined(dressing: Dressing, name: str, vectors: list[TensorSpec]) -> None:
    """One input for all vectors, which the C# side joins in the order of its sensors."""
    if len(vectors) == 1:
        if len(vectors[0].shape) > 2 and None not in vectors[0].shape[1:]:
            _take_flat(dressing, name, vectors[0])
        else:
            take_observation(dressing, name, vectors[0])
        return
    if any(None in s.shape[1:] for s in vectors):
        dressing.refuse(
            f"the shape of its observation {vectors[0].name} is {list(vectors[0].shape)}",
            why="vectors are fed as one row of a known width",
            fix="export the model again with all lengths but the batch fixed",
        )
    known = [math.prod(d or 1 for d in s.shape[1:]) for s in vectors]
    joined = TensorSpec(name, Role.VECTOR, "float32", (None, sum(known)), tuple(str(s.source) for s in vectors))
    taken = dressing.take(name, joined, (None, sum(known)))
    for number, (spec, width) in enumerate(zip(vectors, known, strict=True)):
        begin = sum(known[:number])
        dressing.give_in(spec, dressing.builder.slice(taken, 1, begin, begin + width))
    names = ", ".join(f"{s.name} ({w})" for s, w in zip(vectors, known, strict=True))
    dressing.notes.append(f"{name} is {names}, one behind the other")


def refuse_lost_memory(dressing: Dressing, name: str) -> NoReturn:
    """A memory that the source takes and does not give back."""
    dressing.refuse(
        f"its memory ({name}) is taken but not given back",
        why="recurrent_out was lost in the export of the source, so that every step would begin anew",
        fix="export from the checkpoint of the run, or from another of its files, which has the memory",
    )


def _as_colours(dressing: Dressing, name: str, tensor: str, done: Mapping[str, object]) -> str:
    """Colours as the policy takes them; ML-Agents gives 0 to 1."""
    colours = done.get("range")
    if not isinstance(colours, list) or colours[-1] != 255:
        return tensor
    dressing.notes.append(f"{name}: Unity gives colours of 0 to 1; this policy takes 0 to 255 and gets them times 255")
    builder = dressing.builder
    return builder.add("Mul", [tensor, builder.floats(255.0, "colours")], f"{name}/as_bytes")


def _unknown_length(dressing: Dressing, spec: TensorSpec) -> NoReturn:
    dressing.refuse(
        f"the shape of its observation {spec.name} is {list(spec.shape)}",
        why="the consumer compares the lengths of a sensor with those of the model's input",
        fix="export the model again with all lengths but the batch fixed",
    )


def take_masks(dressing: Dressing) -> str | None:
    """The input ``action_masks`` of a policy that has one; None where it has none."""
    spec = next((s for s in dressing.policy.signature.inputs if s.role is Role.MASKS), None)
    if spec is None:
        return None
    taken = dressing.take(MASKS, spec, (None, *spec.shape[1:]))
    dressing.give_in(spec, taken)
    return taken


def supply_masks(dressing: Dressing, width: int) -> str:
    """A new input ``action_masks`` [B, width] for a policy that has none."""
    spec = TensorSpec(MASKS, Role.MASKS, "float32", (None, width), None, {"kind": "mask", "allowed": 1, "forbidden": 0})
    dressing.notes.append("the policy had no masks: action_masks was added, and forbidden actions are not taken")
    return dressing.take(MASKS, spec, (None, width))


def take_previous_action(dressing: Dressing) -> None:
    """The input ``prev_action`` [B, branches], which ML-Agents feeds where a model has it."""
    for spec in dressing.policy.signature.inputs:
        if spec.role is Role.PREV_ACTION:
            dressing.give_in(spec, dressing.take(PREVIOUS, spec, (None, spec.shape[1] if len(spec.shape) > 1 else 1)))


def refuse_parameters(dressing: Dressing) -> None:
    """Inputs that nothing in Unity feeds."""
    unknown = [s.name for s in dressing.policy.signature.inputs if s.role is Role.PARAMETER]
    if unknown:
        dressing.refuse(
            f"nothing in Unity feeds its input {', '.join(unknown)}",
            why="ML-Agents feeds observations, action_masks, prev_action and recurrent_in",
            fix=f"say what it is (--input {unknown[0]}=ROLE), or give it a value (--set {unknown[0]}=VALUE)",
        )


def drawn_inside(dressing: Dressing, spec: TensorSpec) -> str:
    """N(0, 1) draws of the shape of an input of noise, made inside the graph."""
    builder = dressing.builder
    width = spec.shape[-1]
    if len(spec.shape) != 2 or width is None:
        dressing.refuse(
            f"its noise {spec.name} has the shape {list(spec.shape)}",
            why="draws are made inside the model, a row of a known width for each agent",
            fix="leave the noise out: --noise zero",
        )
    rows: tuple[object, ...] = (BATCH, width)
    like = next((r for r, k in reversed(builder.types.items()) if k.shape == rows and k.dtype == FLOAT32), None)
    if like is None:
        source = next(r for r, k in builder.types.items() if k.shape and k.shape[0] == BATCH and len(k.shape) == 2)
        like = builder.add(
            "MatMul",
            [builder.cast(source, FLOAT32), builder.floats(np.zeros((builder.length(source, 1), int(width or 0))))],
            f"{spec.name}/like",
        )
    shape = builder.add("Shape", [like], f"{spec.name}/shape", out_type=INT32)
    return builder.add("RandomStandardNormal", [shape], f"{spec.name}/drawn", dtype=FLOAT32)
