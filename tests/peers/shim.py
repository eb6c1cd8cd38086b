"""Runs at every start of Python in the peers' environment: empty modules for what tensorflowjs 4.22 imports in vain.

tensorflow_decision_forests and tensorflow_hub serve models of other kinds than ours, and so does the package's own
jax_conversion, the only module of it that imports jax. None of them has a set of versions that works with the rest.
What they would cost in time and memory is not counted against the converter then.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

ABSENT = ("tensorflow_decision_forests", "tensorflow_hub", "tensorflowjs.converters.jax_conversion")


class _Empty(ModuleType):
    def __getattr__(self, name: str) -> None:
        if name.startswith("__"):
            raise AttributeError(name)


class _Absent(MetaPathFinder, Loader):
    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, self) if fullname in ABSENT else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return _Empty(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Nothing: the module stays empty."""


sys.meta_path.insert(0, _Absent())
