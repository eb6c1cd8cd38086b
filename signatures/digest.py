"""sha256 without OpenSSL.

``import hashlib`` loads libcrypto, 3.5 MiB of a process that peaks at 50. CPython has the same function in a module of
its own (``_sha2`` from 3.12 on, ``_sha256`` before); another Python falls back to hashlib.
"""

from __future__ import annotations

import importlib
from typing import Any


def _sha256() -> Any:
    for name in ("_sha2", "_sha256", "hashlib"):
        try:
            return importlib.import_module(name).sha256
        except (ImportError, AttributeError):
            continue
    raise ImportError("this Python has no sha256")


_new = _sha256()


def sha256_hex(data: bytes) -> str:
    """The sha256 of ``data`` in lower-case hexadecimal."""
    digest: str = _new(data).hexdigest()
    return digest
