"""A recording: the steps of an agent, or of several, in the order of time."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace

Array = np.ndarray
Arrays = Mapping[str, Array]
#: In ``before`` and ``last``: there is no such row.
NONE = -1


class Recording(Struct, frozen=True):
    """What a log holds of a policy's inputs and outputs, a row for each step.

    - ``inputs``: [steps, …] by the policy's name of the input, in its dtype; all that the policy takes but those that
      are derived at replay (memory and the previous action, where they were not logged).
    - ``outputs``: [steps, …] by the policy's name of the output, float64 for numbers and int64 for choices.
    - ``before``: int64 [steps], the row of the same agent's step before; ``NONE`` where an episode begins.
    - ``last``: the same, but across the ends of episodes.
    - ``rounding``: half a unit of the last decimal that a text kept, per input or output, [columns] or one number.
    - ``episodes``: how many there are; ``ignored``: columns that are not the policy's, such as the time.
    """

    inputs: Arrays
    outputs: Arrays
    before: Array
    last: Array
    rounding: Mapping[str, Array] = field(default_factory=dict)
    episodes: int = 1
    ignored: tuple[str, ...] = ()
    #: the inputs that the log holds; the others were derived
    logged: frozenset[str] = frozenset()
    #: steps hang together: the policy has a memory, and the log does not hold it
    chained: bool = False
    #: of each row, as the log numbers them
    episode: Array = field(default_factory=lambda: np.zeros(0, np.int64))
    agent: Array = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def steps(self) -> int:
        """How many rows there are."""
        return len(self.before)

    @property
    def after(self) -> Array:
        """int64 [steps]: the row of the same agent's next step; ``NONE`` where the episode ends."""
        found = np.full(self.steps, NONE, np.int64)
        known = self.before != NONE
        found[self.before[known]] = np.flatnonzero(known)
        return found

    def rows(self, chosen: Array) -> Recording:
        """The rows ``chosen`` (int64, ascending) alone; steps whose step before was left out begin an episode."""
        place = np.full(self.steps + 1, NONE, np.int64)  # the last entry is what NONE finds
        place[chosen] = np.arange(len(chosen))
        return replace(
            self,
            inputs={n: a[chosen] for n, a in self.inputs.items()},
            outputs={n: a[chosen] for n, a in self.outputs.items()},
            before=place[self.before[chosen]],
            last=place[self.last[chosen]],
            episode=self.episode[chosen],
            agent=self.agent[chosen],
        )


def links(agent: Array, begins: Array) -> tuple[Array, Array]:
    """(``before``, ``last``) of rows of these agents, int64 [steps]; bool [steps]: whether an episode begins there."""
    order = np.argsort(agent, kind="stable")
    same = np.zeros(len(order), bool)
    same[1:] = agent[order][1:] == agent[order][:-1]
    last = np.full(len(order), NONE, np.int64)
    last[order[1:]] = np.where(same[1:], order[:-1], NONE)
    return np.where(begins, NONE, last), last
