"""Every layer of the table computes what Keras computes, from the file alone."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.keras.config import config_of
from export_model.converters.formats.keras.layers.table import LAYERS, OPERATIONS
from export_model.converters.formats.keras.network import UnknownLayerError
from export_model.converters.formats.keras.source import read
from export_model.converters.formats.source import ReadOptions
from tests.keras_reader.agreement import assert_agrees

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("keras_reader")]
#: Layers of the table that no model here has, with the reason.
NOT_MET = {
    "SyncBatchNormalization": "BatchNormalization under its name in Keras 2",
    "ThresholdedReLU": "gone from Keras 3",
    "GroupedQueryAttention": "GroupQueryAttention in a configuration",
}
#: Operations under a second name, which another release writes.
OTHER_SPELLINGS = {"Abs", "Amax", "Amin"}


def test_files_say_what_keras_computes(models: Path) -> None:
    files = sorted(p for p in models.iterdir() if p.suffix != ".npz")
    assert len(files) > 40
    for file in files:
        (model,) = read(Fetched(file), ReadOptions())
        with np.load(file.with_suffix(".npz")) as kept:
            fed = [kept[f"in/{i}"] for i in range(sum(k.startswith("in/") for k in kept.files))]
            wanted = [kept[f"out/{i}"] for i in range(len(kept.files) - len(fed))]
        assert_agrees(model, fed, wanted, file.name)


def test_no_layer_and_no_operation_is_left_out(models: Path) -> None:
    met: dict[bool, set[str]] = {False: set(), True: set()}
    stack = [config_of(p) for p in models.glob("*.keras")]
    while stack:
        value = stack.pop()
        if isinstance(value, dict) and "class_name" in value:
            met[".ops." in str(value.get("module"))].add(str(value["class_name"]))
        stack.extend(value.values() if isinstance(value, dict) else value if isinstance(value, list) else ())
    assert set(LAYERS) - met[False] == set(NOT_MET)
    assert set(OPERATIONS) - met[True] == set(OTHER_SPELLINGS)


@pytest.mark.parametrize(
    ("name", "kind", "words"),
    [("nested", "Functional", "is called with training"), ("operations", "Mean", "has initial=5.0")],
)
def test_what_would_be_left_out_is_refused(name: str, kind: str, words: str, models: Path, tmp_path: Path) -> None:
    """A model inside that normalises by its batch; a largest that begins at a number."""
    with zipfile.ZipFile(models / f"{name}.keras") as whole, zipfile.ZipFile(tmp_path / "a.keras", "w") as changed:
        for entry in whole.namelist():
            data = whole.read(entry)
            if entry == "config.json":
                config = json.loads(data)
                layer = next(e for e in config["config"]["layers"] if e["class_name"] == kind)
                if kind == "Functional":
                    layer["inbound_nodes"][0]["kwargs"]["training"] = True
                else:
                    layer["config"]["initial"] = 5.0
                data = json.dumps(config).encode()
            changed.writestr(entry, data)
    with pytest.raises(UnknownLayerError, match=words):
        read(Fetched(tmp_path / "a.keras"), ReadOptions())
