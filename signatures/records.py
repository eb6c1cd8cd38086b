"""``dataclass``, quick to declare: what a record's methods do is the same for all of them, but for ``__init__``.

Of a cold start's time an eighth went into compiling the methods of some fifty classes (Python 3.11, 0.4 ms a class).
Here ``__init__`` alone is compiled, when the first record is made (or its signature asked for); the others are closures
over the fields' names. In all else a class is what ``dataclasses`` makes: ``replace``, ``fields``, ``slots``, ``match``
and pickles work. InitVar, and options beyond eq, frozen, kw_only and slots, are not known.
"""

from __future__ import annotations

import abc
import dataclasses
import inspect
import sys
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, MISSING, Field, FrozenInstanceError
from operator import attrgetter
from reprlib import recursive_repr
from types import MemberDescriptorType, SimpleNamespace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dataclasses import dataclass as dataclass
else:

    def dataclass(cls: type | None = None, /, **options: bool) -> Any:
        """As ``dataclasses.dataclass``."""
        return _declare(cls, **options) if cls is not None else lambda given: _declare(given, **options)


_FIELD: Any = getattr(dataclasses, "_FIELD")  # noqa: B009 - dataclasses.fields() asks for it
#: Parameters of the standard decorator that are none of ours, and how it has them.
_STANDARD = {
    "init": True,
    "repr": True,
    "order": False,
    "unsafe_hash": False,
    "match_args": True,
    "weakref_slot": False,
}


class _Factory:
    """What an argument is that is made anew for every record."""

    def __repr__(self) -> str:
        return "<factory>"


_FACTORY = _Factory()


def _declare(cls: type, *, frozen: bool = False, eq: bool = True, kw_only: bool = False, slots: bool = False) -> Any:
    fields = _base_fields(cls, frozen)
    own = _own_fields(cls, kw_only)
    fields.update(own)
    named = dict(vars(cls))
    for name, declared in own.items():
        if declared.default is not MISSING:
            setattr(cls, name, declared.default)
        elif name in named:
            delattr(cls, name)
    _check_order(fields.values())
    made: Any = _with_slots(cls, own, frozen) if slots else cls
    params = {"frozen": frozen, "eq": eq, "kw_only": kw_only, "slots": slots, **_STANDARD}
    methods: dict[str, Any] = {
        "__init__": _Init(made, fields, frozen),
        "__repr__": _repr,
        "__match_args__": tuple(f.name for f in fields.values() if f.init and not f.kw_only),
    }
    if sys.version_info >= (3, 13):
        methods["__replace__"] = _replace
    if eq:
        values = _values_of([f.name for f in fields.values() if f.compare])
        methods["__eq__"] = _equality(values)
        # A hash that is None came with an __eq__.
        if "__hash__" not in named or (named["__hash__"] is None and "__eq__" in named):
            made.__hash__ = (lambda self: hash(values(self))) if frozen else None
    for name, method in methods.items():
        if name not in named:
            setattr(made, name, method)
    made.__dataclass_fields__, made.__dataclass_params__ = fields, SimpleNamespace(**params)
    if frozen:
        made.__setattr__, made.__delattr__ = _refusals(made, frozenset(fields))
    return abc.update_abstractmethods(made)


# ------------------------------------------------------------------ fields


def _base_fields(cls: type, frozen: bool) -> dict[str, Field[Any]]:
    fields: dict[str, Field[Any]] = {}
    for base in cls.__mro__[-1:0:-1]:
        if "__dataclass_fields__" in vars(base):
            if vars(base)["__dataclass_params__"].frozen is not frozen:
                raise TypeError("of a record and what it inherits from either all are frozen or none")
            fields.update(vars(base)["__dataclass_fields__"])
    return fields


def _own_fields(cls: type, kw_only: bool) -> dict[str, Field[Any]]:
    fields: dict[str, Field[Any]] = {}
    for name, kind in inspect.get_annotations(cls).items():
        text = kind if isinstance(kind, str) else getattr(kind, "__name__", "")
        if text.removeprefix("dataclasses.") == "KW_ONLY" or kind is KW_ONLY:
            kw_only = True
            continue
        if text.removeprefix("typing.").startswith("ClassVar"):
            continue
        given = getattr(cls, name, MISSING)
        if isinstance(given, MemberDescriptorType):  # the slot of a field that is declared anew
            given = MISSING
        declared: Any = given if isinstance(given, Field) else dataclasses.field(default=given)
        declared.name, declared.type, declared._field_type = name, kind, _FIELD
        if declared.kw_only is MISSING:
            declared.kw_only = kw_only
        if declared.default is not MISSING and declared.default.__class__.__hash__ is None:
            raise ValueError(f"mutable default {type(declared.default)} for field {name} is not allowed")
        fields[name] = declared
    return fields


def _check_order(fields: Any) -> None:
    optional = False
    for f in fields:
        if f.init and not f.kw_only:
            if optional and _is_required(f):
                raise TypeError(f"non-default argument {f.name!r} follows default argument")
            optional = optional or not _is_required(f)


def _is_required(f: Field[Any]) -> bool:
    return f.default is MISSING and f.default_factory is MISSING


def _with_slots(cls: type, own: Mapping[str, Field[Any]], frozen: bool) -> type:
    """The class once more: slots are laid out when a class is made."""
    there = {name for base in cls.__mro__[1:-1] for name in _slots_of(base)}
    content = {k: v for k, v in vars(cls).items() if k not in own and k not in ("__dict__", "__weakref__")}
    content["__slots__"] = tuple(name for name in own if name not in there)
    if frozen:
        content.setdefault("__getstate__", _state)
        content.setdefault("__setstate__", _set_state)
    made = type(cls)(cls.__name__, cls.__bases__, content)
    made.__qualname__ = cls.__qualname__
    return made


def _slots_of(cls: type) -> tuple[str, ...]:
    slots = vars(cls).get("__slots__", ())
    return (slots,) if isinstance(slots, str) else tuple(slots)


# ------------------------------------------------------------------ methods


class _Init:
    """The ``__init__`` of a class until it is asked for; then there is a function in its place."""

    __slots__ = ("cls", "fields", "frozen")

    def __init__(self, cls: type, fields: Mapping[str, Field[Any]], frozen: bool) -> None:
        self.cls, self.fields, self.frozen = cls, fields, frozen

    def __get__(self, record: object, owner: type) -> Any:
        cls: Any = self.cls
        made: Any = _compiled_init(cls, self.fields, self.frozen)
        cls.__init__ = made
        return made.__get__(record, owner)


def _compiled_init(cls: type, fields: Mapping[str, Field[Any]], frozen: bool) -> Callable[..., None]:
    known: dict[str, Any] = {"__set": object.__setattr__, "__factory": _FACTORY}
    plain: list[str] = ["self"]
    named: list[str] = []
    body: list[str] = []
    for i, f in enumerate(fields.values()):
        value = f.name
        if f.default_factory is not MISSING:
            known[f"__new{i}"] = f.default_factory
            value = f"__new{i}() if {f.name} is __factory else {f.name}" if f.init else f"__new{i}()"
        elif f.default is not MISSING:
            known[f"__default{i}"] = f.default
            value = f.name if f.init else f"__default{i}"
        elif not f.init:
            continue
        if f.init:
            default = "" if _is_required(f) else f"=__default{i}" if f.default is not MISSING else "=__factory"
            (named if f.kw_only else plain).append(f.name + default)
        body.append(f"__set(self, {f.name!r}, {value})" if frozen else f"self.{f.name} = {value}")
    if hasattr(cls, "__post_init__"):
        body.append("self.__post_init__()")
    parameters = ", ".join([*plain, *(["*", *named] if named else ())])
    exec(f"def __init__({parameters}):\n " + "\n ".join(body or ["pass"]), known)  # noqa: S102 - names of fields
    made: Any = known["__init__"]
    made.__qualname__, made.__module__ = f"{cls.__qualname__}.__init__", cls.__module__
    made.__annotations__ = {**{f.name: f.type for f in fields.values() if f.init}, "return": None}
    return made  # type: ignore[no-any-return]


def _values_of(names: list[str]) -> Callable[[Any], Any]:
    return attrgetter(*names) if names else lambda self: ()


def _equality(values: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
    def equal(self: Any, other: object) -> Any:
        # One tuple against another: what is the same object is not compared, as in the standard one.
        return (values(self),) == (values(other),) if other.__class__ is self.__class__ else NotImplemented

    return equal


def _refusals(cls: Any, names: frozenset[str]) -> tuple[Callable[..., None], Callable[..., None]]:
    """What refuses to set and to delete a field, and everything of a record of just this class."""

    def refuse_set(self: Any, name: str, value: Any) -> None:
        if type(self) is cls or name in names:
            raise FrozenInstanceError(f"cannot assign to field {name!r}")
        super(cls, self).__setattr__(name, value)

    def refuse_delete(self: Any, name: str) -> None:
        if type(self) is cls or name in names:
            raise FrozenInstanceError(f"cannot delete field {name!r}")
        super(cls, self).__delattr__(name)

    return refuse_set, refuse_delete


@recursive_repr()
def _repr(self: Any) -> str:
    shown = ", ".join(f"{f.name}={getattr(self, f.name)!r}" for f in dataclasses.fields(self) if f.repr)
    return f"{type(self).__qualname__}({shown})"


def _replace(self: Any, /, **changes: Any) -> Any:
    return dataclasses.replace(self, **changes)


def _state(self: Any) -> list[Any]:
    return [getattr(self, f.name) for f in dataclasses.fields(self)]


def _set_state(self: Any, state: list[Any]) -> None:
    for f, value in zip(dataclasses.fields(self), state, strict=True):
        object.__setattr__(self, f.name, value)
