"""A file of settings that a user wrote, TOML or JSON: read within bounds, since it is untrusted."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from export_model.converters.files.fetch import read_bytes
from export_model.signatures.errors import SourceError, UsageError

_MOST_BYTES = 1 << 20
#: Parts of a dotted key; tomllib takes the square of their number.
_MOST_PARTS = 32
#: A number whose digits Python does not write out again.
_LONG_NUMBER = re.compile("0[xob][0-9a-fA-F_]{1000}")


def read_options(path: Path, where: str, *, toml: bool) -> Any:
    """What it holds. Raises UsageError where it cannot be read, ValueError or RecursionError where it is neither."""
    try:
        text = read_bytes(path, empty=True, most=_MOST_BYTES).decode("utf-8-sig")
    except SourceError as error:
        raise UsageError(f"cannot be read: {error.what}", where=where, why=error.why, fix=error.fix) from error
    if not toml:
        return json.loads(text)
    import tomllib

    if any(part.count(".") > _MOST_PARTS for part in re.split(r"[=\n{},\[\]]", text)):
        raise ValueError(f"a key has more than {_MOST_PARTS} parts")
    if _LONG_NUMBER.search(text):
        raise ValueError("a number has more than a thousand digits")
    return tomllib.loads(text)
