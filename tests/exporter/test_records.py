"""Records tell what they are made of: editors, notebooks and msgspec itself ask their signatures."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from types import ModuleType

import msgspec
import pytest

PACKAGES = ("signatures", "converters", "exporter")


def modules(package: str) -> Iterator[ModuleType]:
    """Every module of a package, but what runs as a program."""
    for found in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}."):
        if not found.name.endswith("__main__"):
            yield importlib.import_module(found.name)


@pytest.mark.parametrize("package", PACKAGES)
def test_the_signature_of_every_record_can_be_asked(package: str) -> None:
    """Annotations that only the type checker imports have a stand-in where the program runs."""
    records = {
        record
        for module in modules(package)
        for record in vars(module).values()
        if isinstance(record, type) and issubclass(record, msgspec.Struct) and record.__module__ == module.__name__
    }
    assert len(records) > 10
    for record in records:
        assert (
            list(inspect.signature(record).parameters) == list(record.__struct_fields__)
            or record.__struct_config__.kw_only
        ), record
