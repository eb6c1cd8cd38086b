"""Names of the policies of a run: each its own, whatever the sources are called and whoever exports them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePath, PurePosixPath
from typing import Generic, Protocol, TypeVar

from msgspec import Struct, field

from export_model.converters.files.fetch import address_of, path_text
from export_model.signatures.contract import safe_name

#: A name, and why it is another than the source's.
Claimed = tuple[str, str | None]
Who = TypeVar("Who")


class Naming(Protocol):
    """Who says what policies are called."""

    def claim(self, path: Path, names: Sequence[str]) -> list[Claimed]:
        """For each policy of the source at ``path`` the name, and a note where that is not the one it was to have."""
        ...


class Names:
    """Names that are taken, on a file system that may fold case, by which source."""

    def __init__(self) -> None:
        self._taken: dict[str, Path] = {}

    def claim(self, path: Path, names: Sequence[str]) -> list[Claimed]:
        """As ``Naming`` says: of a name that is taken, with as many parts of the path in front as are needed."""
        return [self._claim(path, name) for name in names]

    def reserve(self, path: Path, name: str) -> None:
        """A name that a policy of ``path`` has already."""
        self._taken[name.casefold()] = path

    def _claim(self, path: Path, name: str) -> Claimed:
        other = self._taken.get(name.casefold())
        if other is None:
            self._taken[name.casefold()] = path
            return name, None
        wishes = _numbered_names(name) if other == path else _wishes(path, name)
        found = next(wish for wish in wishes if wish.casefold() not in self._taken)
        self._taken[found.casefold()] = path
        return found, f"called {found}: {name} is {'another' if other == path else 'the'} policy of {path_text(other)}"


class Claim(Struct, frozen=True):
    """What a worker asks: names for the policies of its source."""

    path: Path
    names: Sequence[str]


class Turns(Struct, Generic[Who]):
    """Who waits for names: each until all sources before its own have theirs, or have ended without.

    So names do not depend on who is quick. Who asks again for a source that has its names gets the same.
    """

    names: Names
    _asking: dict[int, tuple[Who, Claim]] = field(default_factory=dict)
    _ended: set[int] = field(default_factory=set)
    _given: dict[int, list[Claimed]] = field(default_factory=dict)
    _first: int = 0

    def asks(self, number: int, who: Who, claim: Claim) -> None:
        """Someone asks for the names of a source."""
        self._asking[number] = (who, claim)

    def ends(self, number: int) -> None:
        """A source has ended."""
        self._asking.pop(number, None)
        if number >= self._first:
            self._ended.add(number)

    def answers(self) -> Iterator[tuple[int, Who, list[Claimed]]]:
        """Those whose turn it is: the source's number, who asked, and the names."""
        for number in [n for n in self._asking if n in self._given]:
            yield number, self._asking.pop(number)[0], self._given[number]
        while True:
            number = self._first
            if number in self._ended:
                self._ended.remove(number)
            elif number not in self._asking:
                return
            self._first += 1
            if number in self._asking:
                who, claim = self._asking.pop(number)
                self._given[number] = self.names.claim(claim.path, claim.names)
                yield number, who, self._given[number]


def _wishes(path: Path, name: str) -> Iterator[str]:
    wish = name
    inside: PurePath = PurePosixPath(f"/{path_text(path).partition('://')[2]}") if address_of(path) else path.absolute()
    for part in (inside.stem, *reversed(inside.parent.parts[1:])):
        if part != name:
            wish = safe_name(f"{part}-{wish}")
            yield wish
    yield from _numbered_names(name)


def _numbered_names(name: str) -> Iterator[str]:
    return (f"{name}-{number}" for number in itertools.count(2))
