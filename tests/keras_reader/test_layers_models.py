"""TensorFlow.js layers models: layers and weights that TensorFlow.js itself wrote compute what it computes."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.formats.read import fetch, read_models
from export_model.converters.formats.source import ReadOptions
from export_model.converters.runtimes.javascript.node import js_home, node_executable
from export_model.exporter.export.sources import read_source
from tests.keras_reader.agreement import assert_agrees

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("layers_models")]
NAMES = ("dense", "image", "embedding", "recurrent", "nested")


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    packages, node = js_home() / "node_modules", node_executable()
    if node is None or not packages.is_dir():
        pytest.skip("TensorFlow.js is not installed; get it with: export-model runtimes install tfjs")
    folder = tmp_path_factory.mktemp("layers")
    command = [node, str(Path(__file__).with_name("make_layers_models.mjs")), str(packages), str(folder)]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace")
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


def _array(kept: dict[str, Any]) -> np.ndarray:
    return np.array(kept["values"], np.float32).reshape(kept["shape"])


@pytest.mark.parametrize("name", NAMES)
def test_a_file_says_what_tensorflow_js_computes(models: Path, name: str) -> None:
    (model,) = read_models(*fetch(models / f"{name}.json"), ReadOptions())
    data = json.loads((models / f"{name}.data.json").read_text())
    assert_agrees(model, [_array(data["fed"])], [_array(a) for a in data["given"]])


def test_a_folder_without_a_model_json(models: Path, tmp_path: Path) -> None:
    """``model.save('downloads://nested')`` writes nested.json and nested.weights.bin."""
    for file in ("nested.json", "nested.weights.bin"):
        (tmp_path / file).write_bytes((models / file).read_bytes())
    (policy,) = read_source(tmp_path).policies()
    assert policy.signature.outputs[0].name == "action"
