"""sha256 without OpenSSL, but for large data.

``import hashlib`` loads libcrypto, 3.5 MiB of a process that peaks at 50. CPython has the same function in a module of
its own (``_sha2`` from 3.12 on, ``_sha256`` before); another Python falls back to hashlib. OpenSSL's is several times
as fast, which the weights of a large policy are worth.
"""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from typing import Any, BinaryIO

#: Bytes from which on OpenSSL is loaded.
_LARGE = 16 << 20
_CHUNK = 1 << 20


def _sha256() -> Any:
    for name in ("_sha2", "_sha256", "hashlib"):
        try:
            return importlib.import_module(name).sha256
        except (ImportError, AttributeError):
            continue
    raise ImportError("this Python has no sha256")


_new = _sha256()


def hasher(size: int) -> Any:
    """A sha256 in the making, for about ``size`` bytes: it has ``update`` and ``hexdigest``."""
    if size < _LARGE and "_hashlib" not in sys.modules:
        return _new()
    import hashlib

    return hashlib.sha256()


def sha256_hex(data: bytes) -> str:
    """The sha256 of ``data`` in lower-case hexadecimal."""
    whole = hasher(len(data))
    whole.update(data)
    digest: str = whole.hexdigest()
    return digest


def sha256_of_file(path: Path) -> str:
    """As ``sha256_hex``, of a file, which is not held in memory. Raises OSError."""
    with path.open("rb") as file:
        return sha256_of_stream(file)


def sha256_of_stream(file: BinaryIO) -> str:
    """As ``sha256_hex``, of an open file: as many bytes as it has now. Raises OSError."""
    left = os.fstat(file.fileno()).st_size
    whole = hasher(left)
    while left > 0 and (chunk := file.read(min(_CHUNK, left))):
        whole.update(chunk)
        left -= len(chunk)
    digest: str = whole.hexdigest()
    return digest
