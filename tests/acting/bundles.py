"""Fixtures exported once per session."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

Bundles = Callable[[str], Path]
