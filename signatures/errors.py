"""The exception tree. Every error the package raises on purpose is one of these, a name of ``export_model``.

::

    ExportModelError            what happened, where, why, what to do; its ``exit_status`` follows
    ├── UsageError              2  the command line or the call is wrong
    ├── SourceError             2  the source cannot be read
    │   ├── NotAPolicyError     2  readable, but not a policy (or not what the reader was asked for)
    │   └── DamagedFileError    2  it is cut off, empty, or breaks its own format
    ├── RefusedError            2  of several sources, some could not be exported
    ├── GraphError              2  a node of the graph is wrong or cannot be converted
    │   └── UnsupportedOpError  2  an op that the op table does not hold
    ├── SignatureError          2  inputs and outputs cannot be given their roles
    ├── TooLargeError           2  a format cannot hold a policy of that size
    ├── ProfileError            2  a consumer (--for) cannot hold the policy
    ├── BundleError             2  a bundle is missing, incomplete or has been changed
    ├── ParityError             1  two runtimes disagree
    ├── RunFailedError          1  a runtime refused a model; verification reports it
    └── RuntimeUnavailableError 3  a runtime that was asked for is not installed, or did not start
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from operator import index
from typing import Any

from export_model.signatures.fields import printable

#: Characters of a line of a message: a file may hold names of any length.
MAX_LINE = 1 << 13


class ExportModelError(Exception):
    """Base of all errors of this project.

    ``what`` happened, ``where`` (file, node), ``why``, and what to do (``fix``); the message holds all four.
    """

    exit_status = 2

    def __init__(self, what: str, *, where: str | None = None, why: str | None = None, fix: str | None = None) -> None:
        self.what, self.where, self.why, self.fix = what, where, why, fix
        super().__init__(self.message)

    @property
    def message(self) -> str:
        """The parts that are known, a line each, further lines indented; what cannot be printed is replaced."""
        parts = [self.what if self.where is None else f"{self.where}: {self.what}"]
        parts += [f"  {key}: {text}" for key, text in (("why", self.why), ("fix", self.fix)) if text]
        return "\n".join(
            "\n       ".join(printable(_cut(line)) for line in part.expandtabs().replace("\r\n", "\n").split("\n"))
            for part in parts
        )

    def __str__(self) -> str:
        return self.message

    def at(self, where: str) -> ExportModelError:
        """The same error with a place in front of the one it names already; for callers that know the file."""
        if self.where is None or not self.where.startswith(where):
            self.where = where if self.where is None else f"{where}: {self.where}"
        self.args = (self.message,)
        return self

    def to_dict(self) -> dict[str, Any]:
        """For ``--json``: the class's name and the four parts."""
        return {
            "error": type(self).__name__,
            "what": self.what,
            "where": self.where,
            "why": self.why,
            "fix": self.fix,
            "exit_status": self.exit_status,
        }


def _cut(line: str) -> str:
    return line if len(line) <= MAX_LINE else f"{line[:MAX_LINE]} … ({len(line)} characters)"


class UsageError(ExportModelError):
    """The command line or the call is wrong: an unknown target, a flag that contradicts another."""


def whole(name: str, value: object, least: int, most: int | None = None) -> int:
    """A number that a caller gave, as an int; numpy's are whole numbers too. Raises UsageError."""
    try:
        number = index(value)  # type: ignore[arg-type]  # it is what refuses others
    except TypeError:
        number = least - 1
    if isinstance(value, bool) or number < least or (most is not None and number > most):
        bounds = f"of {least} or more" if most is None else f"from {least} to {most}"
        raise UsageError(f"{name} {value}: must be a whole number {bounds}")
    return number


def suggestion(name: str, known: Iterable[str]) -> str:
    """``did you mean …?`` and a space where one that is known is close to a name that is not; else nothing."""
    import difflib  # 2 ms, which nobody needs who mistypes nothing

    close = difflib.get_close_matches(name, [*known], n=1)
    return f"did you mean {close[0]}? " if close else ""


class SourceError(ExportModelError):
    """The source cannot be read."""


class NotAPolicyError(SourceError):
    """The source is something else than a policy, or a policy in a form that is not read; the text says which."""


class DamagedFileError(SourceError):
    """The source is empty, cut off, or breaks the rules of its own format."""


class RefusedError(ExportModelError):
    """Of several sources, some could not be exported; the others were. ``errors`` has one for each."""

    def __init__(self, errors: Sequence[ExportModelError], count: int) -> None:
        self.errors, self._count = tuple(errors), count
        rest = "; the others were" if len(errors) < count else ""
        super().__init__(
            f"{len(errors)} of {count} sources could not be exported{rest}",
            why="\n".join(e.message for e in errors),
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.errors, self._count)

    def to_dict(self) -> dict[str, Any]:
        """As the base, with the errors."""
        return {**super().to_dict(), "errors": [e.to_dict() for e in self.errors]}


class GraphError(ExportModelError):
    """A node is wrong (a dangling input, a dtype that does not fit) or cannot be converted."""


class UnsupportedOpError(GraphError):
    """Ops that no entry of the op table covers. ``issues`` names every node, not only the first."""

    def __init__(self, what: str, *, issues: Sequence[tuple[str, str]] = (), **parts: str | None) -> None:
        self.issues = tuple(issues)
        super().__init__(what, **parts)

    def to_dict(self) -> dict[str, Any]:
        """As the base, with the list of (node, op)."""
        return {**super().to_dict(), "issues": [{"node": n, "op": o} for n, o in self.issues]}


class TooLargeError(ExportModelError):
    """A format cannot hold a policy of that size. A format that nobody asked for is left out, with a note."""


class SignatureError(ExportModelError):
    """Inputs and outputs cannot be given their roles; the text lists the candidates and the flags that decide."""


class ProfileError(ExportModelError):
    """A policy cannot be what the consumer that ``--for`` names takes; the text says what that one lacks."""


class BundleError(ExportModelError):
    """A bundle is missing, incomplete, or its files are not the ones its policy.json names."""


class ParityError(ExportModelError):
    """Runtimes disagree. ``report`` is the content of parity.json."""

    exit_status = 1

    def __init__(self, what: str, *, report: Any = None, **parts: str | None) -> None:
        self.report = report
        super().__init__(what, **parts)


class RuntimeUnavailableError(ExportModelError):
    """A runtime that was asked for is not installed, or its process did not start."""

    exit_status = 3


# A user meets them as those of the package: in a traceback, and where he catches one.
for _class in [c for c in globals().values() if isinstance(c, type) and issubclass(c, ExportModelError)]:
    _class.__module__ = "export_model"

#: What Python and numpy raise where a damaged graph breaks something that a step takes for granted.
_BROKEN = (
    *(ArithmeticError, AssertionError, AttributeError, LookupError, TypeError, ValueError),
    RecursionError,
)


@contextmanager
def naming(path: object) -> Iterator[None]:
    """Errors inside name the file. It is untrusted input: what nobody foresaw is an error of the file, too."""
    try:
        yield
    except ExportModelError as error:
        raise error.at(str(path)) from error.__cause__
    except OSError as error:
        raise SourceError("cannot be read", where=str(path), why=str(error), fix="check its files") from error
    except MemoryError as error:
        raise GraphError(
            "needs more memory than there is",
            where=str(path),
            why=str(error) or "the system gave no more",
            fix="if other policies are as large, it is damaged: freeze it again from its checkpoint",
        ) from error
    except _BROKEN as error:
        raise GraphError(
            "the graph cannot be understood",
            where=str(path),
            why=f"a step failed on something it did not expect ({type(error).__name__}: {error})",
            fix="if the runtime it was made for loads it, please open an issue with it; else freeze it again",
        ) from error
