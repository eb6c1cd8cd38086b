"""Agents of a policy's source code, driven as its callers do: ``reset``, ``act`` or ``act_all``, and ``choose``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from msgspec import Struct, convert

from export_model.converters.files.children.frames import Tensors
from export_model.converters.formats.programs.members import Field, Header

#: How many take turns.
AGENTS = 3
#: What is fetched beside outputs: classes that ``choose`` draws [agents, draws, branches], how many unusual numbers
#: each agent sees, the constants of the file (the size of each member, each branch, how many branches there are).
CHOSEN, UNUSUAL, SIZES = "choose", "unusual", "sizes"
#: Begins the name of what is fetched of each of the repeated decisions, [repeat, agents, size].
EVERY = "every/"


class Drive(Struct, frozen=True):
    """One decision of each agent, ``repeat`` times from the same state, and so many draws of classes after the last.

    With ``seed`` an episode begins: the first agent's draws by it, the others' by those after it. ``noise`` and
    ``state`` (what is kept, and the output that is its next value) are inputs that agents fill by themselves, ``sized``
    the tensors of which a file has the sizes: for what does not know them by its own contract.
    """

    seed: int | None = None
    repeat: int = 1
    choose: int = 0
    noise: tuple[str, ...] = ()
    state: tuple[str, str] | None = None
    sized: tuple[str, ...] = ()

    @classmethod
    def of(cls, request: Mapping[str, Any]) -> Drive | None:
        """What a request to a runtime asks for; None where it only computes."""
        return convert(request["drive"], cls) if "drive" in request else None


def fields_of_agent(header: Header) -> tuple[Field, ...]:
    """What is seen of an agent after a decision: its outputs, its noise; its state last, under the output's name."""
    return (*header.outputs, *header.noise, *((header.next_state,) if header.state and header.next_state else ()))


def fields_with_size(header: Header) -> tuple[Field, ...]:
    """The members of which a file has the sizes."""
    return (*header.fed, *header.outputs)


def answers_of(header: Header, fetch: Iterable[str], every: Sequence[np.ndarray]) -> Tensors:
    """Return what is fetched of arrays [repeat, agents, size], a field each; the last decision without EVERY."""
    found = dict[str, np.ndarray]()
    for f, array in zip(fields_of_agent(header), every, strict=True):
        array = array.astype(f.spec.dtype)
        found[f.spec.name], found[f"{EVERY}{f.spec.name}"] = array[-1], array
    return {name: found[name] for name in fetch if name in found}
