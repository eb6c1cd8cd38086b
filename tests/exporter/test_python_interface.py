"""``import export_model``, and the functions of ``exporter``: typed results, the same exceptions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import export_model as public
from export_model.converters.files.children.process import RunFailedError
from export_model.exporter.export.pipeline import ExportResult
from export_model.exporter.inspect.inspection import Inspection
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.report import ParityReport
from export_model.signatures import errors
from export_model.signatures.errors import (
    BundleError,
    ExportModelError,
    NotAPolicyError,
    ParityError,
    RuntimeUnavailableError,
    SourceError,
    UsageError,
)
from export_model.signatures.roles import Role
from fixtures import path as fixture
from tests.commands import export_model as command
from tests.commands import files_in, python
from tests.exporter.rehearsal import ALL, KNOWN, ActingPool, Tensors
from tests.exporting import export_model, inspect_model, load_policy, verify_bundle

BALL = fixture("continuous")


def test_every_error_is_a_name_of_the_package() -> None:
    found = [c for c in vars(errors).values() if isinstance(c, type) and issubclass(c, Exception)] + [RunFailedError]
    assert {kind.__name__ for kind in found} == {name for name in public.__all__ if name.endswith("Error")}
    assert all(getattr(public, kind.__name__) is kind and kind.__module__ == "export_model" for kind in found)
    said = python("-c", "import export_model; export_model.load('nothing.onnx')").err
    assert "\nexport_model.SourceError: nothing.onnx: " in said


def test_the_public_module_takes_options_in_groups(tmp_path: Path) -> None:
    """The same files as with flat keywords."""
    assert set(dir(public)) == set(public.__all__) and len(dir(public)) <= 30
    assert all(getattr(public, name) is not None for name in dir(public))
    read = public.ReadOptions(brain="StrikerBrain", inputs={"StrikerBrain/state": Role.VECTOR})
    write = public.WriteOptions(names="source", noise="zero", deterministic=True)
    none = VerifyOptions(runtimes="none")
    (result,) = public.export(
        fixture("twobrains"), tmp_path / "a", to=["bytes"], name="S", read=read, write=write, verify=none
    )
    export_model(
        fixture("twobrains"),
        tmp_path / "b",
        to="bytes",
        name="S",
        brain="StrikerBrain",
        names="source",
        noise="zero",
        deterministic=True,
        inputs={"StrikerBrain/state": "vector_observation"},
        verify="none",
    )
    first, second = ((tmp_path / place / "S/S.bytes").read_bytes() for place in "ab")
    assert first == second
    assert [s.name for s in result.policy.signature.inputs] == ["StrikerBrain/state"]
    (found,) = public.inspect(fixture("twobrains"), read=read).policies
    assert found.policy.name == "twobrains-StrikerBrain"
    assert public.load(fixture("twobrains"), read=read).name == "twobrains-StrikerBrain"
    judged = VerifyOptions(runtimes="numpy", samples=1)
    assert public.verify(result.folder, verify=judged, allow_unverified=True).samples == 1
    report = public.compare(fixture("twobrains"), result.folder, read=read, verify=judged, allow_unverified=True)
    assert report.passed is None
    with pytest.raises(UsageError, match="loaded as it is"):
        public.load(result.folder, read=public.ReadOptions(step=3))


def test_an_export_gives_a_list_of_results(tmp_path: Path) -> None:
    results = export_model(BALL, tmp_path, verify="none")
    assert isinstance(results, list)
    (result,) = results
    assert isinstance(result, ExportResult)
    assert (result.folder, result.passed, result.report) == (tmp_path / "continuous", None, None)
    assert list(result.sizes) == ["bytes", "saved_model", "tfjs", "onnx"]
    assert result.contract["name"] == result.policy.name == "continuous"
    assert [s.name for s in result.policy.signature.inputs] == ["state", "epsilon"]
    assert (tmp_path / "continuous" / "policy.json").is_file()


def test_paths_may_be_strings_and_several(tmp_path: Path) -> None:
    names = [r.policy.name for r in export_model(str(BALL), str(tmp_path), verify="none")]
    assert names == ["continuous"]
    several = export_model([BALL, str(fixture("twobrains"))], tmp_path, verify="none")
    assert [r.policy.name for r in several] == ["continuous", "twobrains-StrikerBrain", "twobrains-Goalie-Brain-2"]


@pytest.mark.parametrize("to", ["onnx,bytes", ("onnx", "bytes"), ["onnx", "bytes"]])
def test_formats_are_a_list_or_what_the_command_line_takes(to: str | list[str], tmp_path: Path) -> None:
    (result,) = export_model(BALL, tmp_path, to=to, verify="none")
    assert list(result.sizes) == ["onnx", "bytes"]


def test_every_flag_is_a_parameter(tmp_path: Path) -> None:
    (result,) = export_model(
        fixture("twobrains"),
        tmp_path,
        to=["bytes"],
        name="Striker",
        brain="StrikerBrain",
        names="source",
        noise="zero",
        inputs={"StrikerBrain/state": Role.VECTOR},
        outputs={"StrikerBrain/action": "action"},
        verify="none",
    )
    assert result.policy.name == "Striker"
    assert [s.name for s in result.policy.signature.inputs] == ["StrikerBrain/state"]
    (fixed,) = export_model(BALL, tmp_path, values={"epsilon": 0.5}, verify="none", opset=17, to="onnx")
    assert [s.name for s in fixed.policy.signature.inputs] == ["state"]
    (quiet,) = export_model(fixture("visual"), tmp_path, deterministic=True, verify="none", to="onnx")
    assert quiet.policy.signature.outputs[0].role is Role.CONTINUOUS


def test_an_inspection_is_typed() -> None:
    found = inspect_model(fixture("twobrains"))
    assert isinstance(found, Inspection)
    assert found.path == fixture("twobrains")
    assert found.size == fixture("twobrains").stat().st_size
    assert [p.policy.name for p in found.policies] == ["twobrains-StrikerBrain", "twobrains-Goalie-Brain-2"]
    assert [p.policy.signature.branches for p in found.policies] == [(), (4, 2)]
    assert set(found.policies[0].targets.values()) == {None}
    (one,) = inspect_model(str(fixture("twobrains")), brain="StrikerBrain").policies
    assert one.policy.signature.algorithm == "PPO"
    assert [s.name for s in inspect_model(BALL, values={"epsilon": 0}).policies[0].policy.signature.inputs] == ["state"]


def test_what_the_command_line_refuses_is_raised(tmp_path: Path) -> None:
    (tmp_path / "text.bytes").write_text("text\n")
    with pytest.raises(SourceError, match="no such file"):
        export_model(tmp_path / "nothing.bytes")
    with pytest.raises(NotAPolicyError, match="a text file"):
        inspect_model(tmp_path / "text.bytes")
    with pytest.raises(UsageError, match="no source"):
        export_model([])
    with pytest.raises(BundleError, match="not a bundle"):
        verify_bundle(tmp_path)
    with pytest.raises(UsageError, match="unknown runtime"):
        export_model(BALL, tmp_path / "out", verify=["nothing"])
    assert files_in(tmp_path) == {"text.bytes"}


def test_errors_have_their_parts() -> None:
    with pytest.raises(ExportModelError) as caught:
        inspect_model("nothing.bytes")
    error = caught.value
    assert (error.what, error.where, error.why, error.exit_status) == ("no such file", "nothing.bytes", None, 2)
    assert str(error) == error.message == "nothing.bytes: no such file\n  fix: check the path"


def test_a_bundle_is_verified_again(tmp_path: Path) -> None:
    (result,) = export_model(BALL, tmp_path, verify="none")
    report = verify_bundle(result.folder, runtimes="numpy", options=VerifyOptions(samples=1), allow_unverified=True)
    assert isinstance(report, ParityReport)
    assert (report.passed, report.policy, report.reference) == (None, "continuous", "bytes/numpy")
    assert any("the source was not given" in note for note in report.notes)
    with pytest.raises(RuntimeUnavailableError, match="nothing was compared"):
        verify_bundle(str(result.folder), runtimes=["numpy"])
    with_source = verify_bundle(result.folder, source=str(BALL), runtimes="numpy", allow_unverified=True)
    assert with_source.reference == "numpy"


# ------------------------------------------------------------------ disagreement


def _wrong(kind: str, runtime: str, answer: Tensors) -> Tensors:
    """onnxruntime is off by one, for continuous actions of two numbers."""
    wrong = kind == "onnx" and answer.get("action", np.zeros(1)).shape[-1] == 2
    return {n: a + 1 if wrong and n == "action" else a for n, a in answer.items()}


@pytest.fixture
def disagreeing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Played runtimes, one of which is wrong."""
    for module in ("export_model.exporter.export.again", "export_model.converters.runtimes.pool"):
        monkeypatch.setattr(f"{module}.chosen_runtimes", lambda wanted, formats: (ALL, list(KNOWN)))
        monkeypatch.setattr(f"{module}.RuntimePool", lambda: ActingPool(_wrong))


@pytest.mark.usefixtures("disagreeing")
def test_a_disagreement_is_raised_after_everything_is_written(tmp_path: Path) -> None:
    with pytest.raises(ParityError, match="the formats of 1 of 1 policy disagree") as caught:
        export_model(BALL, tmp_path)
    assert caught.value.exit_status == 1
    assert caught.value.where == str(tmp_path / "continuous.failed")
    assert caught.value.report[0]["passed"] is False
    assert (tmp_path / "continuous.failed" / "parity.json").is_file()


@pytest.mark.usefixtures("disagreeing")
def test_a_disagreement_is_a_result_when_nobody_is_strict(tmp_path: Path) -> None:
    (result,) = export_model(BALL, tmp_path, strict=False)
    assert (result.passed, result.folder.name) == (False, "continuous.failed")
    assert result.report is not None
    assert {c.format for c in result.report.failures} == {"onnx"}


@pytest.mark.slow
@pytest.mark.usefixtures("disagreeing")
def test_the_command_line_ends_with_status_1(tmp_path: Path) -> None:
    ran = command(BALL, "-o", tmp_path)
    assert (ran.status, ran.err) == (1, "")
    assert "FAILED: " in ran.out
    assert "onnx in onnxruntime: action differs by 1" in ran.out
    assert ran.out.splitlines()[-1].startswith(f"next: read {tmp_path / 'continuous.failed'}/parity.json")
    several = command(BALL, fixture("discrete"), "-o", tmp_path)
    assert several.status == 1
    assert "PASSED: " in several.out
    assert several.out.splitlines()[-1] == ran.out.splitlines()[-1]
    as_json = command(BALL, "-o", tmp_path, "--json")
    assert as_json.status == 1
    assert (as_json.json["policies"][0]["passed"], as_json.json["policies"][0]["parity"]["passed"]) == (False, False)


@pytest.mark.usefixtures("disagreeing")
def test_what_was_set_aside_goes_with_the_next_that_agrees(tmp_path: Path) -> None:
    export_model(BALL, tmp_path, strict=False)
    (tmp_path / "discrete.failed").mkdir()  # no bundle, so not ours to remove
    for source, left in ((fixture("discrete"), {"continuous.failed", "discrete"}), (BALL, {"continuous", "discrete"})):
        export_model(source, tmp_path, verify="none")
        assert {p.name for p in tmp_path.iterdir()} == {*left, "discrete.failed"}


@pytest.mark.slow
@pytest.mark.usefixtures("disagreeing")
def test_verifying_again_ends_with_status_1_too(tmp_path: Path) -> None:
    command(BALL, "-o", tmp_path)
    folder = tmp_path / "continuous.failed"
    assert folder.is_dir()
    ran = command("verify", folder, "--source", BALL)
    assert (ran.status, ran.err) == (1, "")
    assert "FAILED: " in ran.out
    assert command("verify", folder, "--json").json["reports"][0]["passed"] is False


# ------------------------------------------------------------------ what a person sees of it


def test_everything_that_comes_back_is_one_line_to_look_at(tmp_path: Path) -> None:
    found = inspect_model(fixture("visual"))
    (result,) = export_model(fixture("visual"), tmp_path, verify=["numpy"], to="bytes")
    assert result.report is not None
    acting = load_policy(result.folder)
    agent = acting.agent()
    feeds = {s.name: np.zeros([1, *(n or 1 for n in s.shape[1:])]) for s in acting.signature.observations}
    policy = result.policy
    shown = [found, *found.policies, result, result.report, policy, policy.graph, policy.signature, result.agreed]
    shown += [*policy.signature.inputs, acting, agent, agent.decide(feeds), agent]
    for thing in shown:
        text = repr(thing)
        assert "\n" not in text
        assert len(text) < 250, text
    assert repr(result).startswith("<ExportResult 'visual' not verified: bytes in ")
    assert repr(found).startswith("<Inspection of ")
    assert "'observation_0' [B, " in repr(policy)


@pytest.mark.parametrize(("ran", "said"), [(("onnxruntime",), "(1 of 4 formats)"), (ALL, "(4 of 4 formats)")])
def test_a_result_says_how_many_formats_were_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ran: tuple[str, ...], said: str
) -> None:
    monkeypatch.setattr(
        "export_model.converters.runtimes.pool.chosen_runtimes", lambda wanted, formats: (ran, list(KNOWN))
    )
    monkeypatch.setattr("export_model.converters.runtimes.pool.RuntimePool", ActingPool)
    (result,) = export_model(BALL, tmp_path)
    assert repr(result).startswith(f"<ExportResult 'continuous' {result.report.verdict} {said}: bytes, saved_model, ")


@pytest.mark.usefixtures("disagreeing")
def test_a_notebook_shows_tables_of_escaped_text(tmp_path: Path) -> None:
    (result,) = export_model(BALL, tmp_path / "<b>", strict=False)
    html = result._repr_html_()
    assert "✗" in html
    assert "&lt;b&gt;" in html
    assert html.count("<p>") == html.count('<div class="tex2jax_ignore mathjax_ignore"><p>')  # no name is mathematics
    assert html.count("<tr>") > len(ALL)
    acting = load_policy(BALL, runtime="numpy")._repr_html_()
    assert "continuous: a policy in numpy" in acting and "<td>action</td>" in acting
    assert "normalised inside the policy" in inspect_model(BALL)._repr_html_()


def test_steps_are_logged_and_nothing_is_printed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    caplog.set_level("INFO", logger="export_model")
    export_model(BALL, tmp_path, verify="none", to="onnx")
    said = [r.getMessage() for r in caplog.records]
    assert said[0] == f"reading {BALL}"
    assert said[-1].startswith("<ExportResult 'continuous'")
    assert capfd.readouterr() == ("", "")
