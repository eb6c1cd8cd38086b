"""``verify`` of bundles without ``.bytes``: the reference is the source, compiled once more as for the export, or
without it another file of the bundle, read back.

onnxruntime and the source's own answers are the judges.
"""

from __future__ import annotations

import hashlib
import json
import shlex
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from fixtures import path as fixture
from tests.commands import export_model, is_refused

pytest.importorskip("onnxruntime")
pytestmark = pytest.mark.runtimes
RUN = ("--runtimes", "numpy,onnxruntime", "--json")
#: policy, options of its export
CASES = [
    ("continuous", ()),
    ("continuous", ("--deterministic",)),
    ("continuous", ("--noise", "zero")),
    ("continuous", ("--names", "source")),
    ("continuous", ("--dtype", "float16")),
    ("continuous", ("--quantize", "int8")),
    ("continuous", ("--batch", "3")),
    ("sampled", ("--noise", "keep")),
    ("recurrent", ("--deterministic",)),
    ("discrete", ()),
    ("continuous", ("--for", "unity6")),
    ("continuous", ("--for", "unity6", "--deterministic")),
    ("continuous", ("--for", "unity6", "--noise", "zero")),
    ("recurrent", ("--for", "unity6", "--deterministic")),
    ("continuous", ("--for", "isaac-lab")),
    ("continuous", ("--set", "epsilon=0")),
    ("continuous", ("--input", "epsilon=parameter")),
]
ALONE = [(policy, options) for policy, options in CASES if "--for" not in options]


def exported(policy: str, options: tuple[str, ...], out: Path, formats: str = "onnx") -> Path:
    targets = () if "--for" in options else ("--to", formats)
    ran = export_model(fixture(policy), "-o", out, *targets, *options, "--verify", "none", "-q")
    assert ran.status == 0, ran.err
    return out / policy


@pytest.mark.parametrize(("policy", "options"), CASES, ids=lambda v: v if isinstance(v, str) else " ".join(v))
def test_a_bundle_without_bytes_agrees_with_its_source(policy: str, options: tuple[str, ...], tmp_path: Path) -> None:
    ran = export_model("verify", exported(policy, options, tmp_path), "--source", fixture(policy), *RUN)
    assert ran.status == 0, ran
    (report,) = ran.json["reports"]
    assert {c["runtime"] for c in report["comparisons"] if c["format"] == "onnx"} >= {"onnxruntime"}


@pytest.mark.parametrize(("policy", "options"), ALONE, ids=lambda v: v if isinstance(v, str) else " ".join(v))
@pytest.mark.parametrize("formats", ["onnx", "tfjs,onnx", "saved_model,onnx", "litert,onnx"])
def test_without_both_a_file_of_the_bundle_is_the_reference(
    policy: str, options: tuple[str, ...], formats: str, tmp_path: Path
) -> None:
    ran = export_model("verify", exported(policy, options, tmp_path, formats), *RUN)
    assert ran.status == 0, ran
    (report,) = ran.json["reports"]
    assert report["reference"] == f"{formats.removeprefix('litert,').split(',')[0]}/numpy"
    assert {c["runtime"] for c in report["comparisons"] if c["format"] == "onnx"} >= {"onnxruntime"}


@pytest.mark.parametrize("options", [(), ("--deterministic",), ("--for", "unity6", "--deterministic")])
def test_a_changed_weight_is_told(options: tuple[str, ...], tmp_path: Path) -> None:
    folder = exported("continuous", options, tmp_path)
    change_a_weight(folder)
    assert export_model("verify", folder, "--source", fixture("continuous"), *RUN).status == 1


def test_a_weight_that_one_file_alone_has_is_told_without_the_source(tmp_path: Path) -> None:
    folder = exported("continuous", (), tmp_path, "tfjs,onnx")
    change_a_weight(folder)
    ran = export_model("verify", folder, "--runtimes", "numpy,onnxruntime")
    assert ran.status == 1 and "disagree with the bundle's own tfjs" in ran.out


def change_a_weight(folder: Path) -> None:
    file = folder / "continuous.onnx"
    model = onnx.load(file)
    weights = max(model.graph.initializer, key=lambda t: np.prod(t.dims))
    changed = numpy_helper.to_array(weights) * np.float32(1.01)
    weights.CopyFrom(numpy_helper.from_array(changed, weights.name))
    onnx.save(model, file)
    contract = json.loads((folder / "policy.json").read_text())
    contract["files"]["continuous.onnx"] = {
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        "bytes": file.stat().st_size,
    }
    (folder / "policy.json").write_text(json.dumps(contract))


@pytest.mark.parametrize("formats", ["onnx", "onnx,bytes"])
def test_a_baked_action_of_rounded_weights_agrees(formats: str, tmp_path: Path) -> None:
    inputs = exported("continuous", (), tmp_path / "plain")
    size = next(o["shape"][1] for o in json.loads((inputs / "policy.json").read_text())["outputs"])
    labels = {"interface": {"actions": [{"name": "joints", "size": size, "scale": [0.5] * size}]}}
    (tmp_path / "labels.json").write_text(json.dumps(labels))
    options = ("--bake", "actions", "--labels", str(tmp_path / "labels.json"), "--quantize", "int8")
    folder = exported("continuous", options, tmp_path, formats)
    assert export_model("verify", folder, "--source", fixture("continuous"), *RUN).status == 0


def test_the_error_names_the_source_that_would_do(tmp_path: Path) -> None:
    folder = exported("continuous", (), tmp_path, "c")
    is_refused(export_model("verify", folder), "only c", "--source continuous.bytes")


@pytest.mark.parametrize("formats", ["onnx", "onnx,bytes"])
def test_the_next_line_runs_as_pasted(formats: str, tmp_path: Path) -> None:
    ran = export_model(fixture("continuous"), "-o", tmp_path, "--to", formats, "--verify", "none")
    (line,) = [line for line in ran.out.splitlines() if line.startswith("next: export-model verify")]
    _, *arguments = shlex.split(line.removeprefix("next: ").split("    (")[0])
    assert export_model(*arguments, *RUN).status == 0


def test_the_remedy_is_a_runtime_that_runs_the_format(tmp_path: Path) -> None:
    folder = exported("continuous", (), tmp_path, "bytes")
    ran = export_model("verify", folder, "--runtimes", "numpy")
    assert "[onnxruntime]" not in is_refused(ran, "no independent runtime", "--allow-unverified", status=3)
