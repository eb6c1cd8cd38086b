"""What a report says of a source or a bundle that was refused: the error, by the file that it names."""

from __future__ import annotations

from collections.abc import Iterable

from export_model.signatures.errors import ExportModelError, RefusedError


def each_error(errors: Iterable[ExportModelError]) -> list[ExportModelError]:
    """Return the errors, those of a folder's files one by one."""
    return [one for error in errors for one in (error.errors if isinstance(error, RefusedError) else [error])]


def place_of(error: ExportModelError) -> str:
    """Return the file that an error is about; the program where it names none."""
    return error.where or "export-model"
