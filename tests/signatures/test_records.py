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
        later: int = field(init=False, default=7)
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


@pytest.mark.parametrize("way", [records.dataclass, dataclasses.dataclass], ids=["ours", "standard"])
def test_records_that_change_and_records_that_are_compared_by_identity(way: Callable[..., Any]) -> None:
    @way
    class Changing:
        """Not frozen."""

        count: int = 0
        names: list[str] = field(default_factory=list)

    @way(frozen=True, eq=False, kw_only=True)
    class Itself:
        """Equal to itself alone."""

        name: str
        size: int = 1

    changing = Changing(2)
    changing.count += 1
    assert changing == Changing(3) and Changing(3) != Changing(4)
    assert Changing.__hash__ is None
    one, other = Itself(name="a"), Itself(name="a")
    assert one != other and len({one, other}) == 2
    assert dataclasses.replace(one, size=2).size == 2
    with pytest.raises(TypeError, match="positional"):
        Itself("a")


@pytest.mark.parametrize("way", [records.dataclass, dataclasses.dataclass], ids=["ours", "standard"])
def test_what_cannot_be_a_record_is_refused_where_it_is_declared(way: Callable[..., Any]) -> None:
    with pytest.raises(TypeError, match="non-default argument 'late' follows default argument"):
        way(type("Order", (), {"__annotations__": {"early": "int", "late": "int"}, "early": 1}))
    with pytest.raises(ValueError, match="mutable default"):
        way(type("Shared", (), {"__annotations__": {"parts": "list[int]"}, "parts": []}))
    frozen = way(frozen=True)(type("Base", (), {"__annotations__": {"a": "int"}}))
    with pytest.raises(TypeError, match="frozen"):
        way(type("Derived", (frozen,), {"__annotations__": {"b": "int"}}))


def test_an_init_is_compiled_when_a_record_is_made() -> None:
    @records.dataclass(frozen=True, slots=True)
    class Declared:
        """Never made."""

        number: int

    assert not inspect.isfunction(vars(Declared)["__init__"])
    assert Declared(3).number == 3
    assert inspect.isfunction(vars(Declared)["__init__"])


def test_a_record_is_pickled() -> None:
    assert pickle.loads(pickle.dumps(Kept(3, "x"))) == Kept(3, "x")
