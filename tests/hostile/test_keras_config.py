"""What a Keras file may be made of: layers of Keras itself. Configurations as data; no Keras is needed."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import pytest

from export_model.converters.formats.keras.config import MAX_CONFIG, config_of, refuse_code
from export_model.converters.formats.source import ReadOptions
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import DamagedFileError, NotAPolicyError

DENSE = {
    "module": "keras.layers",
    "class_name": "Dense",
    "config": {
        "units": 2,
        "activation": "tanh",
        "dtype": {"module": "keras", "class_name": "DTypePolicy", "config": {"name": "float32"}},
        "kernel_initializer": {"module": "keras.initializers", "class_name": "GlorotUniform", "config": {}},
    },
    "registered_name": None,
    "inbound_nodes": [{"args": [{"class_name": "__keras_tensor__", "config": {"shape": [None, 3]}}]}],
}


def model(*layers: Any) -> dict[str, Any]:
    return {
        "module": "keras.src.models.functional",
        "class_name": "Functional",
        "config": {"layers": list(layers)},
        "registered_name": "Functional",
        "compile_config": {"loss": {"module": "mine", "class_name": "function", "config": "loss"}},
    }


def layer(name: Any, module: Any = "keras.layers", **rest: Any) -> dict[str, Any]:
    return {"module": module, "class_name": name, "config": {}, **rest}


CODE = {
    "a Lambda layer": layer("Lambda"),
    "a Lambda layer of old": {"class_name": "Lambda", "config": {"function": ["4wEAAAA=", None, None]}},
    "a marshalled function": {"class_name": "__lambda__", "config": {"value": "4wEAAAA="}},
    "an op of TensorFlow by its name": {"class_name": "TFOpLambda", "config": {"function": "io.write_file"}},
    "a function of the system": layer("system", "os"),
    "a class of another module": layer("Popen", "subprocess"),
    "a builtin": layer("eval", "builtins"),
    "a function by name": layer("function", "builtins", config="exec"),
    "what downloads": layer("get_file", "keras.utils"),
    "what loads": layer("load_model", "keras.models"),
    "a class beside the layers": layer("Progbar", "keras.utils"),
    "a module that only begins alike": layer("Dense", "keras_evil.layers"),
    "a package in keras' place": layer("Dense", "keras.evil"),
    "a registered class": layer("Dense", registered_name="evil>Dense"),
    "a registered class by its name": {"class_name": "evil>Dense", "config": {}},
    "a SavedModel that runs": layer("TFSMLayer"),
    "a lookup that reads a file": layer("StringLookup"),
    "no name": {"class_name": 7, "config": {}},
    "a module that is no text": layer("Dense", 3),
}


def test_layers_of_keras_are_taken() -> None:
    refuse_code(model(DENSE, layer("LSTM", "keras.src.layers.rnn.lstm"), {"class_name": "ReLU", "config": {}}))


@pytest.mark.parametrize("name", CODE)
def test_code_is_refused_by_name(name: str) -> None:
    with pytest.raises(NotAPolicyError, match="code and no layer"):
        refuse_code(model(DENSE, CODE[name]))


@pytest.mark.parametrize("name", CODE)
def test_code_is_refused_wherever_it_is_nested(name: str) -> None:
    wrapped = layer("TimeDistributed", config={"layer": layer("Bidirectional", config={"layer": CODE[name]})})
    with pytest.raises(NotAPolicyError, match="code and no layer"):
        refuse_code(model(DENSE, wrapped))


@pytest.mark.parametrize(
    ("function", "said"),
    [
        ({"value": ["4wEAAAAA", None, None]}, "a lambda"),  # Keras 3.15
        ({"class_name": "__lambda__", "config": {"value": "4wEAAAAA"}}, "a lambda"),
        ({"module": "builtins", "class_name": "function", "config": "mine", "registered_name": "function"}, "'mine'"),
    ],
)
def test_a_function_of_ones_own_is_named_with_its_layer(function: dict[str, Any], said: str) -> None:
    dense = {**DENSE, "config": {**DENSE["config"], "name": "hidden", "activation": function}}
    with pytest.raises(NotAPolicyError, match=f"the activation of its layer 'hidden' is .*{said}") as caught:
        refuse_code(model(DENSE, dense))
    assert "activation or layers of Keras" in str(caught.value)


def test_what_trains_a_model_inside_another_is_built_with_it() -> None:
    inner = layer("Sequential", "keras", compile_config={"optimizer": layer("Adam", "keras.optimizers"), "loss": "mse"})
    evil = layer("Sequential", "keras", compile_config={"loss": CODE["a class of another module"]})
    refuse_code(model(DENSE, inner) | {"compile_config": None}, built=True)
    refuse_code(model(DENSE, evil))  # read as data, no part of it matters
    with pytest.raises(NotAPolicyError, match=r"subprocess\.Popen"):
        refuse_code(model(DENSE, evil) | {"compile_config": None}, built=True)


def archive(path: Path, config: bytes) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("metadata.json", "{}")
        made.writestr("config.json", config)
        made.writestr("model.weights.h5", b"")
    return path


@pytest.mark.parametrize("trusted", [False, True])
def test_a_file_with_code_is_refused_trusted_or_not(tmp_path: Path, trusted: bool) -> None:
    path = archive(tmp_path / "evil.keras", json.dumps(model(CODE["a marshalled function"])).encode())
    with pytest.raises(NotAPolicyError, match="__lambda__"):
        read_source(path, ReadOptions(trust_source=trusted))


def test_a_configuration_that_unfolds_is_not_read(tmp_path: Path) -> None:
    path = archive(tmp_path / "bomb.keras", b" " * (MAX_CONFIG + 1))
    assert path.stat().st_size < MAX_CONFIG // 100
    with pytest.raises(DamagedFileError, match="unfolds to"):
        config_of(path)


@pytest.mark.parametrize("config", [b"{", b"[" * 100_000, b"\xff", b""])
def test_a_configuration_that_is_none(tmp_path: Path, config: bytes) -> None:
    with pytest.raises(DamagedFileError, match="cannot be read"):
        config_of(archive(tmp_path / "bad.keras", config))
