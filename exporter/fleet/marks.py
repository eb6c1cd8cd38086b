"""What tells a line that this user's export-model wrote from one that came with an untrusted folder.

A folder of bundles travels: it is downloaded, or lies in a repository that CI checks out. A line which says that a
source was exported and verified would be believed of whoever wrote it. So each line carries a mark, an HMAC-SHA256
under a key that lies in the user's cache and nowhere else; without the key nothing is skipped.
"""

from __future__ import annotations

import hmac
import json
import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

from export_model.converters.runtimes.installed import cache_folder

_BYTES = 32


def read_key() -> bytes | None:
    """The user's key, made at the first call; None where the cache cannot be written, or holds something else there."""
    path = cache_folder() / "fleet.key"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _create_file(path) as made:
            made.write(secrets.token_bytes(_BYTES))
    except FileExistsError:
        pass
    except OSError:
        return None
    try:
        key = path.read_bytes() if path.is_file() else b""
    except OSError:
        return None
    return key if len(key) == _BYTES else None


def _create_file(path: Path) -> BinaryIO:
    return os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb")


def mark(key: bytes, entry: Mapping[str, Any]) -> str:
    """The mark of a line; ``entry`` is all of it but the mark."""
    text = json.dumps({k: v for k, v in entry.items() if k != "mark"}, sort_keys=True)
    return hmac.new(key, text.encode(), "sha256").hexdigest()


def is_marked(key: bytes, entry: Mapping[str, Any]) -> bool:
    """Whether a line was written with this key."""
    return hmac.compare_digest(mark(key, entry), str(entry.get("mark", "")))
