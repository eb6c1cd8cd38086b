"""What a SavedModel takes and gives, by the signature that stands for the policy."""

from __future__ import annotations

from pathlib import Path

from converters.fetch import read_bytes
from converters.format import Ports
from converters.saved_model.reader import read_saved_model
from signatures.errors import NotAPolicyError


def ports(path: Path) -> Ports:
    """The ports of a folder, or of its saved_model.pb. Raises SourceError, NotAPolicyError, DamagedFileError."""
    file = path / "saved_model.pb" if path.is_dir() else path
    signature = read_saved_model(read_bytes(file)).signature
    if signature.key is None:
        raise NotAPolicyError(
            "the SavedModel has no signature",
            where=str(path),
            why="nobody can call it by name",
            fix="save it with signatures={'serving_default': …}",
        )
    options = {"kind": "saved_model", "signature": signature.key}
    return Ports(file.parent, *signature.ports(), options)
