"""Records do what the standard library's dataclasses do."""

from __future__ import annotations

import copy
import dataclasses
import inspect
import pickle
from collections.abc import Callable
from dataclasses import KW_ONLY, field
from typing import Any

import pytest

from signatures import records


def declared(dataclass: Callable[..., Any], slots: bool) -> tuple[Any, Any]:
    """A class with every kind of field that is used, and one that inherits from it."""

    @dataclass(frozen=True, slots=slots)
    class Base:
        """Kinds of fields."""

        name: str
        parts: tuple[int, ...] = ()
        _: KW_ONLY
        hidden: int = field(default=3, repr=False, compare=False)
        made: dict[str, str] = field(init=False, default_factory=dict, compare=False)
        given: list[int] = field(default_factory=list, compare=False)

        def __post_init__(self) -> None:
            self.made["name"] = self.name

    @dataclass(frozen=True, slots=slots)
    class Derived(Base):
        """One more."""

        last: float = 0.5

    return Base, Derived


@pytest.mark.parametrize("slots", [True, False])
def test_records_behave_as_dataclasses(slots: bool) -> None:
    ways = [declared(way, slots) for way in (records.dataclass, dataclasses.dataclass)]

    def seen(base: Any, derived: Any) -> list[object]:
        one, other = base("a", (1,)), derived("a", (1,), 2.0, hidden=4)
        with pytest.raises(dataclasses.FrozenInstanceError) as refused:
            one.name = "b"
        with pytest.raises(dataclasses.FrozenInstanceError):
            del one.name
        with pytest.raises(TypeError):
            base()
        with pytest.raises(TypeError):
            base("a", (), 4)
        return [
            *(repr(one), repr(other), str(refused.value), one.made, base.__match_args__, dataclasses.asdict(other)),
            *(one == base("a", (1,), hidden=9), one == base("b"), one == other, one != derived("a", (1,), 2.0)),
            *(hash(one) == hash(base("a", (1,), hidden=5)), len({one, base("a", (1,)), other})),
            *(dataclasses.replace(other, last=1.0) == other, copy.copy(other) == other, hasattr(one, "__dict__")),
            *(str(inspect.signature(base)), str(inspect.signature(derived)), base("a").given is base("a").given),
        ]

    ours, standard = (seen(*way) for way in ways)
    assert ours == standard


@records.dataclass(frozen=True, slots=True)
class Kept:
    """What a worker sends."""

    number: int
    text: str = ""


def test_a_record_is_pickled() -> None:
    assert pickle.loads(pickle.dumps(Kept(3, "x"))) == Kept(3, "x")
