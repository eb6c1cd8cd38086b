"""Walks through the code of a TorchScript module, and gives each op of it to the tables in ``ops/``.

Only what the printer writes is known: assignments, ``if`` whose condition is known before anything is fed, ``for`` over
a known range, calls. Everything else is refused by name. Nothing of the code is run: names are looked up in tables of
this program, and lengths, flags and lists are computed by functions that stand there.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from msgspec import Struct

from export_model.converters.formats.torchscript.code import ArchiveCode
from export_model.converters.formats.torchscript.machine import Machine
from export_model.converters.formats.torchscript.ops.table import OPS
from export_model.converters.formats.torchscript.values import Module, Named, ScriptTensor
from export_model.signatures.errors import DamagedFileError, ExportModelError, SourceError, UnsupportedOpError

#: Statements that are walked through; a policy has some hundreds, loops included.
MAX_STATEMENTS = 100_000
#: Calls in one another: a module of modules; and expressions in one.
MAX_CALLS, MAX_DEPTH = 60, 100
#: In a list, and in the lists in it.
MAX_ITEMS = 10_000
_OWN = "__torch__"
_FIX = "export the module to ONNX in its own project (torch.onnx.export), and give that"
_NESTED = "expressions in one another"


class _Frame(Struct):
    """A call that is being walked through."""

    names: dict[str, Any]
    depth: int


class _ReturnError(Exception):
    """The end of a function, with what it gives."""

    def __init__(self, value: Any) -> None:
        super().__init__()
        self.value = value


class Interpreter:
    """One walk through a program; ``budget`` counts the statements of all walks."""

    def __init__(self, code: ArchiveCode, machine: Machine, constants: Sequence[Any], budget: Iterator[int]) -> None:
        self._code, self._machine, self._constants = code, machine, constants
        self._budget = budget
        self._level = 0
        #: id of a list → the list, and how many items are in it, those of its lists counted
        self._weights: dict[int, tuple[Any, int]] = {}

    def call_method(self, module: Module, name: str, arguments: Sequence[Any], depth: int = 0) -> Any:
        """Return what a method gives. Raises SourceError, UnsupportedOpError, DamagedFileError."""
        method = self._code.method(module.type_name, name)
        with self._machine.inside(module.path):
            return self._call(method, [module, *arguments], {}, depth)

    def _call(self, function: ast.FunctionDef, given: Sequence[Any], named: Mapping[str, Any], depth: int) -> Any:
        if depth > MAX_CALLS:
            raise _refusal(f"calls in one another, more than {MAX_CALLS}")
        parameters = [a.arg for a in function.args.args]
        defaults = dict(zip(parameters[::-1], function.args.defaults[::-1], strict=False))
        names = dict(zip(parameters, given, strict=False))
        names |= {k: v for k, v in named.items() if k in parameters}
        frame = _Frame(names, depth)
        for parameter in parameters:
            if parameter not in names:
                if parameter not in defaults:
                    raise _damaged_error(f"{function.name[:60]} is called without {parameter[:60]}")
                names[parameter] = self.value_of(defaults[parameter], frame)
        if len(given) > len(parameters):
            raise _damaged_error(
                f"{function.name[:60]} is called with {len(given)} values, and takes {len(parameters)}"
            )
        try:
            self._run(function.body, frame)
        except _ReturnError as returned:
            return returned.value
        return None

    # ------------------------------------------------------------------ statements

    def _run(self, statements: Sequence[ast.stmt], frame: _Frame) -> None:
        for statement in statements:
            if next(self._budget) > MAX_STATEMENTS:
                raise _refusal(f"more than {MAX_STATEMENTS} statements")
            self._statement(statement, frame)

    def _statement(self, statement: ast.stmt, frame: _Frame) -> None:
        match statement:
            case ast.Assign(targets=[target], value=value):
                self._assign(target, self.value_of(value, frame), frame)
            case ast.AnnAssign(target=target, value=ast.expr() as value):
                self._assign(target, self.value_of(value, frame), frame)
            case ast.Expr(value=value):
                self.value_of(value, frame)
            case ast.Return(value=None):
                raise _ReturnError(None)
            case ast.Return(value=ast.expr() as value):
                raise _ReturnError(self.value_of(value, frame))
            case ast.If(test=test, body=body, orelse=otherwise):
                self._run(body if self._machine.truth(self.value_of(test, frame)) else otherwise, frame)
            case ast.For(target=target, iter=items, body=body, orelse=[]):
                for item in self._items(self.value_of(items, frame)):
                    self._assign(target, item, frame)
                    self._run(body, frame)
            case ast.Pass():
                pass
            case _:
                raise _refusal(f"a statement of the kind {type(statement).__name__}")

    def _assign(self, target: ast.expr, value: Any, frame: _Frame) -> None:
        match target:
            case ast.Name(id=name):
                frame.names[name] = value
            case ast.Tuple(elts=parts):
                items = self._items(value)
                if len(items) != len(parts):
                    raise _damaged_error(f"{len(items)} values are given to {len(parts)} names")
                for part, item in zip(parts, items, strict=True):
                    self._assign(part, item, frame)
            case ast.Attribute(value=owner, attr=name):
                self._set_attribute(self.value_of(owner, frame), name, value)
            case _:
                raise _refusal(f"an assignment to a {type(target).__name__}")

    def _set_attribute(self, owner: Any, name: str, value: Any) -> None:
        known = self.attribute_of(owner, name) if isinstance(owner, Module) else None
        if isinstance(known, ScriptTensor) and isinstance(value, ScriptTensor):
            self._machine.overwrite(known, value)
        elif not isinstance(owner, Module) or known is not value:
            raise _refusal(f"the attribute {name[:60]} is set, and is not a tensor of one shape")

    def _items(self, value: Any) -> Sequence[Any]:
        if isinstance(value, list | tuple | range):
            return value
        raise _damaged_error(f"a {type(value).__name__} is taken apart")

    # ------------------------------------------------------------------ expressions

    def value_of(self, expression: ast.expr, frame: _Frame) -> Any:
        """Return what an expression stands for. Raises SourceError, UnsupportedOpError, DamagedFileError."""
        self._level += 1
        try:
            if self._level > MAX_DEPTH * MAX_CALLS:
                raise _refusal(_NESTED)
            return self._evaluate(expression, frame)
        except RecursionError as error:
            raise _refusal(_NESTED) from error
        finally:
            self._level -= 1

    def _evaluate(self, expression: ast.expr, frame: _Frame) -> Any:
        match expression:
            case ast.Constant(value=bool() | int() | float() | str() | None as value):
                return value
            case ast.Name(id=name):
                if name in frame.names:
                    return frame.names[name]
                return float(name) if name in ("inf", "nan") else Named(name)
            case ast.Attribute(value=owner, attr=name):
                return self.attribute_of(self.value_of(owner, frame), name)
            case ast.Tuple(elts=parts):
                return self._weigh(tuple(self.value_of(p, frame) for p in parts))
            case ast.List(elts=parts):
                return self._weigh([self.value_of(p, frame) for p in parts])
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                value = self.value_of(operand, frame)
                if isinstance(value, int | float):
                    return -value
            case ast.Subscript(value=owner, slice=index):
                return self._element(self.value_of(owner, frame), self.value_of(index, frame))
            case ast.Call(func=function, args=arguments, keywords=keywords):
                return self._value_of_call(function, arguments, keywords, frame)
        raise _refusal(f"an expression of the kind {type(expression).__name__}")

    def _weigh(self, made: list[Any] | tuple[Any, ...]) -> list[Any] | tuple[Any, ...]:
        """Return a list, once it is known how much is in it: lists of one list twice grow fast."""
        weight = 1 + sum(self._weights.get(id(part), (part, 1))[1] for part in made)
        if weight > MAX_ITEMS:
            raise _refusal(f"a list of more than {MAX_ITEMS} items")
        self._weights[id(made)] = made, weight  # which keeps it, and so its id
        return made

    def _element(self, owner: Any, index: Any) -> Any:
        if isinstance(owner, list | tuple) and isinstance(index, int) and -len(owner) <= index < len(owner):
            return owner[index]
        raise _damaged_error(f"an element of a {type(owner).__name__} is asked for that it lacks")

    def attribute_of(self, owner: Any, name: str) -> Any:
        """Return an attribute of a module, or the name that is longer by one part. Raises DamagedFileError."""
        if isinstance(owner, Named):
            if owner.name == "CONSTANTS":
                return self._constant(name)
            return Named(f"{owner.name}.{name}")
        if isinstance(owner, Module):
            return self._machine.attribute(owner, name)
        raise _damaged_error(f"a {type(owner).__name__} is asked for its {name[:60]}")

    def _constant(self, name: str) -> Any:
        number = int(name[1:]) if name.startswith("c") and name[1:].isdecimal() and len(name) < 8 else -1
        if not 0 <= number < len(self._constants):
            raise _damaged_error(f"its code asks for the constant {name[:60]}, which is not there")
        return self._machine.constant(self._constants[number], name)

    def _value_of_call(
        self, function: ast.expr, arguments: Sequence[ast.expr], keywords: Sequence[ast.keyword], frame: _Frame
    ) -> Any:
        if isinstance(function, ast.Name) and function.id in _TYPED and function.id not in frame.names:
            return _TYPED[function.id](self, arguments, frame)
        if isinstance(function, ast.Attribute):
            owner = self.value_of(function.value, frame)
            given, named = self._arguments(arguments, keywords, frame)
            if isinstance(owner, Module):
                method = self._code.method(owner.type_name, function.attr)
                self._machine.expect_states(owner, given)
                with self._machine.inside(owner.path):
                    return self._call(method, [owner, *given], named, frame.depth + 1)
            called = self.attribute_of(owner, function.attr)
        else:
            called = self.value_of(function, frame)
            given, named = self._arguments(arguments, keywords, frame)
        if not isinstance(called, Named):
            raise _damaged_error(f"a {type(called).__name__} is called")
        if called.name.startswith(f"{_OWN}."):
            return self._own(called.name, given, named, frame)
        return self._op(called.name, given, named)

    def _arguments(
        self, arguments: Sequence[ast.expr], keywords: Sequence[ast.keyword], frame: _Frame
    ) -> tuple[list[Any], dict[str, Any]]:
        named = {k.arg: self.value_of(k.value, frame) for k in keywords if k.arg is not None}
        return [self.value_of(a, frame) for a in arguments], named

    def _own(self, name: str, given: Sequence[Any], named: Mapping[str, Any], frame: _Frame) -> Any:
        function = self._code.function(name)
        if isinstance(function, ast.ClassDef):
            return tuple(given)  # a NamedTuple
        return self._call(function, given, named, frame.depth + 1)

    def _op(self, name: str, given: Sequence[Any], named: Mapping[str, Any]) -> Any:
        op = OPS.get(name)
        if op is None and name.endswith("_") and not name.endswith("__") and name.removesuffix("_") in OPS:
            return self._in_place(name, OPS[name.removesuffix("_")], given, named)
        if op is None:
            raise _refusal(f"the op {name[:80]}")
        return self._apply(name, op, given, named)

    def _in_place(self, name: str, op: Callable[..., Any], given: Sequence[Any], named: Mapping[str, Any]) -> Any:
        """Return the first operand, with what an op gives put into it."""
        made = self._apply(name, op, given, named)
        if not given or not isinstance(given[0], ScriptTensor) or not isinstance(made, ScriptTensor):
            raise _refusal(f"the op {name[:80]} on something that is not a tensor")
        self._machine.overwrite(given[0], made)
        return given[0]

    def _apply(self, name: str, op: Callable[..., Any], given: Sequence[Any], named: Mapping[str, Any]) -> Any:
        try:
            return op(self._machine, *given, **named)
        except UnsupportedOpError as error:
            raise UnsupportedOpError(
                f"cannot translate {name}: {error.what}",
                issues=error.issues or [(self._machine.path or "forward", name)],
                why=error.why,
                fix=error.fix or _FIX,
            ) from error
        except ExportModelError:
            raise
        except (TypeError, ValueError, IndexError, KeyError, AttributeError, ArithmeticError) as error:
            raise UnsupportedOpError(
                f"cannot translate {name} in the form in which it is called",
                issues=[(self._machine.path or "forward", name)],
                why=str(error)[:120] or type(error).__name__,
                fix=_FIX,
            ) from error


def _last_argument(walk: Interpreter, arguments: Sequence[ast.expr], frame: _Frame) -> Any:
    """``annotate(T, x)``, ``unchecked_cast(T, x)``: x."""
    if len(arguments) != 2:
        raise _damaged_error("a cast has a type and a value")
    return walk.value_of(arguments[1], frame)


def _of_module(walk: Interpreter, arguments: Sequence[ast.expr], frame: _Frame) -> Any:
    """``getattr(self, "0")``."""
    match arguments:
        case [owner, ast.Constant(value=str() as name)]:
            return walk.attribute_of(walk.value_of(owner, frame), name)
    raise _damaged_error("getattr has a module and a name")


#: Calls whose first operand is a type, or that are Python's own.
_TYPED: Mapping[str, Callable[[Interpreter, Sequence[ast.expr], _Frame], Any]] = {
    "annotate": _last_argument,
    "unchecked_cast": _last_argument,
    "uninitialized": lambda walk, arguments, frame: None,
    "getattr": _of_module,
}


def _refusal(what: str) -> SourceError:
    return SourceError(
        f"its code has {what}",
        why="the code of a TorchScript module is translated op by op and never run; this is outside of what is known",
        fix=_FIX,
    )


def _damaged_error(what: str) -> DamagedFileError:
    return DamagedFileError(
        what, why="its code does not fit together: the file is damaged", fix="copy or download it again"
    )
