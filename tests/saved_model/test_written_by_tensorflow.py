"""SavedModels, checkpoints and Keras models that TensorFlow wrote: read, exported, compared in the real runtimes."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.formats.checkpoint.tensor_bundle import Checkpoint
from export_model.converters.formats.source import ReadOptions
from export_model.converters.policy.facts import DOUBLES_NARROWED
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.summary import failure_lines
from export_model.signatures.errors import NotAPolicyError, RuntimeUnavailableError, SourceError
from tests.saved_model.models import assert_agrees, roles, sources

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("written_by_tensorflow")]

FLAT = {name: name for name in ("references", "resources", "bare", "bare-resources", "keys", "partitioned")}
OF_FUNCTIONS = {
    "function": "function",
    "winding": "winding",
    "exported": "keras",
    "history": "history",
    "saver": "saver",
    "doubles": "doubles",
    "doubles-cast": "doubles-cast",
}
TRUSTED = ReadOptions(trust_source=True)
#: Read as data, Keras' own run beside it; and one with an operation that Keras alone knows.
WITH_KERAS = {"policy.keras": "keras", "policy.h5": "keras", "beyond.keras": "beyond"}
#: Dilated convolutions, which TensorFlow writes as three ops; TensorFlow 1.4 has none.
DILATED = {"dilated": "dilated"}


@pytest.mark.parametrize(
    ("name", "archive"), [*FLAT.items(), *OF_FUNCTIONS.items(), *WITH_KERAS.items(), *DILATED.items()]
)
def test_reads_what_tensorflow_computes(models: Path, name: str, archive: str) -> None:
    (policy,) = read_source(models / name, TRUSTED).policies()
    assert policy.name == Path(name).stem
    assert_agrees(policy, models / f"{archive}.npz")


@pytest.mark.parametrize("name", [*FLAT, *OF_FUNCTIONS, *WITH_KERAS])
def test_agrees_in_all_runtimes_with_the_original(models: Path, name: str, tmp_path: Path, pool: RuntimePool) -> None:
    (result,) = export([models / name], ExportOptions(tmp_path, read=TRUSTED), pool=pool)
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    assert result.report.reference == "source/tensorflow"


def test_dilated_convolutions_agree_where_they_can_run(models: Path, tmp_path: Path, pool: RuntimePool) -> None:
    options = ExportOptions(tmp_path, ("onnx", "saved_model"), verify=("tensorflow", "onnxruntime"))
    (result,) = export([models / "dilated"], options, pool=pool)
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    assert [n.op for n in result.policy.graph.nodes].count("Conv2D") > 3


@pytest.mark.parametrize("name", ["references", "resources"])
def test_names_of_ml_agents_behind_other_keys(models: Path, name: str) -> None:
    """The recipe of 2019: {in, epsilon} to {out}; the training part is left out."""
    source = read_source(models / name)
    (policy,) = source.policies()
    assert roles(policy) == {"state": "vector_observation", "epsilon": "noise", "action": "continuous"}
    assert sources(policy) == {"state": "vector_observation", "epsilon": "epsilon", "action": "action"}
    assert {f.name for f in source.models[0].files} == {
        *("saved_model.pb", "variables.index", "variables.data-00000-of-00001"),
    }
    assert read_source(models / name / "saved_model.pb").policies()[0].name == name


def test_keys_of_ml_agents_on_other_names(models: Path) -> None:
    (policy,) = read_source(models / "keys").policies()
    assert roles(policy) == {
        "state": "vector_observation",
        "action_masks": "masks",
        "action": "log_probs",
        "value_estimate": "value_estimate",
    }
    assert sources(policy)["state"] == "Placeholder"
    assert policy.signature.branches == (3,)


@pytest.mark.parametrize("name", ["doubles", "doubles-cast"])
def test_doubles_are_narrowed_and_said(models: Path, name: str) -> None:
    """In no tensor that TensorFlow.js would be given, and in the words of the ONNX reader."""
    (policy,) = read_source(models / name).policies()
    assert {s.dtype for s in (*policy.signature.inputs, *policy.signature.outputs)} == {"float32"}
    assert not any(n.value is not None and n.value.dtype == np.float64 for n in policy.graph.nodes)
    assert [n for n in policy.signature.notes if "float64" in n] == [DOUBLES_NARROWED]


def test_a_partitioned_variable_is_joined(models: Path) -> None:
    checkpoint = Checkpoint(models / "partitioned/model-20.ckpt")
    assert checkpoint.names == ["kernel", "whole"]
    kernel = checkpoint.read("kernel")
    assert kernel.shape == (7, 4)
    np.testing.assert_array_equal(checkpoint.read("kernel", ((3, 2), (0, 4))), kernel[3:5])


def test_further_signatures_are_said(models: Path) -> None:
    (policy,) = read_source(models / "exported").policies()
    assert "the signature serving_default was read; there are also serve" in policy.signature.notes


@pytest.mark.parametrize("name", ["version1", "version1/model-5.ckpt", "version1/model-5.ckpt.meta"])
def test_the_first_format_is_refused_with_the_remedy(models: Path, name: str) -> None:
    with pytest.raises(SourceError) as caught:
        read_source(models / name)
    if not name.endswith(".meta"):
        assert isinstance(caught.value, NotAPolicyError)
        assert "V1" in str(caught.value)


def test_a_checkpoint_of_objects_is_refused_with_the_remedy(models: Path) -> None:
    with pytest.raises(NotAPolicyError, match="checkpoint of Python objects") as caught:
        read_source(models / "objects-3.ckpt")
    assert "SavedModel" in str(caught.value.fix)


@pytest.mark.parametrize(
    ("name", "package", "extra"), [("beyond.keras", "tensorflow", "tensorflow"), ("policy.h5", "h5py", "keras")]
)
def test_what_is_not_installed_is_said(
    models: Path, name: str, package: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n, *a: None if n == package else real(n, *a))
    with pytest.raises(RuntimeUnavailableError, match=rf"export-model\[{extra}\]") as caught:
        read_source(models / name, TRUSTED if package == "tensorflow" else ReadOptions())
    assert caught.value.exit_status == 3
    assert name in str(caught.value)


def test_keras_is_loaded_only_where_the_caller_trusts_it(models: Path) -> None:
    with pytest.raises(NotAPolicyError, match=r"'threshold' is Threshold, which is not read as data") as caught:
        read_source(models / "beyond.keras")
    assert "--trust-source" in str(caught.value.fix)


def test_keras_loads_a_link_by_its_own_name(models: Path, tmp_path: Path) -> None:
    """As a cache has it: the file behind the link is called by its hash, and Keras goes by the end of a name."""
    (tmp_path / "1f1f1f").write_bytes((models / "beyond.keras").read_bytes())
    (tmp_path / "policy.keras").symlink_to("1f1f1f")
    assert read_source(tmp_path / "policy.keras", TRUSTED).models


@pytest.mark.parametrize(
    ("name", "words"),
    [("stateful.keras", "its layer 'gru.*' keeps its state in itself"), ("stateful", "it keeps a memory in itself")],
)
def test_a_memory_that_a_model_keeps_in_itself_is_not_lost(models: Path, name: str, words: str) -> None:
    """As constants, its variables would be the zeros of the first step; read as data, the layer gives them out."""
    with pytest.raises(NotAPolicyError) as caught:
        read_source(models / name, TRUSTED).policies()
    assert re.search(words, str(caught.value.why))
    (policy,) = read_source(models / "kept.keras", TRUSTED).policies()
    assert policy.signature.memory is not None
    assert any("keeps its state in itself" in note for note in policy.signature.notes)


@pytest.mark.parametrize("name", ["policy.keras", "policy.h5"])
def test_layers_are_read_without_keras(models: Path, name: str) -> None:
    source = read_source(models / name)
    assert source.models[0].original is None
    assert_agrees(source.policies()[0], models / "keras.npz")


@pytest.mark.parametrize("name", ["policy.keras", "policy.h5"])
def test_damage_is_an_error_of_the_source(models: Path, name: str, tmp_path: Path) -> None:
    content = (models / name).read_bytes()
    file = tmp_path / name
    file.write_bytes(content[: len(content) // 2])
    with pytest.raises(SourceError) as caught:
        read_source(file, TRUSTED)
    assert name in str(caught.value)
    assert "Traceback" not in str(caught.value)
