"""Records tell what they are made of: editors, notebooks and msgspec itself ask their signatures."""

from __future__ import annotations

import importlib
import inspect
import pickle
import pkgutil
from collections.abc import Iterator
from types import ModuleType

import msgspec
import pytest

from export_model.signatures.code import CodeOptions
from export_model.signatures.fields import Record

PACKAGES = ("signatures", "converters", "exporter")


def modules(package: str) -> Iterator[ModuleType]:
    """Every module of a package, but what runs as a program."""
    for found in pkgutil.walk_packages(
        importlib.import_module(f"export_model.{package}").__path__, f"export_model.{package}."
    ):
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


def test_what_is_left_out_of_json_is_none_or_empty() -> None:
    """msgspec leaves out the very object that is the default: a text or number is another one after a pickle."""
    for package in PACKAGES:
        [*modules(package)]
    records = [*Record.__subclasses__()]
    for record in records:
        records += record.__subclasses__()
        if record.__struct_config__.omit_defaults:
            assert {*map(repr, record.__struct_defaults__)} <= {"None", "()", "''", "NODEFAULT"} | {
                repr(default) for default in record.__struct_defaults__ if hasattr(default, "factory")
            }, record
    assert len(records) > 15


def test_options_that_were_sent_to_another_process_say_the_same() -> None:
    assert pickle.loads(pickle.dumps(CodeOptions())).to_dict() == {}
    sent = pickle.loads(pickle.dumps(CodeOptions(math="own", guard=6.0)))
    assert sent.to_dict() == {"math": "own", "guard": 6.0}
