"""Bundles to plant faults in: exported once per session, copied for each test."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.files import tensorflow_messages as schema
from export_model.exporter.export.pipeline import ExportOptions, export
from fixtures import path as fixture
from tests.handmade import dense, graph_bytes, node, placeholder


@dataclass(frozen=True)
class Planted:
    """A copy of a good bundle, and the source it was made from."""

    folder: Path
    source: Path


Bundle = Callable[[str], Planted]


def two_observations() -> bytes:
    """``action`` = tanh(A·x + B·y) of two observations of the same size."""
    nodes = [
        *(placeholder("vector_observation"), placeholder("vector_observation_1")),
        *dense("left", "vector_observation", 3, 2),
        *dense("right", "vector_observation_1", 3, 2),
        node("sum", "Sub", "left", "right"),
        node("action", "Tanh", "sum"),
    ]
    for each in nodes:
        if each.op not in ("Placeholder", "Const"):
            each.attr["T"].type = schema.dtype_number(np.dtype(np.float32))
    return graph_bytes(nodes)


@pytest.fixture(scope="session")
def _exported(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Planted]:
    known: dict[str, Planted] = {}

    def made(name: str) -> Planted:
        if name not in known:
            place = tmp_path_factory.mktemp(name)
            source = place / "two.bytes"
            if name == "two":
                source.write_bytes(two_observations())
            else:
                source = fixture(name)
            (result,) = export([source], ExportOptions(place / "out", verify="none"))
            known[name] = Planted(result.folder, source)
        return known[name]

    return made


@pytest.fixture
def bundle(_exported: Callable[[str], Planted], tmp_path: Path) -> Bundle:
    """A fresh copy of a good bundle, by the fixture's name."""

    def copied(name: str) -> Planted:
        good = _exported(name)
        shutil.copytree(good.folder, tmp_path / good.folder.name)
        return Planted(tmp_path / good.folder.name, good.source)

    return copied
