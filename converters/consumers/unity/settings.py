"""The other half of a check: the agent's sensors and Behavior Parameters, as the scene has them."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec import field

from export_model.converters.files.fetch import read_bytes
from export_model.signatures.errors import UsageError
from export_model.signatures.fields import Record

#: Class of a sensor by the number of its axes, where nobody names it.
_CLASSES = {1: "VectorSensor", 2: "BufferSensor", 3: "CameraSensor"}
#: Sensors and branches that an agent has, bytes of the file that says so: it is untrusted.
_MOST, _MOST_BYTES = 1024, 1 << 20
_ACTIONS = "continuous:2, discrete:3,2 or continuous:2+discrete:3"


class Sensor(Record, frozen=True, rename={"kind": "type"}):
    """One sensor: its C# class and name, which stand in messages, and its shape.

    ``shape`` is [n] (a vector), [a, b] (a BufferSensor: at most a entities of b numbers) or [C, H, W] (a camera).
    """

    kind: str
    name: str
    shape: tuple[int, ...]

    @classmethod
    def of(cls, shape: Sequence[int], number: int = 0) -> Sensor:
        """A sensor of this shape, called as Unity calls one by default; ``number`` counts those of its kind."""
        kind = _CLASSES[len(shape)]
        name = f"VectorSensor_size{shape[0]}" if len(shape) == 1 else kind
        return cls(kind, name if len(shape) == 1 or not number else f"{name}{number}", tuple(shape))


class Brain(Record, frozen=True, omit_defaults=False):
    """What Behavior Parameters say (Space Size, Stacked Vectors, Continuous Actions, Branch Sizes), and the sensors."""

    continuous: int = 0
    branches: tuple[int, ...] = ()
    vector_observation_size: int = 0
    stacked: int = 1
    sensors: tuple[Sensor, ...] = field(default_factory=tuple)

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Brain:
        """The inverse; sensors without ``type`` or ``name`` get those of their shape. Raises ValueError."""
        unknown = set(entry) - {"continuous", "branches", "vector_observation_size", "stacked", "sensors"}
        if unknown:
            raise ValueError(f"{', '.join(sorted(unknown))} is not known")
        sensors: list[Sensor] = []
        listed = entry.get("sensors", [])
        if not isinstance(listed, list) or len(listed) > _MOST:
            raise ValueError(f"sensors: a list of {_MOST} or fewer is expected")
        for given in listed:
            shape = _sizes(given["shape"], "a sensor's shape")
            if len(shape) not in _CLASSES:
                raise ValueError(f"a sensor's shape has 1, 2 or 3 axes, not {len(shape)}")
            standard = Sensor.of(shape, sum(len(s.shape) == len(shape) for s in sensors))
            sensors.append(Sensor(str(given.get("type", standard.kind)), str(given.get("name", standard.name)), shape))
        size, stacked = entry.get("vector_observation_size", 0), entry.get("stacked", 1)
        return cls(
            continuous=_sizes([entry.get("continuous", 0)], "continuous")[0],
            branches=_sizes(entry.get("branches", []), "branches"),
            vector_observation_size=_sizes([size], "vector_observation_size")[0],
            stacked=_sizes([stacked], "stacked")[0],
            sensors=tuple(sensors),
        )


def sensors_of(shapes: Sequence[Sequence[int]]) -> tuple[Sensor, ...]:
    """Sensors of these shapes, in this order, with Unity's default names."""
    ranks = [len(shape) for shape in shapes]
    return tuple(Sensor.of(shape, ranks[:i].count(len(shape))) for i, shape in enumerate(shapes))


def parse_sensors(text: str) -> tuple[Sensor, ...]:
    """``"8,20x4,3x84x84"`` as a vector, a BufferSensor and a camera (C, H, W). Raises UsageError."""
    parts = [part.strip() for part in text.split(",") if part.strip()]
    for part in parts:
        if not re.fullmatch("[1-9][0-9]{0,6}(x[1-9][0-9]{0,6}){0,2}", part):
            raise UsageError(
                f"--sensors {text}: {part} is not the shape of a sensor",
                fix="one shape per sensor: 8 for a vector, 20x4 for a BufferSensor, 3x84x84 (C, H, W) for a camera",
            )
    return sensors_of([[int(n) for n in part.split("x")] for part in parts])


def parse_actions(text: str) -> tuple[int, tuple[int, ...]]:
    """``"continuous:2+discrete:3,2"`` as (continuous actions, branch sizes). Raises UsageError."""
    continuous = 0
    branches: tuple[int, ...] = ()
    for part in text.replace(" ", "").split("+"):
        kind, _, numbers = part.partition(":")
        if kind == "continuous" and re.fullmatch("[0-9]{1,6}", numbers):
            continuous = int(numbers)
        elif kind == "discrete" and re.fullmatch("[0-9]{1,6}(,[0-9]{1,6})*", numbers):
            branches = tuple(int(n) for n in numbers.split(","))
        else:
            raise UsageError(f"--actions {text}: {part or 'nothing'} is not a kind of actions", fix=f"give {_ACTIONS}")
    return continuous, branches


def read_brain(path: Path) -> Brain:
    """Behavior Parameters from a JSON file. Raises SourceError where it is missing, UsageError for its content."""
    try:
        entry = json.loads(read_bytes(path, most=_MOST_BYTES).decode("utf-8-sig"))
        if not isinstance(entry, dict):
            raise ValueError("an object is expected")
        return Brain.from_dict(entry)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise UsageError(
            "these are no Behavior Parameters",
            where=str(path),
            why=f"{type(error).__name__}: {error}",
            fix='give {"continuous": 2, "branches": [], "vector_observation_size": 8, "sensors": [{"shape": [8]}]}',
        ) from error


def _sizes(values: Any, what: str) -> tuple[int, ...]:
    if (
        not isinstance(values, list)
        or len(values) > _MOST
        or any(isinstance(v, bool) or not isinstance(v, int) or not 0 <= v < 1 << 31 for v in values)
    ):
        raise ValueError(f"{what}: whole numbers from 0 on are expected, not {str(values)[:80]}")
    return tuple(values)
