"""What Sentis and the Inference Engine hold after importing an ONNX: shapes as they are, float or int.

ML-Agents runs the model once on zeros and reads its constants from the **outputs**, as float tensors (the deprecated
pair as int tensors); a wrong type is an InvalidCastException. Outputs are found by a part of their name. A free length
counts as 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from functools import cached_property
from typing import ClassVar

import numpy as np

from converters.targets.unity.barracuda_model import trimmed
from converters.targets.unity.consumers import Consumer
from converters.targets.unity.findings import Thrown, UnityThrows, null_reference
from converters.targets.unity.model import (
    ACTION_SHAPE,
    CONTINUOUS,
    CONTINUOUS_SHAPE,
    DISCRETE,
    DISCRETE_SHAPE,
    IS_CONTINUOUS,
    MEMORY_SIZE,
    VERSION,
    CheckedModel,
    InputView,
    action_output,
    truncated,
)
from converters.targets.unity.onnx_file import Dims, OnnxFile
from signatures.records import dataclass

_SINGLE, _INT32 = "Single", "Int32"


@dataclass(frozen=True)
class SentisModel(CheckedModel):
    """A model in Sentis; ``values`` are the outputs that are read as constants, with their type."""

    by_substring: ClassVar[bool] = True

    inputs: tuple[InputView, ...]
    outputs: tuple[str, ...]
    values: Mapping[str, np.ndarray] = field(default_factory=dict)
    namespace: str = "Unity.Sentis"
    memories: tuple[str, ...] = ()

    def load(self, deterministic: bool) -> None:
        """Read what ML-Agents reads at once when it loads a model, in its order; raises what that throws."""
        for _ in (
            self.version,
            self.has_continuous(deterministic),
            self.has_discrete(deterministic),
            self.memory_size,
            self.continuous_size,
            self.discrete_size,
        ):
            pass

    def constant(self, name: str) -> np.ndarray | None:
        """An output's numbers by its whole name."""
        found = self.values.get(name)
        return None if found is None else found.astype(np.float64).ravel()

    def _read(self, name: str, wanted: str) -> np.ndarray | None:
        """An output as a tensor of one type; InvalidCastException where it has the other."""
        found = self.values.get(name)
        if found is None:
            return None
        held = _SINGLE if found.dtype.kind == "f" else _INT32
        if held != wanted:
            tensor = f"{self.namespace}.Tensor`1[System.{{}}]"
            raise UnityThrows(
                Thrown(
                    "InvalidCastException",
                    f"Unable to cast object of type '{tensor.format(held)}' to type '{tensor.format(wanted)}'.",
                    f"constant {name}",
                    f"give out {name} as {'float32' if wanted == _SINGLE else 'int32'}",
                )
            )
        return found.ravel()

    def _number(self, name: str) -> int | None:
        found = self._read(name, _SINGLE)
        return None if found is None or not found.size else truncated(found[0])

    def _deprecated(self, name: str) -> int:
        found = self._read(name, _INT32)
        if found is None:
            raise UnityThrows(null_reference(f"constant {name}", f"name the actions {CONTINUOUS} or {DISCRETE}"))
        return truncated(found[0]) if found.size else 0

    @cached_property
    def version(self) -> int:
        """The API version; −1 where there is none, or none above 0."""
        number = self._number(VERSION)
        return number if number is not None and number > 0 else -1

    @cached_property
    def memory_size(self) -> int:
        """The memory's size; 0 where the file does not say it."""
        return self._number(MEMORY_SIZE) or 0

    def has_continuous(self, deterministic: bool) -> bool:
        """By output and shape, or by ``is_continuous_control``."""
        if not self.names_kinds:
            return self._deprecated(IS_CONTINUOUS) > 0
        return self.has_output(action_output(CONTINUOUS, deterministic)) and (self._number(CONTINUOUS_SHAPE) or 0) > 0

    def has_discrete(self, deterministic: bool) -> bool:
        """By output and shape, or by ``is_continuous_control``."""
        if not self.names_kinds:
            return self._deprecated(IS_CONTINUOUS) == 0
        return self.has_output(action_output(DISCRETE, deterministic)) and self.discrete_size > 0

    @property
    def continuous_size(self) -> int:
        """The number of continuous actions in the file's constants."""
        if not self.names_kinds:
            return self._deprecated(ACTION_SHAPE) if self._deprecated(IS_CONTINUOUS) > 0 else 0
        return self._number(CONTINUOUS_SHAPE) or 0

    @property
    def discrete_size(self) -> int:
        """The sum of the branches in the file's constants."""
        if not self.names_kinds:
            return 0 if self._deprecated(IS_CONTINUOUS) > 0 else self._deprecated(ACTION_SHAPE)
        shape = self._read(DISCRETE_SHAPE, _SINGLE)
        return 0 if shape is None else sum(truncated(n) for n in shape)


def of_onnx(file: OnnxFile, consumer: Consumer) -> SentisModel:
    """The model that the importer makes; ``importing.refusal`` has said before that it takes the file."""

    def name_of(name: str) -> str:
        return trimmed(name) if consumer.strips_zero else name

    read = (VERSION, MEMORY_SIZE, CONTINUOUS_SHAPE, DISCRETE_SHAPE, IS_CONTINUOUS, ACTION_SHAPE)
    values = {name_of(n): file.trial_value(n) for n in file.outputs if name_of(n) in read}
    return SentisModel(
        tuple(_input(name_of(i.name), i.dims or ()) for i in file.inputs),
        tuple(name_of(n) for n in file.outputs),
        {name: value for name, value in values.items() if value is not None},
        consumer.namespace,
    )


def _input(name: str, dims: Dims) -> InputView:
    lengths = [1 if d is None or d < 0 else d for d in dims]
    rank = len(lengths)
    return InputView(
        name,
        height=lengths[-2] if rank > 3 else 1,
        width=lengths[-1] if rank > 2 else 1,
        channels=lengths[1] if rank > 1 else 1,
        last=lengths[-1] if lengths else 1,
    )
