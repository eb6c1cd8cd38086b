"""The card of a bundle: the same bytes twice, read by huggingface_hub's own classes, safe from names of strangers."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from export_model.signatures.contract import PARITY, POLICY
from tests.commands import export_model
from tests.interfaces.made import run_with


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    path = run_with(tmp_path, "IO_descriptors.yaml", place="io_descriptors")
    ran = export_model(path, "-o", tmp_path / "out", "--to", "onnx,bytes", "--verify", "onnxruntime,numpy")
    assert ran.status == 0, ran.err
    return tmp_path / "out" / "policy"


def keep_played(bundle: Path, environment: str = "Walker-v1") -> None:
    """As ``play`` keeps it in parity.json."""
    earned = {"episodes": 4, "mean_return": 2.5, "return_interval": [0.4457, 4.554]}
    other = {**earned, "name": "onnx in onnxruntime", "verdict": "EQUIVALENT", "difference": 0.0}
    record = {
        "environment": environment,
        "verdict": "EQUIVALENT",
        "sentence": "policy: EQUIVALENT",
        "seed": 0,
        "deterministic": False,
        "confidence": 0.95,
        "margin": {"asked": "1%", "value": 0.025},
        "reference": {**earned, "name": "the original"},
        "players": [{**other, "interval": [0.0, 0.0], "sentence": ""}],
    }
    file = bundle / PARITY
    content = json.loads(file.read_text())
    file.write_text(json.dumps({**content, "played": [record]}))


def card(folder: Path, *options: object) -> str:
    ran = export_model("card", folder, *options)
    assert ran.status == 0, ran.err
    return (folder / "README.md").read_text(encoding="utf-8")


def test_the_same_bundle_gives_the_same_bytes(bundle: Path) -> None:
    first = card(bundle)
    assert card(bundle) == first
    assert export_model("verify", bundle, "--runtimes", "onnxruntime").status == 0  # it does not disturb the bundle


def test_it_says_what_the_contract_says(bundle: Path) -> None:
    text = card(bundle)
    contract = json.loads((bundle / POLICY).read_text())
    for entry in contract["files"].values():
        assert entry["sha256"] in text
    data = (bundle / "policy.onnx").read_bytes()
    assert hashlib.sha256(data).hexdigest() in text
    assert contract["source"]["sha256"] in text
    assert "base\\_ang\\_vel" in text and "rad/s" in text
    assert "PASSED" in text and 'onnxruntime.InferenceSession("policy.onnx"' in text
    assert "license:" not in text.split("---")[1]  # the user's to say


def test_huggingface_hub_reads_it(bundle: Path) -> None:
    hub = pytest.importorskip("huggingface_hub", reason="pip install huggingface-hub: it is of the dev extra")
    keep_played(bundle)
    text = card(bundle)
    found = hub.ModelCard(text)
    assert isinstance(found.data, hub.ModelCardData)
    assert found.data.pipeline_tag == "reinforcement-learning"
    assert {"reinforcement-learning", "onnx"} <= set(found.data.tags)
    assert found.data.license is None
    (result,) = found.data.eval_results
    assert (result.task_type, result.dataset_name, result.metric_type) == (
        *("reinforcement-learning", "Walker-v1"),
        "mean_reward",
    )
    again = hub.ModelCard(f"---\n{found.data.to_yaml()}\n---\n{found.text}")
    assert again.data.to_dict() == found.data.to_dict()


def test_returns_are_those_that_parity_json_keeps(bundle: Path) -> None:
    keep_played(bundle)
    text = card(bundle)
    assert text.count("2.5 (0.4457 to 4.554)") == 2 and "| onnx in onnxruntime |" in text


def test_another_record_is_refused(bundle: Path) -> None:
    (bundle / PARITY).write_text(json.dumps({"played": [{"environment": 1}]}))
    ran = export_model("card", bundle)
    assert ran.status == 2 and "cannot be read: played[0].environment" in ran.err


def test_a_bundle_that_was_changed_or_is_none_is_refused(bundle: Path, tmp_path: Path) -> None:
    (bundle / "policy.onnx").write_bytes(b"another")
    ran = export_model("card", bundle)
    assert ran.status == 2 and "policy.onnx" in ran.err
    ran = export_model("card", tmp_path / "exported")
    assert ran.status == 2 and "not a bundle" in ran.err


def test_names_of_strangers_stay_text(tmp_path: Path) -> None:
    hub = pytest.importorskip("huggingface_hub", reason="pip install huggingface-hub: it is of the dev extra")
    name = 'x"\n---\nlicense: mit\n``` | <script>alert(1)</script> [a](http://b)'.replace("\n", " ")
    labels = {"interface": {"actions": [{"name": name, "size": 2, "scale": [2]}]}, "actions": [name[:100], "b"]}
    (tmp_path / "labels.json").write_text(json.dumps(labels))
    path = run_with(tmp_path)
    asked = ("--labels", tmp_path / "labels.json", "--to", "onnx", "--verify", "onnxruntime")
    assert export_model(path, "-o", tmp_path / "out", *asked).status == 0
    folder = tmp_path / "out" / "policy"
    keep_played(folder, "a: \"b' #c")
    text = card(folder)
    found = hub.ModelCard(text)
    assert found.data.license is None
    assert found.data.eval_results[0].dataset_name == "a: \"b' #c"
    outside = "".join(text.split("````")[::2]) if "````" in text else text
    assert "<script>" not in outside and "[a](" not in outside
