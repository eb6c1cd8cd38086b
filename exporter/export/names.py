"""Names of the policies of a run: each its own, whatever the sources are called."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from signatures.contract import safe_name


class Names:
    """Names that are taken, on a file system that may fold case, by which source."""

    def __init__(self) -> None:
        self._taken: dict[str, Path] = {}

    def claim(self, path: Path, name: str) -> tuple[str, str | None]:
        """The name for a policy of the source at ``path``, and a note where that is not ``name``.

        A name that another policy has gets the parts of the path in front of it, the last first, as many as are needed.
        """
        found = next(wish for wish in _wishes(path, name) if wish.casefold() not in self._taken)
        self._taken[found.casefold()] = path
        if found == name:
            return name, None
        return found, f"called {found}: {name} is the policy of {self._taken[name.casefold()]}"


def _wishes(path: Path, name: str) -> Iterator[str]:
    yield name
    wish = name
    for part in (path.stem, *reversed(path.absolute().parent.parts[1:])):
        if part != name:
            wish = safe_name(f"{part}-{wish}")
            yield wish
    number = 2
    while True:
        yield f"{name}-{number}"
        number += 1
