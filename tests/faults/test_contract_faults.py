"""Contracts that say something wrong: of a bundle's own artefacts, or in all of its copies alike."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from export_model.converters.formats.registry import DEFAULTS, WRITTEN
from export_model.exporter.export import sources
from export_model.exporter.export.again import verify_folder
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.signatures.errors import BundleError
from export_model.signatures.spec import Memory, PolicySignature
from fixtures import path as fixture

Said = dict[str, Any]


def exported(name: str, folder: Path, **options: Any) -> Path:
    (result,) = export([fixture(name)], ExportOptions(folder, targets=DEFAULTS, verify="none", **options))
    return result.folder


@pytest.fixture(scope="module")
def recurrent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported("recurrent", tmp_path_factory.mktemp("contracts"))


def _set(*path: Any) -> Callable[[Said], None]:
    *way, last, value = path

    def change(content: Said) -> None:
        place: Any = content
        for key in way:
            place = place[key]
        place[last] = value

    return change


def _swapped(content: Said) -> None:
    first, *_, third = (o for o in content["outputs"] if o["dtype"] == "float32" and o["role"] != "memory_out")
    first["name"], third["name"] = third["name"], first["name"]


FIELDS: dict[str, Callable[[Said], None]] = {
    "two outputs swapped": _swapped,
    "branches of other sizes": _set("branches", [2, 3]),
    "the memory's parts turned": _set("memory", "layout", ["h", "c"]),
    "a mask that forbids": _set("inputs", 1, "distribution", {"kind": "mask", "allowed": 0, "forbidden": 1}),
    "a normaliser of other numbers": _set(
        "inputs", 0, "distribution", {"kind": "normal", "mean": [5.0] * 6, "std": [2.0] * 6}
    ),
    "another action space": _set("action_space", "continuous"),
    "another role": _set("outputs", 0, "role", "action_probs"),
}


@pytest.mark.parametrize("field", FIELDS)
def test_a_contract_that_was_changed_beside_its_artefacts(field: str, recurrent: Path, tmp_path: Path) -> None:
    folder = tmp_path / "recurrent"
    shutil.copytree(recurrent, folder)
    content = json.loads((folder / "policy.json").read_text())
    FIELDS[field](content)
    (folder / "policy.json").write_text(json.dumps(content))
    with pytest.raises(BundleError):
        verify_folder(folder, runtimes="onnxruntime")


@pytest.mark.parametrize("kind", DEFAULTS)
def test_an_artefact_that_embeds_another_contract(kind: str, recurrent: Path, tmp_path: Path) -> None:
    """It is what load_policy, policy.mjs and every reader go by who is given that file alone."""
    folder = tmp_path / "recurrent"
    shutil.copytree(recurrent, folder)
    labels = {"observations": {"state": ["a", "b", "c", "d", "e", "f"]}}
    other = exported("recurrent", tmp_path / "other", labels=labels)
    first = WRITTEN[kind].first_file_of("recurrent")
    data = (other / first).read_bytes()
    assert data != (folder / first).read_bytes()
    (folder / first).write_bytes(data)
    content = json.loads((folder / "policy.json").read_text())
    content["files"][first] = {"sha256": sha256(data).hexdigest(), "bytes": len(data)}
    (folder / "policy.json").write_text(json.dumps(content))
    with pytest.raises(BundleError, match="not the contract that the artefact embeds"):
        verify_folder(folder, runtimes="onnxruntime")


def _memory_turned(s: PolicySignature) -> PolicySignature:
    assert s.memory is not None
    return replace(s, memory=Memory(s.memory.size, s.memory.input, s.memory.output, ("h", "c")))


def _colours(s: PolicySignature) -> PolicySignature:
    return replace(s, preprocess={name: {**said, "range": [0, 255]} for name, said in s.preprocess.items()})


def _layout(s: PolicySignature) -> PolicySignature:
    return replace(s, preprocess={name: {**said, "layout": "NCHW"} for name, said in s.preprocess.items()})


def _outputs_swapped(s: PolicySignature) -> PolicySignature:
    a, b, *rest = s.outputs
    return replace(s, outputs=(replace(a, source=b.source), replace(b, source=a.source), *rest))


WRONG: dict[str, tuple[str, str, Callable[[PolicySignature], PolicySignature]]] = {
    "branches of other sizes": ("recurrent", "branches", lambda s: replace(s, branches=(2, 3))),
    "the memory's parts turned": ("recurrent", "memory", _memory_turned),
    "colours to 255": ("visual", "preprocess", _colours),
    "channels first": ("visual", "preprocess", _layout),
    "outputs swapped": ("continuous", "source", _outputs_swapped),
    "no normaliser": (
        "continuous",
        "distribution",
        lambda s: replace(
            s, inputs=tuple(replace(i, distribution={"kind": "normal", "mean": 3.0, "std": 1.0}) for i in s.inputs)
        ),
    ),
}


@pytest.mark.parametrize("fault", WRONG)
def test_a_contract_that_is_wrong_in_all_its_copies_is_met_by_the_source(
    fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, what, spoil = WRONG[fault]
    right = sources.compile_graph
    with monkeypatch.context() as patched:
        patched.setattr(
            sources,
            "compile_graph",
            lambda *args: [replace(p, signature=spoil(p.signature)) for p in right(*args)],
        )
        folder = exported(name, tmp_path)
    with pytest.raises(BundleError, match=rf"says otherwise of .*{what}"):
        verify_folder(folder, source=fixture(name), runtimes="onnxruntime")
