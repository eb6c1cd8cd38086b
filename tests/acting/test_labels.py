"""--labels: names in the contract, in every artefact, read back, shown."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from export_model.converters.compiler.options import CompileOptions
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import DamagedFileError, UsageError
from export_model.signatures.labels import parse_labels, remaining
from fixtures import path as fixture
from tests.commands import export_model as run
from tests.exporting import export_model

DISCRETE: dict[str, Any] = {
    "observations": {"state": [f"ray {i}" for i in range(10)]},
    "branches": [["stay", "forward", "back"], ["-", "jump"], ["north", "east", "south", "west"]],
}
CONTINUOUS: dict[str, Any] = {
    "observations": {"state": ["x", "z", "ball x", "ball y", "ball z", "vx", "vy", "vz"]},
    "actions": ["roll", "pitch"],
}
TOML = """
actions = ["roll", "pitch"]
[observations]
state = ["x", "z", "ball x", "ball y", "ball z", "vx", "vy", "vz"]
"""


def exported(name: str, out: Path, labels: Any) -> Path:
    (result,) = export_model(fixture(name), out, labels=labels, verify="none")
    return result.folder


def test_they_are_in_the_contract_and_in_every_artefact(tmp_path: Path) -> None:
    folder = exported("discrete", tmp_path, DISCRETE)
    assert json.loads((folder / "policy.json").read_bytes())["labels"] == DISCRETE
    for artefact in ("discrete.bytes", "saved_model", "tfjs", "discrete.onnx"):
        (policy,) = read_source(folder / artefact).policies()
        assert policy.signature.labels == DISCRETE, artefact
    (policy,) = read_source(folder).policies(CompileOptions(names="source"))
    assert policy.signature.labels == DISCRETE


@pytest.mark.parametrize(("suffix", "text"), [(".json", json.dumps(CONTINUOUS)), (".toml", TOML)])
def test_a_file_is_json_or_toml(suffix: str, text: str, tmp_path: Path) -> None:
    file = tmp_path / f"labels{suffix}"
    file.write_text(text, encoding="utf-8")
    ran = run(fixture("continuous"), "-o", tmp_path, "--labels", file, "--verify", "none")
    assert ran.status == 0, ran.err
    assert json.loads((tmp_path / "continuous" / "policy.json").read_bytes())["labels"] == CONTINUOUS
    shown = run("inspect", tmp_path / "continuous").out
    assert "labels of continuous actions: 0 roll, 1 pitch" in shown


def test_without_them_the_contract_has_no_such_field(tmp_path: Path) -> None:
    assert "labels" not in json.loads((exported("discrete", tmp_path, None) / "policy.json").read_bytes())


def test_the_same_labels_give_the_same_bytes(tmp_path: Path) -> None:
    a, b = exported("discrete", tmp_path / "a", DISCRETE), exported("discrete", tmp_path / "b", dict(DISCRETE))
    for path in a.rglob("*"):
        assert path.is_dir() or path.read_bytes() == (b / path.relative_to(a)).read_bytes()


def test_labels_follow_a_name_and_leave_with_what_they_named(tmp_path: Path) -> None:
    (result,) = export_model(
        fixture("twobrains"), tmp_path, brain="Goalie-Brain-2", names="source", verify="none",
        labels={"observations": {"Goalie-Brain-2/state": list("abcde")}, "branches": [list("wxyz"), list("no")]},
    )  # fmt: skip
    (policy,) = read_source(result.folder).policies()
    assert policy.signature.labels["observations"] == {"state": list("abcde")}
    kept = remaining({**policy.signature.labels, "branches": [["one"]]}, policy.signature)
    assert kept == {"observations": {"state": list("abcde")}}


def test_several_policies_have_labels_by_name(tmp_path: Path) -> None:
    named = {"policies": {"twobrains-StrikerBrain": {"actions": ["a", "b", "c"]}}}
    results = {
        r.policy.name: r.contract
        for r in export([fixture("twobrains")], ExportOptions(tmp_path, verify="none", labels=named))
    }
    assert results["twobrains-StrikerBrain"]["labels"] == {"actions": ["a", "b", "c"]}
    assert "labels" not in results["twobrains-Goalie-Brain-2"]
    with pytest.raises(UsageError, match="unknown policy 'Keeper'"):
        export_model(fixture("twobrains"), tmp_path, labels={"policies": {"Keeper": {}}}, verify="none")


@pytest.mark.parametrize(
    ("labels", "words"),
    [
        ({"observations": {"stat": ["x"] * 10}}, "unknown vector observation 'stat'"),
        ({"observations": {"state": ["x"] * 9}}, "has 9 texts, the policy has 10 numbers"),
        ({"observations": {"state": [1] * 10}}, "1 must be text"),
        ({"observations": ["x"]}, "must be a table of lists"),
        ({"actions": ["x"]}, "no continuous actions"),
        ({"branches": [["x"] * 3]}, "has 1 texts, the policy has 3 branches"),
        ({"branches": [["x"] * 3, ["x"] * 3, ["x"] * 4]}, "branch 1"),
        ({"branches": ["xyz", "xy", "wxyz"]}, "branch 0 has no list"),
        ({"action": ["x"]}, "'action' is none of"),
        ({"observations": {"state": ["x\nprint(1)"] * 10}}, "printable"),
        ({"observations": {"state": [" "] * 10}}, "printable"),
    ],
)
def test_what_does_not_fit_is_named_and_nothing_is_written(labels: Any, words: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=words) as caught:
        exported("discrete", tmp_path / "out", labels)
    assert caught.value.fix
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("name", "text"), [("l.json", "{"), ("l.toml", "a="), ("l.json", "[1]"), ("l.json", b"\xff"), ("none.json", None)]
)
def test_a_file_that_is_none_is_an_error_of_the_call(name: str, text: str | bytes | None, tmp_path: Path) -> None:
    file = tmp_path / name
    if text is not None:
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
    ran = run(fixture("discrete"), "-o", tmp_path / "out", "--labels", file, "--verify", "none")
    assert ran.status == 2
    assert f"--labels {file}" in ran.err
    assert "Traceback" not in ran.err


def test_labels_of_an_artefact_that_are_none_are_damage(tmp_path: Path) -> None:
    model = exported("continuous", tmp_path, CONTINUOUS) / "tfjs" / "model.json"
    content = json.loads(model.read_bytes())
    content["userDefinedMetadata"]["contract"]["labels"] = {"actions": ["a\u2028b", "b"]}
    model.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(DamagedFileError, match="printable"):
        read_source(model.parent)


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=12), inner, max_size=3),
    max_leaves=8,
)


@given(_JSON | st.dictionaries(st.sampled_from(["observations", "actions", "branches"]), _JSON))
def test_anything_is_labels_or_a_value_error(content: Any) -> None:
    try:
        labels = parse_labels(content)
    except ValueError:
        return
    assert parse_labels(labels) == labels
