"""Where reports go: files that the command line names."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from msgspec import Struct

from export_model.exporter.reports.entry import Entry
from export_model.signatures.errors import ExportModelError, UsageError


class Documents(Struct, frozen=True):
    """What makes each kind of report; none is made that nobody asked for."""

    junit: Callable[[], bytes]
    html: Callable[[], str]
    markdown: Callable[[], str]


def parity_documents(entries: Callable[[], Sequence[Entry]], refused: Sequence[ExportModelError] = ()) -> Documents:
    """Return what makes reports on verifications, and on what was ``refused``; ``entries`` is called for each."""
    from export_model.exporter.reports.refused import each_error

    errors = each_error(refused)

    def junit() -> bytes:
        from export_model.exporter.reports.junit import junit_xml

        return junit_xml(entries(), errors)

    def html() -> str:
        from export_model.exporter.reports.page import page

        return page(entries(), errors)

    def markdown() -> str:
        from export_model.exporter.reports.markdown import markdown_text

        return markdown_text(entries(), errors)

    return Documents(junit, html, markdown)


class Destinations(Struct, frozen=True):
    """The files to write; ``markdown`` may be "-", which is stdout."""

    junit: Path | None = None
    markdown: Path | None = None
    html: Path | None = None

    def prepare(self) -> None:
        """Make the folders, and empty the files of an earlier run, which must not be taken for this one's.

        Before anything that takes long. Raises UsageError where a file cannot be written.
        """
        files = (self.junit, None if self.markdown == Path("-") else self.markdown, self.html)
        paths = [p for p in files if p is not None]
        for path in paths:
            if path.is_dir():
                raise UsageError("is a folder", where=str(path), fix="name a file for the report")
            if paths.count(path) > 1:
                raise UsageError("is named for two reports", where=str(path), fix="give each its own file")
            with _reporting(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                if path.is_file() and not _is_summary(path):
                    path.write_bytes(b"")

    def write(self, documents: Documents, echo: Callable[[str], None]) -> None:
        """Write all of them, each whole; all are made before the first is written. Raises UsageError."""
        content: list[tuple[Path, bytes]] = []
        if self.junit is not None:
            content.append((self.junit, documents.junit()))
        if self.html is not None:
            content.append((self.html, documents.html().encode("utf-8")))
        if self.markdown is not None:
            text = documents.markdown()
            if self.markdown == Path("-"):
                echo(text.rstrip("\n"))
            else:
                content.append((self.markdown, _append_to_summary(self.markdown, text.encode("utf-8"))))
        for path, data in content:
            with _reporting(path):
                path.write_bytes(data)


def _is_summary(path: Path) -> bool:
    summary = os.environ.get("GITHUB_STEP_SUMMARY")
    return bool(summary) and path.absolute() == Path(str(summary)).absolute()


def _append_to_summary(path: Path, data: bytes) -> bytes:
    """GitHub's summary of a job step is appended to, as its documentation asks; any other file is replaced."""
    if not _is_summary(path) or not path.exists():
        return data
    with _reporting(path):
        before = path.read_bytes()
    return before + (b"\n" if before and not before.endswith(b"\n\n") else b"") + data


@contextmanager
def _reporting(path: Path) -> Iterator[None]:
    """What the system refuses inside is a UsageError about ``path``."""
    try:
        yield
    except OSError as error:
        raise UsageError(
            "the report cannot be written", where=str(path), why=error.strerror, fix="name a file that can be"
        ) from error
