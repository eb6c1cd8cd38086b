"""Every policy of ../shared by path, for the tests that go over all of them; each is read and compiled once.

What is known of a file is the same worker's, whichever test asks.
"""

from __future__ import annotations

import functools
import zlib
from collections.abc import Iterable
from itertools import cycle
from pathlib import Path
from typing import Any

import pytest

from export_model.converters.policy.policy import Policy
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import ExportModelError

SHARED = Path(__file__).resolve().parents[2] / "shared"
ABSENT = "../shared (public models, genuine graphs) is not beside this checkout"
SUFFIXES = (".bytes", ".pb", ".nn", ".onnx", ".pt", ".keras")


def sources() -> list[Path]:
    """The model files; what is no policy is among them."""
    files = [p for room in ("genuine", "corpus", "foreign") for p in sorted((SHARED / room).rglob("*"))]
    return [p for p in files if p.suffix in SUFFIXES and p.is_file()]


def params(found: list[Path]) -> list[Any]:
    """Pytest parameters with the files' names; one that stands for their absence."""
    named = [pytest.param(p, id="/".join(p.relative_to(SHARED).parts)[-90:], marks=_group(p)) for p in found]
    return named or [pytest.param(Path("absent"), id="shared-is-absent")]


def in_turns(found: list[Path], choices: Iterable[Any]) -> list[Any]:
    """As ``params``, each with the next of ``choices``."""
    turns = zip(params(found), cycle(choices), strict=False)
    return [pytest.param(*f.values, choice, id=f"{f.id}-{choice.name}", marks=f.marks) for f, choice in turns]


def _group(path: Path) -> pytest.MarkDecorator:
    return pytest.mark.xdist_group(f"known-{zlib.crc32(str(path.relative_to(SHARED)).encode()):08x}")


@functools.cache
def policies(path: Path) -> tuple[Policy, ...] | ExportModelError:
    """The policies of a source, as every export has them, or why it is none."""
    if not path.is_file():
        pytest.skip(ABSENT)
    try:
        return tuple(read_source(path).policies())
    except ExportModelError as error:
        return error


def policies_of(path: Path) -> tuple[Policy, ...]:
    """The same, of a file that is a policy: the reader's error is raised."""
    found = policies(path)
    if isinstance(found, ExportModelError):
        raise found
    return found


def policies_or_skip(path: Path) -> tuple[Policy, ...]:
    """The same; what is no policy, or is damaged, is skipped: other tests say which files are."""
    found = policies(path)
    if isinstance(found, ExportModelError):
        pytest.skip(f"no policy: {found.what}")
    return found
