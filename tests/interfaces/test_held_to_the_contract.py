"""What a file states of the numbers by itself, beside its contract: verify holds it to policy.json."""

from __future__ import annotations

from pathlib import Path

import onnx
import pytest

from tests.commands import export_model
from tests.hostile.zoo_bundles import rehashed
from tests.interfaces.made import mjlab

TASK = "Mjlab-Lift-Cube-Yam"
EXTENSIONS = {"c": "h", "csharp": "cs", "js": "mjs"}


def exported(folder: Path, *options: str) -> Path:
    ran = export_model(mjlab(folder, TASK), "-o", folder / "out", "--verify", "none", *options)
    assert ran.status == 0, ran.err
    return folder / "out" / "policy"


@pytest.mark.parametrize("key", ["joint_names", "action_scale", "default_joint_pos", "observation_names"])
@pytest.mark.parametrize("change", ["exchanged", "other", "missing"])
def test_metadata_is_held_to_the_contract(key: str, change: str, tmp_path: Path) -> None:
    bundle = exported(tmp_path, "--to", "bytes,onnx")
    path = bundle / "policy.onnx"
    model = onnx.load(path)
    (entry,) = (p for p in model.metadata_props if p.key == key)
    words = entry.value.split(",")
    if change == "missing":
        model.metadata_props.remove(entry)
    else:
        entry.value = ",".join(words[::-1] if change == "exchanged" and words != words[::-1] else ["0.7", *words[1:]])
    onnx.save(model, path)
    rehashed(bundle)
    ran = export_model("verify", bundle, "--runtimes", "onnxruntime")
    assert ran.status == 2
    assert f"its metadata has {key!r}" in ran.err


def test_metadata_that_would_be_applied_twice(tmp_path: Path) -> None:
    """The graph computes the scale; a robot that finds it in the file computes it again."""
    bundle = exported(tmp_path, "--to", "bytes,onnx", "--bake", "actions")
    model = onnx.load(bundle / "policy.onnx")
    model.metadata_props.add(key="action_scale", value="0.5")
    onnx.save(model, bundle / "policy.onnx")
    rehashed(bundle)
    ran = export_model("verify", bundle, "--runtimes", "onnxruntime")
    assert ran.status == 2 and "its metadata has 'action_scale' as '0.5'" in ran.err


@pytest.mark.parametrize("key", EXTENSIONS)
def test_comments_are_held_to_the_contract(key: str, tmp_path: Path) -> None:
    bundle = exported(tmp_path, "--to", f"bytes,{key}")
    path = bundle / f"policy.{EXTENSIONS[key]}"
    text = path.read_text()
    line = next(line for line in text.splitlines() if line.startswith("   | ") and "joint" in line)
    path.write_text(text.replace(line, line.replace("joint", "hinge"), 1))
    rehashed(bundle)
    ran = export_model("verify", bundle, "--runtimes", "none")
    assert ran.status == 2 and "its comment on the numbers differs" in ran.err
