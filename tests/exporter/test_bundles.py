"""What is in a bundle: the fields of policy.json, true hashes, the same contract in every artefact."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnx
import pytest

from export_model.converters.files.tensorflow_messages import SavedModel, parse
from export_model.converters.formats.bundle import bundle
from export_model.converters.formats.bundle.bundle import Bundle
from export_model.converters.formats.frozen_graph.reader import from_graph_def, read_graph
from export_model.converters.graph.nodes import Graph
from export_model.exporter import __version__
from export_model.signatures.contract import EMBEDDED
from export_model.signatures.errors import BundleError
from export_model.signatures.roles import Role
from fixtures import FIXTURES
from fixtures import path as fixture
from tests.commands import export_model, files_in, is_refused

POLICIES = [*(n for n in FIXTURES if n != "twobrains"), "twobrains-StrikerBrain", "twobrains-Goalie-Brain-2"]
KEYS = [
    *("schema", "name", "family", "algorithm", "action_space", "inputs", "outputs", "memory", "branches"),
    *("preprocess", "constants", "notes", "source", "files", "tool"),
]


@pytest.fixture(scope="module")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All fixtures, exported."""
    folder = tmp_path_factory.mktemp("bundles")
    ran = export_model(*(fixture(name) for name in FIXTURES), "-o", folder, "--verify", "none")
    assert ran.status == 0, ran.err
    return folder


def contract_of(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "policy.json").read_text(encoding="ascii"))
    return content


def test_every_policy_has_a_folder_of_its_own(bundles: Path) -> None:
    assert {p.name for p in bundles.iterdir()} == set(POLICIES)


@pytest.mark.parametrize("name", POLICIES)
def test_a_bundle_has_exactly_its_files(name: str, bundles: Path) -> None:
    assert files_in(bundles / name) == {
        *(f"{name}.bytes", f"{name}.onnx", "policy.json", "saved_model", "saved_model/saved_model.pb"),
        *("tfjs", "tfjs/model.json", "tfjs/group1-shard1of1.bin", "tfjs/policy.mjs", "tfjs/policy.d.mts"),
    }


@pytest.mark.parametrize("name", POLICIES)
def test_the_contract_has_the_fields_that_others_rely_on(name: str, bundles: Path) -> None:
    content = contract_of(bundles / name)
    assert list(content) == KEYS
    assert (content["schema"], content["name"]) == (1, name)
    assert content["tool"] == {"name": "export-model", "version": __version__}
    assert content["action_space"] in ("continuous", "discrete", "hybrid")
    assert isinstance(content["family"], str)
    assert all(isinstance(size, int) for size in content["branches"])
    assert isinstance(content["preprocess"], dict)
    assert all(isinstance(value, int | float) for value in content["constants"].values())
    for tensor in content["inputs"] + content["outputs"]:
        assert set(tensor) - {"distribution"} == {"name", "role", "dtype", "shape", "source"}
        assert tensor["role"] in set(Role)
        assert tensor["shape"][0] is None
        assert all(size is None or isinstance(size, int) for size in tensor["shape"])
        assert tensor["dtype"] in ("float32", "int32", "int64")


@pytest.mark.parametrize("name", POLICIES)
def test_the_hashes_and_sizes_are_true(name: str, bundles: Path) -> None:
    files = contract_of(bundles / name)["files"]
    on_disk = {p for p in files_in(bundles / name) if (bundles / name / p).is_file()}
    assert set(files) == on_disk - {"policy.json"}
    for path, entry in files.items():
        data = (bundles / name / path).read_bytes()
        assert entry == {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}


def test_the_source_is_named_by_its_base_name_and_hash(bundles: Path) -> None:
    for name in FIXTURES[:5]:
        source = contract_of(bundles / name)["source"]
        assert source["path"] == f"{name}.bytes"
        assert source["sha256"] == hashlib.sha256(fixture(name).read_bytes()).hexdigest()
        assert str(fixture(name).parent) not in (bundles / name / "policy.json").read_text()


def sources(folder: Path, key: str) -> dict[str, Any]:
    return {tensor["name"]: tensor["source"] for tensor in contract_of(folder)[key]}


def test_tensors_say_what_they_are_in_the_source(bundles: Path) -> None:
    assert sources(bundles / "continuous", "inputs") == {"state": "state:0", "epsilon": "epsilon:0"}
    assert sources(bundles / "continuous", "outputs") == {
        "action": "action:0",
        "deterministic_action": None,
        "action_probs": "action_probs:0",
        "value_estimate": "value_estimate:0",
    }
    assert sources(bundles / "visual", "inputs") == {
        "state": "state:0",
        "observation_0": "observation_0:0",
        "epsilon": "random_normal/RandomStandardNormal:0",
    }
    assert sources(bundles / "recurrent", "outputs")["recurrent_out"] == "recurrent_out:0"
    assert sources(bundles / "twobrains-StrikerBrain", "inputs") == {
        "state": "StrikerBrain/state:0",
        "epsilon": "StrikerBrain/random_normal/RandomStandardNormal:0",
    }


def test_tensors_say_what_they_look_like(bundles: Path) -> None:
    inputs = {t["name"]: t for t in contract_of(bundles / "recurrent")["inputs"]}
    assert inputs["state"]["shape"] == [None, 6]
    assert (inputs["prev_action"]["dtype"], inputs["prev_action"]["shape"]) == ("int32", [None, 2])
    assert inputs["action_masks"]["distribution"] == {"kind": "mask", "allowed": 1, "forbidden": 0}
    outputs = {t["name"]: t for t in contract_of(bundles / "sampled")["outputs"]}
    assert (outputs["action"]["dtype"], outputs["action"]["role"], outputs["action"]["shape"]) == (
        *("int64", "sampled"),
        [None, 3],
    )
    assert outputs["action_log_probs"]["shape"] == [None, 9]
    normalised = contract_of(bundles / "continuous")["inputs"][0]["distribution"]
    assert (normalised["kind"], len(normalised["mean"]), len(normalised["std"])) == ("normal", 8, 8)
    assert contract_of(bundles / "visual")["preprocess"] == {
        "observation_0": {"layout": "NHWC", "range": [0, 1], "from_bytes": "divide by 255"}
    }


def test_the_facts_are_those_of_the_policy(bundles: Path) -> None:
    facts = {n: contract_of(bundles / n) for n in POLICIES}
    assert {n: f["action_space"] for n, f in facts.items()} == {
        "continuous": "continuous",
        "discrete": "discrete",
        "sampled": "discrete",
        "recurrent": "discrete",
        "visual": "continuous",
        "twobrains-StrikerBrain": "continuous",
        "twobrains-Goalie-Brain-2": "discrete",
    }
    assert facts["discrete"]["branches"] == [3, 2, 4]
    assert facts["twobrains-Goalie-Brain-2"]["branches"] == [4, 2]
    assert facts["continuous"]["branches"] == []
    assert facts["visual"]["algorithm"] == "SAC"
    assert facts["recurrent"]["constants"]["memory_size"] == 32
    assert facts["continuous"]["memory"] is None
    assert any("epsilon" in note for note in facts["visual"]["notes"])


# ------------------------------------------------------------------ the embedded contract


def text_constant(graph: Graph) -> str:
    value = graph[EMBEDDED].value
    assert value is not None
    text = value.item()
    assert isinstance(text, bytes)
    return text.decode()


def in_bytes(folder: Path, name: str) -> str:
    return text_constant(read_graph((folder / f"{name}.bytes").read_bytes()))


def in_saved_model(folder: Path, name: str) -> str:
    message = parse(SavedModel, (folder / "saved_model" / "saved_model.pb").read_bytes(), "SavedModel")
    return text_constant(from_graph_def(message.meta_graphs[0].graph_def))


def in_tfjs(folder: Path, name: str) -> str:
    model = json.loads((folder / "tfjs" / "model.json").read_text())
    return json.dumps(model["userDefinedMetadata"]["contract"])


def in_onnx(folder: Path, name: str) -> str:
    model = onnx.load(folder / f"{name}.onnx")
    properties = {p.key: p.value for p in model.metadata_props}
    return properties[EMBEDDED]


@pytest.mark.parametrize("embedded", [in_bytes, in_saved_model, in_tfjs, in_onnx])
@pytest.mark.parametrize("name", POLICIES)
def test_every_artefact_embeds_the_contract(name: str, embedded: Callable[[Path, str], str], bundles: Path) -> None:
    content = contract_of(bundles / name)
    del content["files"]
    assert json.loads(embedded(bundles / name, name)) == content
    assert EMBEDDED == "export_model_contract"


@pytest.mark.parametrize("name", POLICIES)
def test_no_artefact_says_where_or_when_it_was_made(name: str, bundles: Path) -> None:
    for path in contract_of(bundles / name)["files"]:
        data = (bundles / name / path).read_bytes()
        for private in (str(bundles), str(fixture("continuous").parent), "/root", "/home"):
            assert private.encode() not in data


# ------------------------------------------------------------------ reading a bundle back


@pytest.fixture
def ball(bundles: Path, tmp_path: Path) -> Path:
    """A bundle to spoil."""
    return Path(shutil.copytree(bundles / "continuous", tmp_path / "continuous"))


def rewrite(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    content = contract_of(folder)
    change(content)
    (folder / "policy.json").write_text(json.dumps(content))


def is_no_bundle(folder: Path, *words: object) -> None:
    is_refused(export_model("verify", folder, "--runtimes", "numpy"), *words)
    as_json = export_model("verify", folder, "--runtimes", "numpy", "--json")
    assert as_json.status == 2
    assert as_json.json["error"] == "BundleError"


def test_a_bundle_that_was_not_touched_is_whole(ball: Path) -> None:
    ran = export_model("verify", ball, "--runtimes", "numpy", "--allow-unverified")
    assert (ran.status, ran.err) == (0, "")
    assert "NOT VERIFIED" in ran.out


def test_a_folder_without_a_contract_is_no_bundle(tmp_path: Path) -> None:
    is_no_bundle(tmp_path, tmp_path, "not a bundle", "policy.json")
    is_no_bundle(tmp_path / "nothing", "no such folder", "check the path")
    (tmp_path / "file").write_text("x")
    is_no_bundle(tmp_path / "file", tmp_path / "file", "a file, not a bundle", "-o exported")
    is_no_bundle(tmp_path / "fil", f"did you mean {tmp_path / 'file'}?")


@pytest.mark.parametrize("text", ["", "{", "nonsense", "[" * 100_000, '{"schema": 1', "\x00"])
def test_a_contract_that_is_no_json_is_refused(text: str, ball: Path) -> None:
    (ball / "policy.json").write_text(text)
    is_no_bundle(ball, ball / "policy.json", "is not JSON", "cut off or damaged")


@pytest.mark.parametrize("text", ["{}", '{"schema": 2}', '{"schema": "1"}'])
def test_a_contract_of_another_schema_is_refused(text: str, ball: Path) -> None:
    (ball / "policy.json").write_text(text)
    is_no_bundle(ball, ball / "policy.json", "schema is ", "this version reads 1")


@pytest.mark.parametrize("text", ["[]", "null", "7", '"policy"'])
def test_a_contract_that_is_no_object_is_refused(text: str, ball: Path) -> None:
    (ball / "policy.json").write_text(text)
    is_no_bundle(ball, ball / "policy.json", "must be an object")


@pytest.mark.parametrize(
    ("text", "again"),
    [
        ('"inputs": [', '"inputs": [], "inputs": ['),
        ('"sha256": ', '"sha256": "", "sha256": '),
        ('"name": "continuous"', '"name": "continuous", "n\\u0061me": "continuous"'),
    ],
)
def test_a_contract_that_says_something_twice_is_refused(text: str, again: str, ball: Path) -> None:
    """Whatever it says: a reader in another language may take the other one."""
    path = ball / "policy.json"
    said = path.read_text()
    assert text in said
    path.write_text(said.replace(text, again, 1))
    is_no_bundle(ball, path, f"has {text.split(':')[0].replace(chr(34), chr(39))} twice in one object")


SPOILT: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "no name": (lambda c: c.pop("name"), "name must be the name of a policy"),
    "a name that leads out": (lambda c: c.update(name="../continuous"), "name must be the name"),
    "a name of dots": (lambda c: c.update(name=".."), "name must be the name"),
    "a name that is a number": (lambda c: c.update(name=3), "name must be the name"),
    "no files": (lambda c: c.pop("files"), "files is empty"),
    "files that are a list": (lambda c: c.update(files=["continuous.bytes"]), "files must be an object"),
    "a file without a hash": (
        lambda c: c["files"]["continuous.bytes"].pop("sha256"),
        "files.continuous.bytes.sha256 must be a sha256",
    ),
    "a file without a size": (lambda c: c["files"]["continuous.bytes"].update(bytes="7"), "bytes must be an integer"),
    "a file that is a number": (lambda c: c["files"].update(a=7), "files.a must be an object"),
    "no source": (lambda c: c.pop("source"), "source must be an object"),
    "a source without a hash": (lambda c: c["source"].pop("sha256"), "source.sha256 must be a sha256"),
    "no tool": (lambda c: c.pop("tool"), "tool must be an object"),
    "a name that cannot be printed": (lambda c: c["inputs"][0].update(name="st\nate"), "inputs[0].name must be text"),
    "a shape that is none": (lambda c: c["inputs"][0].update(shape="wide"), "inputs[0].shape must be a list"),
    "a length beyond all": (
        lambda c: c["inputs"][0].update(shape=[None, 10**12]),
        "inputs[0].shape[1] must be an integer",
    ),
    "a length below zero": (lambda c: c["inputs"][0].update(shape=[None, -1]), "inputs[0].shape[1] must be an integer"),
    "a dtype that is none": (lambda c: c["inputs"][0].update(dtype="floaty"), "inputs[0].dtype is 'floaty'"),
    "a role that is none": (lambda c: c["inputs"][0].update(role="deed"), "inputs[0].role is 'deed'"),
    "a role of outputs": (lambda c: c["inputs"][0].update(role="continuous"), "inputs[0].role is 'continuous'"),
    "a source that is a number": (lambda c: c["inputs"][0].update(source=7), "inputs[0].source must be text"),
    "two inputs of one name": (lambda c: c["inputs"].append(c["inputs"][0]), "inputs has two tensors of one name"),
    "no outputs": (lambda c: c.update(outputs=[]), "outputs lacks an action"),
    "one action of a hybrid": (
        lambda c: c.update(action_space="hybrid", outputs=c["outputs"][:1]),
        "outputs lacks an action",
    ),
    "outputs that are names": (lambda c: c.update(outputs=["action"]), "outputs[0] must be an object"),
    "an action space that is none": (lambda c: c.update(action_space="all"), "action_space is 'all'"),
    "a branch without actions": (lambda c: c.update(branches=[0]), "branches[0] must be an integer"),
    "a memory of nothing": (
        lambda c: c.update(memory={"size": 4, "input": "h", "output": "h", "layout": []}),
        "memory.input is 'h'",
    ),
    "statistics of another width": (
        lambda c: c["inputs"][0].update(distribution={"kind": "normal", "mean": [0.0, 1.0], "std": [1.0, 1.0]}),
        "inputs[0].distribution.mean has 2 numbers, and the input 8",
    ),
    "a distribution that is none": (
        lambda c: c["inputs"][0].update(distribution={"kind": "odd"}),
        "inputs[0].distribution.kind is 'odd'",
    ),
    "a spread that is no number": (
        lambda c: c["inputs"][1].update(distribution={"kind": "normal", "mean": 0, "std": "wide"}),
        "inputs[1].distribution.std must be a finite number",
    ),
    "how to prepare what is no input": (
        lambda c: c.update(preprocess={"eye": {"layout": "NHWC", "range": [0, 1], "from_bytes": "x"}}),
        "preprocess names 'eye', which is not an input",
    ),
    "a layout that is none": (
        lambda c: c.update(preprocess={"state": {"layout": "WHNC", "range": [0, 1], "from_bytes": "x"}}),
        "preprocess.state.layout is 'WHNC'",
    ),
    "a constant that is a word": (lambda c: c["constants"].update(a="b"), "constants.a must be a finite number"),
    "a note that moves the cursor": (lambda c: c["notes"].append("\x1b[2J"), "notes["),
    "labels that are a list": (lambda c: c.update(labels=[1]), "labels"),
    "fixed values": (
        lambda c: c["source"].update(fixed={"state:0": {"dtype": "O", "value": 1}}),
        "source.fixed.state:0.dtype is 'O'",
    ),
    "rows that are none": (lambda c: c["source"].update(rows=0), "source.rows must be an integer"),
}


@pytest.mark.parametrize("what", SPOILT)
def test_a_contract_that_does_not_say_where_to_look_is_refused(what: str, ball: Path) -> None:
    change, words = SPOILT[what]
    rewrite(ball, change)
    is_no_bundle(ball, ball / "policy.json", words)


CHANGED: dict[str, Callable[[dict[str, Any]], object]] = {
    "another input": lambda c: c["inputs"][0].update(name="stat"),
    "another shape": lambda c: c["inputs"][1].update(shape=[None, 3]),
    "branches": lambda c: c.update(branches=[7]),
    "another tool": lambda c: c["tool"].update(version="9.9"),
    "one field more": lambda c: c.update(comment="hello"),
}


@pytest.mark.parametrize("what", CHANGED)
def test_a_contract_that_is_not_the_embedded_one_is_refused(what: str, ball: Path) -> None:
    rewrite(ball, CHANGED[what])
    is_no_bundle(ball, ball / "policy.json", "has been changed since it was exported", "embeds")


@pytest.mark.parametrize(
    "path",
    [
        "continuous.bytes",
        "continuous.onnx",
        "saved_model/saved_model.pb",
        "tfjs/model.json",
        "tfjs/group1-shard1of1.bin",
    ],
)
def test_a_file_that_was_changed_or_removed_is_named(path: str, ball: Path) -> None:
    data = (ball / path).read_bytes()
    (ball / path).write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    is_no_bundle(ball, ball / path, "has been changed since it was exported", "sha256")
    (ball / path).unlink()
    is_no_bundle(ball, ball / path, "is missing", "policy.json names it")
    (ball / path).mkdir()
    is_no_bundle(ball, ball / path, "cannot be read")


@pytest.mark.parametrize(
    "path", ["../secret", "tfjs/../../secret", "/etc/hostname", "c:/secret", "tfjs//model.json", "a\\b", "policy.json"]
)
def test_a_contract_that_names_a_file_outside_is_refused(path: str, ball: Path) -> None:
    (ball.parent / "secret").write_text("secret")
    rewrite(ball, lambda c: c["files"].update({path: {"sha256": "0" * 64, "bytes": 6}}))
    is_no_bundle(ball, f"files.{path} ")


def test_a_link_that_leads_outside_is_refused(ball: Path) -> None:
    (ball / "continuous.onnx").rename(ball.parent / "outside.onnx")
    (ball / "continuous.onnx").symlink_to(ball.parent / "outside.onnx")
    is_no_bundle(ball, "names a file outside the bundle: continuous.onnx")
    (ball / "continuous.onnx").unlink()
    (ball / "continuous.onnx").symlink_to(ball / "continuous.onnx")
    is_no_bundle(ball, "continuous.onnx")


def test_a_format_that_the_contract_does_not_name_is_not_run(ball: Path) -> None:
    rewrite(ball, lambda c: c["files"].pop("continuous.onnx"))
    (ball / "continuous.onnx").write_bytes(b"anything")
    ran = export_model("verify", ball, "--runtimes", "numpy", "--allow-unverified", "--json")
    assert ran.status == 0
    assert "onnx" not in ran.json["reports"][0]["sizes"]


def test_a_bundle_of_source_code_alone_has_no_reference(tmp_path: Path) -> None:
    export_model(fixture("continuous"), "-o", tmp_path, "--verify", "none", "--to", "c,js")
    is_no_bundle(tmp_path / "continuous", "has no file that is read back: only c, js", "--to")


def test_another_source_is_refused(ball: Path) -> None:
    ran = export_model("verify", ball, "--source", fixture("discrete"), "--runtimes", "numpy")
    is_refused(ran, fixture("discrete"), "is not the source of this bundle", "continuous.bytes")


@pytest.mark.parametrize("text", ["", "{", "[]", "\udcff", "[" * 100_000])
def test_a_graph_that_embeds_no_contract_is_refused(text: str, bundles: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bundle, "contract_text", lambda graph: text)
    with pytest.raises(BundleError, match="has been changed"):
        Bundle.open(bundles / "continuous").graph()


def test_a_graph_that_is_not_ours_is_no_reference(ball: Path) -> None:
    data = fixture("continuous").read_bytes()
    (ball / "continuous.bytes").write_bytes(data)
    entry = {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
    rewrite(ball, lambda c: c["files"].update({"continuous.bytes": entry}))
    is_no_bundle(ball, ball / "policy.json", "has been changed since it was exported", "embeds")


def test_a_contract_is_read_back_as_it_was_written(bundles: Path) -> None:
    for folder in sorted(bundles.iterdir()):
        assert Bundle.open(folder).contract.to_dict() == contract_of(folder)
        assert list(Bundle.open(folder).contract.to_dict()) == list(contract_of(folder))
