"""Flags and folders that cannot be: one message, status 2 (3 for a runtime that is not here), nothing written."""

from __future__ import annotations

import pickle
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.files.chunks import Pieces
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.tolerances import Tolerance
from export_model.signatures.errors import RefusedError, UsageError
from fixtures import path as fixture
from tests.commands import export_model, files_in, is_refused, python
from tests.exporting import export_model as export_by_python
from tests.handmade import continuous_policy, graph_bytes

BALL = fixture("continuous")


@pytest.fixture
def out(tmp_path: Path) -> Iterator[Path]:
    """An output folder that must not exist afterwards."""
    folder = tmp_path / "out"
    yield folder
    assert files_in(tmp_path) == set()


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--to", "onx"], ["--to onx", "did you mean onnx?"]),
        (["--to", "saved-mdel"], ["did you mean saved_model?"]),
        (["--to", "coreml"], ["--to coreml", "the formats are bytes, saved_model, tfjs, onnx"]),
        (["--to", "bytes,onnx,coreml"], ["--to coreml"]),
        (["--to", ""], ["--to names no format", "bytes, saved_model, tfjs, onnx"]),
        (["--to", ","], ["--to names no format"]),
        (["--brain", "Ball"], ["--brain Ball"]),
        (["--input", "state"], ["--input state: NAME=VALUE is expected"]),
        (["--input", "=noise"], ["NAME=VALUE is expected"]),
        (["--input", "state=observations"], ["--input state=observations", "the roles are", "vector_observation"]),
        (["--input", "stat=vector_observation"], ["--input names 'stat'", "close to it: state"]),
        (["--input", "nothing=noise"], ["--input names 'nothing'", "its inputs are state, epsilon"]),
        (["--input", "state=value_estimate"], ["that is not an input's role"]),
        (["--output", "action"], ["--output action: NAME=VALUE is expected"]),
        (["--output", "action=deed"], ["--output action=deed", "the roles are"]),
        (["--output", "actoin=action"], ["--output names 'actoin'", "close to it: action"]),
        (["--output", "action=noise"], ["that is not an output's role"]),
        (["--set", "epsilon"], ["--set epsilon: NAME=VALUE is expected"]),
        (["--set", "epsilon=much"], ["--set epsilon=much", "a number, true or false is expected"]),
        (["--set", "epsilonn=0"], ["--set names 'epsilonn'"]),
        (["--set", "action=0"], ["--set names 'action'", "not a placeholder"]),
        (["--set", "state=0"], ["cannot tell which input is an observation"]),
        (["--opset", "12"], ["opset 12", "13 to 21"]),
        (["--opset", "22"], ["opset 22"]),
        (["--opset", "-1"], ["opset -1"]),
        (["--verify", "tensorflo"], ["unknown runtime 'tensorflo'", "numpy, tensorflow"]),
        (["--verify", "onnxruntime,mxnet"], ["unknown runtime 'mxnet'"]),
        (["--seed", "-1"], ["seed -1: must be a whole number"]),
        (["--atol", "nan"], ["--atol nan"]),
        (["--golden", "nowhere.npz"], ["--golden needs a verification", "--verify none"]),
        (["--max-size", "bytes=1B"], ["--max-size needs a verification"]),
        (["--jobs", "0"], ["--jobs 0: must be 1 or more"]),
        (["--samples", "9"], ["--samples needs a verification"]),
        (["--steps", "9"], ["--steps needs a verification"]),
        (["--seed", "9"], ["--seed needs a verification"]),
        (["--atol", "1"], ["--atol needs a verification"]),
        (["--rtol", "1"], ["--rtol needs a verification"]),
        (["--require", "onnx"], ["--require onnx needs a verification", "--verify none was given"]),
        (["--html", "a.html"], ["--html needs a verification"]),
        (["--html", "a.html", "--junit", "b.xml"], ["--junit, --html need a verification"]),
        (["--to", "tfjs,bytes", "--opset", "18"], ["--opset 18 does not go with --to tfjs,bytes"]),
        (["--to", "onnx", "--guard", "6"], ["--guard 6 does not go with --to onnx"]),
        (["--for", "unity6", "--math", "own"], ["--math own does not go with --for unity6", "leave one of them out"]),
        (["--for", "isaac-lab", "--quantize", "int8"], ["isaac-lab was not shown to read weights"]),
        (["--for", "unity6", "--noise", "lift"], ["--noise lift does not go with --for unity6", "keep or zero"]),
        (["--for", "isaac-lab", "--noise", "lift"], ["--noise lift does not go with --for isaac-lab", "--noise zero"]),
        (["--for", "godot-rl", "--noise", "keep"], ["--noise keep does not go with --for godot-rl"]),
        (["--for", "barracuda-1.0", "--noise", "lift"], ["--noise lift does not go with --for barracuda-1.0"]),
        (["--for", "unity6", "--names", "canonical"], ["--names canonical does not go with --for unity6"]),
        (["--rtol", "inf"], ["--rtol inf"]),
        (["--atol", "-1e-5"], ["--atol -1e-05"]),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) and value[0].startswith("--") else "",
)
def test_a_flag_that_cannot_be_is_refused(
    flags: list[str],
    words: list[str],
    out: Path,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path_factory.mktemp("here"))  # a refusal stands in the reports that were asked for
    is_refused(export_model(BALL, "-o", out, "--verify", "none", *flags), *words)


SAMPLING = (("--samples", "5"), ("--steps", "9"), ("--seed", "9"), ("--rtol", "1"))


def test_what_only_a_comparison_heeds_is_refused_without_one(tmp_path: Path) -> None:
    (made,) = export_by_python(BALL, tmp_path, verify="none", to="bytes,onnx")
    bundle, none = made.folder, ("--verify", "none")
    theirs = (bundle / "continuous.bytes", bundle / "continuous.onnx")
    for flag in (*SAMPLING, ("--require", "onnx")):
        is_refused(export_model("verify", bundle, *none, *flag), f"{flag[0]}", "needs a verification")
        is_refused(export_model("compare", *theirs, *none, *flag), f"{flag[0]}", "needs a verification")
    recorded = tmp_path / "recorded.npz"
    np.savez(recorded, state=np.zeros((2, 8), np.float32), action=np.ones((2, 2), np.float32))
    is_refused(export_model("compare", *theirs, *none, "--golden", recorded), "--golden needs a verification")


def test_what_acts_without_a_comparison_is_taken_without_one(tmp_path: Path) -> None:
    (made,) = export_by_python(BALL, tmp_path, verify="none", to="bytes,onnx")
    recorded = tmp_path / "recorded.npz"
    state, epsilon = np.zeros((2, 8), np.float32), np.zeros((2, 2), np.float32)
    np.savez(recorded, state=state, epsilon=epsilon, action=np.full((2, 2), 7, np.float32))
    verify = ("verify", made.folder, "--verify", "none")
    assert export_model(*verify).status == 0
    assert export_model(*verify, "--max-size", "1kB").status == 1
    assert export_model(*verify, "--golden", recorded).status == 1
    assert export_model(*verify, "--golden", recorded, "--atol", "100").status == 0
    is_refused(export_model(*verify, "--golden", recorded, "--seed", "3"), "--seed needs a verification")


@pytest.mark.filterwarnings("ignore:invalid value encountered in cast")
@pytest.mark.parametrize("value", ["0.5", "1e30", "nan", "-1e300"])
def test_a_value_that_an_integer_cannot_have_is_refused(value: str, out: Path) -> None:
    ran = export_model(fixture("recurrent"), "-o", out, "--verify", "none", "--set", f"sequence_length={value}")
    is_refused(ran, "--set sequence_length", "int32")


@pytest.mark.parametrize(
    ("flags", "word"),
    [
        (["--noise", "some"], "--noise"),
        (["--names", "unity"], "--names"),
        (["--opset", "many"], "--opset"),
        (["--samples", "0"], "--samples"),
        (["--steps", "0"], "--steps"),
        (["--seed", "x"], "--seed"),
        (["--faster"], "--faster"),
        (["-o"], "-o"),
    ],
)
def test_what_the_option_parser_refuses_is_status_2_too(flags: list[str], word: str, out: Path) -> None:
    ran = export_model(BALL, "--out", out, *flags)
    assert ran.status == 2
    assert ran.out == ""
    assert word in ran.err
    assert "Traceback" not in ran.err
    as_json = export_model(BALL, "--out", out, "--json", *flags)
    assert as_json.status == 2
    assert as_json.json["error"] == "UsageError"
    assert as_json.json["exit_status"] == 2
    assert word in as_json.json["what"]


def test_no_source_is_refused(out: Path) -> None:
    is_refused(export_model("-o", out), "no source was given")
    is_refused(export_model("export"), "no source was given")
    is_refused(export_model("-o", out, "--jobs", "2"), "no source was given")


def test_a_name_goes_with_one_policy(out: Path) -> None:
    twobrains = fixture("twobrains")
    is_refused(export_model(twobrains, "-o", out, "--name", "a"), "--name goes with a single policy", "--brain")
    is_refused(export_model(BALL, fixture("discrete"), "-o", out, "--name", "a"), "--name goes with a single policy")


def test_a_brain_that_is_not_there_lists_those_that_are(out: Path) -> None:
    ran = export_model(fixture("twobrains"), "-o", out, "--brain", "Striker")
    is_refused(ran, "--brain Striker", "StrikerBrain, Goalie-Brain-2")


@pytest.mark.parametrize(
    ("call", "words"),
    [
        ({"names": "unity"}, "names='unity'"),
        ({"noise": "some"}, "noise='some'"),
        ({"inputs": {"state": "deed"}}, "--input state=deed: unknown role"),
        ({"to": "onx"}, "did you mean onnx"),
        ({"verify": ["nothing"]}, "unknown runtime 'nothing'"),
        ({"opset": 99}, "opset 99"),
    ],
)
def test_the_python_interface_refuses_the_same(call: dict[str, object], words: str, out: Path) -> None:
    with pytest.raises(UsageError, match=words):
        export_by_python(BALL, out, **{"verify": "none", **call})


@pytest.mark.parametrize("options", [{"seed": -1}, {"samples": 0}, {"steps": 0}, {"samples": 2.5}, {"steps": "4"}])
def test_options_of_verification_are_whole_numbers_within_bounds(options: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="or more"):
        VerifyOptions(**options)
    assert VerifyOptions(seed=np.int64(3)).seed == 3  # type: ignore[arg-type]


@pytest.mark.parametrize("flags", [(), ("--again",)])
def test_a_recording_that_is_not_there_is_said_before_anything_is_read(flags: tuple[str, ...], out: Path) -> None:
    ran = export_model(BALL, "-o", out, "--golden", "nowhere.npz", "--verify", "onnxruntime", *flags)
    is_refused(ran, "nowhere.npz: --golden", "no such file")


def test_tolerances_are_finite_and_not_negative() -> None:
    for tolerance in (Tolerance(atol=float("inf")), Tolerance(rtol=-1.0), Tolerance(atol=float("nan"))):
        with pytest.raises(UsageError, match="must be 0 or more, and finite"):
            VerifyOptions(tolerance=tolerance)
    assert VerifyOptions(tolerance=Tolerance(0.0, 0.0)).tolerance.atol == 0


# ------------------------------------------------------------------ runtimes that are not here


def test_a_runtime_that_was_asked_for_and_is_missing_is_status_3(
    tmp_path: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with tempfile.TemporaryDirectory() as empty:
        monkeypatch.setenv("EXPORT_MODEL_JS", empty)
        ran = export_model(BALL, "-o", out, "--verify", "tfjs-cpu")
        is_refused(ran, "the runtime tfjs-cpu is not installed", "export-model runtimes install tfjs", status=3)
        as_json = export_model(BALL, "-o", out, "--verify", "onnxruntime,tfjs-cpu", "--json")
    assert as_json.status == 3
    assert as_json.json["error"] == "RuntimeUnavailableError"


def test_a_runtime_that_was_not_installed_is_status_3(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(out.parent / "empty"))
    is_refused(export_model(BALL, "-o", out, "--verify", "tf1.4"), "tf1.4", status=3)


def test_full_verification_asks_for_every_runtime(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with tempfile.TemporaryDirectory() as empty:
        monkeypatch.setenv("EXPORT_MODEL_JS", empty)
        is_refused(export_model(BALL, "-o", out, "--verify", "full"), "is not installed", status=3)


# ------------------------------------------------------------------ the output folder


@pytest.fixture
def ball(tmp_path: Path) -> Path:
    """A policy file in a folder of its own."""
    (tmp_path / "source").mkdir()
    (tmp_path / "source" / "Ball.bytes").write_bytes(graph_bytes(continuous_policy()))
    return tmp_path / "source" / "Ball.bytes"


def test_a_folder_that_is_no_bundle_is_not_replaced(ball: Path, tmp_path: Path) -> None:
    (tmp_path / "out" / "Ball").mkdir(parents=True)
    (tmp_path / "out" / "Ball" / "thesis.tex").write_text("years")
    before = files_in(tmp_path)
    ran = export_model(ball, "-o", tmp_path / "out", "--verify", "none")
    is_refused(ran, tmp_path / "out" / "Ball", "already exists", "policy.json", "--name")
    assert files_in(tmp_path) == before
    assert (tmp_path / "out" / "Ball" / "thesis.tex").read_text() == "years"


def test_a_file_or_link_in_the_place_of_the_bundle_is_not_replaced(ball: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "Ball").write_text("mine")
    is_refused(export_model(ball, "-o", tmp_path / "out", "--verify", "none"), "already exists")
    assert (tmp_path / "out" / "Ball").read_text() == "mine"
    (tmp_path / "out" / "Ball").unlink()
    for target in (tmp_path / "source", tmp_path / "nowhere"):
        (tmp_path / "out" / "Ball").symlink_to(target)
        is_refused(export_model(ball, "-o", tmp_path / "out", "--verify", "none"), "already exists")
        (tmp_path / "out" / "Ball").unlink()
    assert files_in(tmp_path / "out") == set()


def test_an_empty_folder_is_taken(ball: Path, tmp_path: Path) -> None:
    (tmp_path / "out" / "Ball").mkdir(parents=True)
    assert export_model(ball, "-o", tmp_path / "out", "--verify", "none").status == 0
    assert (tmp_path / "out" / "Ball" / "policy.json").is_file()


def test_an_output_folder_that_is_a_file_is_refused(ball: Path, tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    is_refused(export_model(ball, "-o", tmp_path / "out", "--verify", "none"), tmp_path / "out", "-o")
    is_refused(export_model(ball, "-o", tmp_path / "out" / "deeper", "--verify", "none"), "-o")
    assert (tmp_path / "out").read_text() == "mine"


def test_two_policies_of_one_name_are_both_written_and_it_is_said(ball: Path, tmp_path: Path) -> None:
    for place in ("BALL.bytes", "runs/ball.bytes"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        shutil.copyfile(ball, tmp_path / place)
    upper, other = tmp_path / "BALL.bytes", tmp_path / "runs" / "ball.bytes"
    ran = export_model(ball, upper, other, "-o", tmp_path / "out", "--verify", "none")
    assert ran.status == 0, ran.err
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["Ball", "runs-ball", f"{tmp_path.name}-BALL"]
    assert f"note: called runs-ball: ball is the policy of {ball}" in ran.out


def test_a_source_that_is_refused_does_not_stop_the_others(ball: Path, tmp_path: Path) -> None:
    bad, gone = tmp_path / "bad.bytes", tmp_path / "gone.bytes"
    bad.write_bytes(b"\x89PNG")
    ran = export_model(bad, ball, gone, "-o", tmp_path / "out", "--verify", "none")
    assert ran.status == 2
    assert (str(bad) in ran.err, str(gone) in ran.err) == (True, True)
    assert [p.name for p in (tmp_path / "out").iterdir()] == [ball.stem]
    answer = export_model(bad, ball, gone, "-o", tmp_path / "out", "--verify", "none", "--json").json
    assert [e["where"] for e in answer["refused"]] == [str(bad), str(gone)]
    assert [p["name"] for p in answer["policies"]] == [ball.stem]
    with pytest.raises(RefusedError, match="2 of 3 sources") as caught:
        export_by_python([bad, ball, gone], tmp_path / "out", verify="none")
    assert len(caught.value.errors) == 2
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


AS_NOBODY = """
import os, sys
from export_model.exporter.cli.main import main
from fixtures import path
from tests.commands import export_model
warm, *arguments = sys.argv[1:]
assert export_model(path("continuous"), "-o", warm, "--verify", "none").status == 0
if os.geteuid() == 0:  # root may do anything: everything is imported by now, so go on as nobody
    os.setegid(65534)
    os.seteuid(65534)
main(arguments)
"""
needs_rights = pytest.mark.skipif(sys.platform == "win32", reason="permissions are another matter there")


@needs_rights
@pytest.mark.parametrize("hidden", [False, True], ids=["no right to write", "no right to look"])
def test_an_output_folder_without_rights_is_refused(hidden: bool, ball: Path, tmp_path: Path) -> None:
    with tempfile.TemporaryDirectory() as top:
        Path(top).chmod(0o755)
        locked = Path(top) / "locked"
        locked.mkdir(mode=0o000 if hidden else 0o555)
        copy = shutil.copyfile(ball, Path(top) / "Ball.bytes")
        out = locked / "out" if hidden else locked
        is_refused(
            python("-c", AS_NOBODY, tmp_path / "warm", copy, "-o", out, "--verify", "none"),
            out,
            "denied",
            "another place",
        )
        locked.chmod(0o755)
        assert files_in(locked) == set()


@needs_rights
def test_a_source_without_rights_is_refused(ball: Path, tmp_path: Path) -> None:
    with tempfile.TemporaryDirectory() as top:
        Path(top).chmod(0o755)
        (Path(top) / "closed").mkdir(mode=0o000)
        copy = Path(shutil.copyfile(ball, Path(top) / "Ball.bytes"))
        copy.chmod(0o000)
        inside = Path(top) / "closed" / "a.bytes"
        for given in (copy, inside):
            ran = python("-c", AS_NOBODY, tmp_path / "warm", given, "-o", tmp_path / "out", "--verify", "none")
            is_refused(ran, given, "cannot be read", "ermission denied")


def test_a_full_disk_leaves_nothing_behind(ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = Pieces.write

    def full_at_the_graph_of_the_saved_model(data: Pieces, path: Path) -> str:
        if path.name == "saved_model.pb":
            raise OSError(28, "No space left on device")
        return written(data, path)

    monkeypatch.setattr(Pieces, "write", full_at_the_graph_of_the_saved_model)
    ran = export_model(ball, "-o", tmp_path / "out", "--verify", "none")
    is_refused(ran, tmp_path / "out", "No space left on device")
    assert files_in(tmp_path / "out") == set()


def test_a_disk_that_is_full_at_the_report_leaves_nothing_behind(
    ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = Path.write_bytes

    def full_at_the_report(path: Path, data: bytes) -> int:
        if path.name == "parity.json":
            raise OSError(28, "No space left on device")
        return written(path, data)

    monkeypatch.setattr(Path, "write_bytes", full_at_the_report)
    is_refused(export_model(ball, "-o", tmp_path / "out", "--verify", "numpy"), "No space left on device")
    assert files_in(tmp_path / "out") == set()


@pytest.mark.parametrize("flag", ["--input", "--output", "--set"])
def test_the_example_of_an_option_is_one_that_it_takes(flag: str, out: Path) -> None:
    message = is_refused(export_model(BALL, flag, "foo", "-o", out), "NAME=VALUE is expected")
    _, _, example = message.partition(f"for example {flag} ")
    name = example.split()[0].partition("=")[0]
    said = is_refused(export_model(BALL, flag, example.split()[0], "-o", out), f"{name!r}" if flag == "--set" else name)
    assert "unknown role" not in said and "is expected" not in said
