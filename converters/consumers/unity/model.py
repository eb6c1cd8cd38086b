"""What ML-Agents' checkers ask of an imported model, whichever runtime imported it."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import numpy as np
from msgspec import Struct

from export_model.converters.consumers.mlagents.names import ACTION, CONTINUOUS, DETERMINISTIC, DISCRETE, RECURRENT_OUT
from export_model.signatures.roles import (
    ACTION_SHAPE,
    CONTINUOUS_SHAPE,
    DISCRETE_SHAPE,
    IS_CONTINUOUS,
)

#: Lowest and highest API version that release 17 and later load.
FIRST_VERSION, LAST_VERSION = 2, 3
_MOST_NEGATIVE = -(1 << 31)


class InputView(Struct, frozen=True):
    """An input as the checker reads it: lengths by Unity's names for axes, 0 or 1 for those the file leaves free.

    ``last`` is the length of the last axis as the runtime orders them; ``kept``: it orders them as the file does,
    channels last.
    """

    name: str
    height: int
    width: int
    channels: int
    last: int
    kept: bool = False


class CheckedModel:
    """An imported model. What raises says so: ``UnityThrows`` with the exception that Unity throws there."""

    #: What is called missing when nothing of that name is there.
    inputs: tuple[InputView, ...] = ()
    outputs: tuple[str, ...] = ()
    memories: tuple[str, ...] = ()
    #: Whether outputs are found by a part of their name.
    by_substring: ClassVar[bool] = False

    @abstractmethod
    def constant(self, name: str) -> np.ndarray | None:
        """A constant's values, one after the other; None where there is none of that name."""

    @property
    @abstractmethod
    def version(self) -> int:
        """The API version."""

    @property
    @abstractmethod
    def memory_size(self) -> int:
        """The memory's size, 0 for none."""

    @abstractmethod
    def _deprecated_number(self, name: str) -> int:
        """The number of one of the deprecated pair; throws where it is not there."""

    @abstractmethod
    def _shape(self, name: str) -> np.ndarray | None:
        """The numbers of a constant that holds the shape of an action; None where there is none."""

    @abstractmethod
    def _first_of_shape(self, name: str) -> int:
        """The first of them, as it is read without a look whether it is there."""

    def has_continuous(self, deterministic: bool) -> bool:
        """Whether there are continuous actions to fetch: by output and shape, or by ``is_continuous_control``."""
        if not self.names_kinds:
            return self._deprecated_number(IS_CONTINUOUS) > 0
        return self.has_output(action_output(CONTINUOUS, deterministic)) and self._first_of_shape(CONTINUOUS_SHAPE) > 0

    def has_discrete(self, deterministic: bool) -> bool:
        """Whether there are discrete actions to fetch: by output and shape, or by ``is_continuous_control``."""
        if not self.names_kinds:
            return self._deprecated_number(IS_CONTINUOUS) == 0
        return self.has_output(action_output(DISCRETE, deterministic)) and self.discrete_size > 0

    @property
    def continuous_size(self) -> int:
        """The number of continuous actions that the model says it has."""
        if not self.names_kinds:
            return self._deprecated_number(ACTION_SHAPE) if self._deprecated_number(IS_CONTINUOUS) > 0 else 0
        return 0 if self._shape(CONTINUOUS_SHAPE) is None else self._first_of_shape(CONTINUOUS_SHAPE)

    @property
    def discrete_size(self) -> int:
        """The sum of the branches that the model says it has."""
        if not self.names_kinds:
            return 0 if self._deprecated_number(IS_CONTINUOUS) > 0 else self._deprecated_number(ACTION_SHAPE)
        shape = self._shape(DISCRETE_SHAPE)
        return 0 if shape is None else sum(map(truncate, shape))

    def has_output(self, name: str) -> bool:
        """Whether an output is found under this name."""
        if self.by_substring:
            return any(name in output for output in self.outputs)
        return name in self.outputs

    @property
    def names_kinds(self) -> bool:
        """Whether actions come under names of their kind (ML-Agents 1.7 and later), not as ``action``."""
        return self.has_output(CONTINUOUS) or self.has_output(DISCRETE)

    @property
    def input_names(self) -> tuple[str, ...]:
        """Inputs and the memories that the runtime manages."""
        return (*(i.name for i in self.inputs), *self.memories)

    def fetched_outputs(self, deterministic: bool) -> tuple[str, ...]:
        """The outputs that a player fetches."""
        kinds = ((CONTINUOUS, self.has_continuous(deterministic)), (DISCRETE, self.has_discrete(deterministic)))
        names = [action_output(name, deterministic) for name, there in kinds if there]
        if names and not self.names_kinds:
            names = [ACTION]
        return (*names, RECURRENT_OUT) if self.memory_size > 0 else tuple(names)


def action_output(name: str, deterministic: bool) -> str:
    """The name of an action output in this mode of inference."""
    return DETERMINISTIC + name if deterministic else name


def truncate(value: float) -> int:
    """A float as C# casts it to int: towards zero; what does not fit becomes the most negative one."""
    number = float(value)
    return int(number) if abs(number) < -_MOST_NEGATIVE else _MOST_NEGATIVE
