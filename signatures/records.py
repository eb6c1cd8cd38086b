"""``dataclass``, quick to declare: a frozen class compiles one method, where the standard one compiles six.

Of a cold start's time a quarter went into compiling the methods of some seventy classes (Python 3.11, 1 ms a class).
What compares, hashes, shows and guards a record is the same for all of them; only ``__init__`` is made of its fields.
In all else a class is what ``dataclasses`` makes: ``replace``, ``fields``, ``slots``, ``match`` and pickles work.
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


def _frozen(cls: type, *, eq: bool = True, slots: bool = False, kw_only: bool = False) -> Any:
    own = vars(cls)
    methods: dict[str, Any] = {"__setattr__": _refuse_change, "__delattr__": _refuse_change}
    hashes = "__hash__" in own and not (own["__hash__"] is None and "__eq__" in own)
    made: Any = dataclasses.dataclass(init=False, repr=False, eq=False, slots=slots, kw_only=kw_only)(cls)
    fields = dataclasses.fields(made)
    methods["__init__"] = _initialiser(made, fields)
    if "__repr__" not in own:
        methods["__repr__"] = _repr
    if eq:
        values = _values_of([f.name for f in fields if f.compare])
        if "__eq__" not in own:
            methods["__eq__"] = _equality(values)
        if not hashes:
            methods["__hash__"] = lambda self: hash(values(self))
    if slots:
        methods |= {"__getstate__": _state, "__setstate__": _set_state}
    for name, method in methods.items():
        setattr(made, name, method)
    return made


def _initialiser(cls: type, fields: tuple[dataclasses.Field[Any], ...]) -> Any:
    names: dict[str, Any] = {"_set": object.__setattr__, "_new": _NEW}
    body, plain, named = [], ["self"], ["*"]
    for field in fields:
        name, value = field.name, field.name
        parameter = name
        if field.default is not dataclasses.MISSING:
            names[f"_{name}"] = field.default
            parameter += f"=_{name}"
        elif field.default_factory is not dataclasses.MISSING:
            names[f"_{name}"] = field.default_factory
            parameter += "=_new"
            value = f"_{name}() if {name} is _new else {name}" if field.init else f"_{name}()"
        elif not field.init:
            continue
        if field.init:
            (named if field.kw_only else plain).append(parameter)
        elif field.default is not dataclasses.MISSING:
            value = f"_{name}"
        body.append(f" _set(self,{name!r},{value})")
    if hasattr(cls, "__post_init__"):
        body.append(" self.__post_init__()")
    parameters = ",".join([*plain, *named] if len(named) > 1 else plain)
    exec(f"def __init__({parameters}):\n" + ("\n".join(body) or " pass"), names)  # noqa: S102  names of fields alone
    made = names["__init__"]
    made.__qualname__ = f"{cls.__qualname__}.__init__"
    made.__module__ = cls.__module__
    made.__annotations__ = {f.name: f.type for f in fields if f.init} | {"return": None}
    return made


def _values_of(names: list[str]) -> Callable[[Any], Any]:
    return attrgetter(*names) if names else lambda self: ()


def _equality(values: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
    def equal(self: Any, other: object) -> Any:
        # One tuple against another: what is the same object is not compared, as in the standard one.
        return (values(self),) == (values(other),) if other.__class__ is self.__class__ else NotImplemented

    return equal


class _Factory:
    """The default of a field that is made anew for each record, as signatures show it."""

    def __repr__(self) -> str:
        return "<factory>"


_NEW = _Factory()


@recursive_repr()
def _repr(self: Any) -> str:
    shown = ", ".join(f"{f.name}={getattr(self, f.name)!r}" for f in dataclasses.fields(self) if f.repr)
    return f"{type(self).__qualname__}({shown})"


def _refuse_change(self: Any, name: str, value: object = None) -> None:
    raise dataclasses.FrozenInstanceError(f"cannot assign to field {name!r}")


def _state(self: Any) -> list[Any]:
    return [getattr(self, f.name) for f in dataclasses.fields(self)]


def _set_state(self: Any, state: list[Any]) -> None:
    for field, value in zip(dataclasses.fields(self), state, strict=True):
        object.__setattr__(self, field.name, value)
