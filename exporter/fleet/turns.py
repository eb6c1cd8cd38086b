"""Names are given to sources in their order, whoever is quick, so that they do not depend on who exports them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from exporter.export.names import Claimed, Names
from exporter.fleet.worker import Claim

Who = TypeVar("Who")


@dataclass
class Turns(Generic[Who]):
    """Who waits for names: each until all sources before its own have theirs, or have ended without."""

    names: Names
    _asking: dict[int, tuple[Who, Claim]] = field(default_factory=dict)
    _ended: set[int] = field(default_factory=set)
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
        while True:
            number = self._first
            if number in self._ended:
                self._ended.remove(number)
            elif number not in self._asking:
                return
            self._first += 1
            if number in self._asking:
                who, claim = self._asking.pop(number)
                yield number, who, self.names.claim(claim.path, claim.names)
