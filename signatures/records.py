"""``dataclass``, quick to declare: what compares, hashes and shows a frozen record is the same for all of them.

Of a cold start's time a quarter went into compiling the methods of some seventy classes (Python 3.11, 1 ms a class). In
all else a class is what ``dataclasses`` makes: ``replace``, ``fields``, ``slots``, ``match`` and pickles work.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from operator import attrgetter
from reprlib import recursive_repr
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dataclasses import dataclass as dataclass
else:

    def dataclass(cls: type | None = None, /, *, frozen: bool = False, **options: bool) -> Any:
        """As ``dataclasses.dataclass``."""
        if cls is None:
            return lambda given: dataclass(given, frozen=frozen, **options)
        return _frozen(cls, **options) if frozen else dataclasses.dataclass(cls, **options)


def _frozen(cls: type, *, eq: bool = True, **options: bool) -> Any:
    own = vars(cls)
    hashes = "__hash__" in own and not (own["__hash__"] is None and "__eq__" in own)
    methods: dict[str, Any] = {} if "__repr__" in own else {"__repr__": _repr}
    made: Any = dataclasses.dataclass(frozen=True, repr=False, eq=False, **options)(cls)
    if eq:
        values = _values_of([f.name for f in dataclasses.fields(made) if f.compare])
        if "__eq__" not in own:
            methods["__eq__"] = _equality(values)
        if not hashes:
            methods["__hash__"] = lambda self: hash(values(self))
    for name, method in methods.items():
        setattr(made, name, method)
    return made


def _values_of(names: list[str]) -> Callable[[Any], Any]:
    return attrgetter(*names) if names else lambda self: ()


def _equality(values: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
    def equal(self: Any, other: object) -> Any:
        # One tuple against another: what is the same object is not compared, as in the standard one.
        return (values(self),) == (values(other),) if other.__class__ is self.__class__ else NotImplemented

    return equal


@recursive_repr()
def _repr(self: Any) -> str:
    shown = ", ".join(f"{f.name}={getattr(self, f.name)!r}" for f in dataclasses.fields(self) if f.repr)
    return f"{type(self).__qualname__}({shown})"
