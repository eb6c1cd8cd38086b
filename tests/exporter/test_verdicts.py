"""What a verdict may say: nothing passes that nothing ran, no option is taken that does nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from export_model.converters.files.children.process import RunFailedError
from export_model.exporter.verify.findings import undecided_reference
from export_model.exporter.verify.statistics import FALSE_ALARM, same_distribution
from fixtures import path as fixture
from fixtures.trained import run_folder
from tests.commands import export_model, is_refused

BALL = fixture("continuous")


def test_formats_that_nothing_ran_are_named(tmp_path: Path) -> None:
    ran = export_model(BALL, "-o", tmp_path, "--verify", "onnxruntime")
    assert ran.status == 0
    assert "PASSED: onnx (1 of 4 formats; " in ran.out
    assert " to check the others) agrees with the original as export-model reads it" in ran.out


@pytest.mark.runtimes
def test_a_recording_alone_verifies_nothing(tmp_path: Path) -> None:
    with np.load(fixture("continuous.npz")) as known:
        np.savez(
            tmp_path / "g.npz",
            **{k[6:]: known[k] for k in ("b7/in/state", "b7/in/epsilon")},
            value_estimate=known["b7/out/value_estimate"],
        )
    ran = export_model(
        BALL, "-o", tmp_path / "out", "--to", "tfjs", "--verify", "tensorflow", "--golden", tmp_path / "g.npz"
    )
    assert "NOT VERIFIED" in ran.out
    assert "PASSED" not in ran.out


def test_a_tolerance_for_nothing_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "tolerances.toml"
    file.write_text('[[tolerance]]\noutput = "valu_estimate"\natol = 1.0\nreason = "a slip"\n')
    ran = export_model(BALL, "-o", tmp_path / "out", "--verify", "onnxruntime", "--tolerances", file)
    assert ran.status == 2
    assert "entry 1 covers no comparison" in ran.err
    assert "valu_estimate" in ran.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ('policy = "walker"', "policy 'walker'"),
        ('runtime = "tfjs-cpu"', "runtime 'tfjs-cpu'"),
        ('format = "tfjs"', "format 'tfjs'"),
        ('format = "onnx"\nruntime = "numpy"', "format 'onnx', runtime 'numpy'"),
    ],
)
def test_a_tolerance_for_what_is_not_run_is_refused_before_anything_is_written(
    entry: str, words: str, tmp_path: Path
) -> None:
    file = tmp_path / "tolerances.toml"
    file.write_text(f'[[tolerance]]\n{entry}\natol = 1.0\nreason = "a slip"\n')
    ran = export_model(
        BALL, "-o", tmp_path / "out", "--to", "bytes,onnx", "--verify", "onnxruntime", "--tolerances", file
    )
    assert ran.status == 2
    assert "entry 1 covers no comparison" in ran.err
    assert words in ran.err
    assert not (tmp_path / "out").exists()


def test_a_budget_for_a_format_that_is_not_written_is_refused_before_anything_is_read(tmp_path: Path) -> None:
    nothing = tmp_path / "nothing.bytes"  # not even looked for
    ran = export_model(
        nothing, "-o", tmp_path / "out", "--to", "onnx", "--verify", "onnxruntime", "--max-size", "tfjs=60kB"
    )
    assert ran.status == 2
    assert "--max-size tfjs=…: unknown format here" in ran.err
    assert "there are onnx, total" in ran.err


@pytest.mark.parametrize(("flag", "value"), [("--step", "3"), ("--sensors", "8")])
@pytest.mark.parametrize("command", [(), ("inspect",)], ids=["export", "inspect"])
def test_an_option_that_says_nothing_about_the_source_is_refused(
    command: tuple[str, ...], flag: str, value: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    is_refused(export_model(*command, BALL, flag, value), flag, "says nothing about this source", "leave")
    if flag == "--step":
        assert export_model("inspect", run_folder("3DBall"), flag, "251904").status == 0


@pytest.mark.parametrize("command", ["verify", "snippets"])
def test_a_file_is_no_bundle(command: str) -> None:
    is_refused(export_model(command, BALL), str(BALL), "bundle")


def test_a_budget_is_said_in_bytes(tmp_path: Path) -> None:
    ran = export_model(BALL, "-o", tmp_path, "--verify", "onnxruntime", "--max-size", "onnx=1kB")
    assert ran.status == 1
    size = (tmp_path / "continuous.failed/continuous.onnx").stat().st_size
    assert f"onnx is too large: {size / 1e3:.1f} kB, and the budget is 1.0 kB" in ran.out


@pytest.mark.parametrize(
    ("change", "right"),
    [(lambda x: x, True), (lambda x: x * 1.25, False), (lambda x: x + 0.2, False), (lambda x: x * 0, False),
     (lambda x: x * np.nan, False), (lambda x: x + 1e-6, True)],
)  # fmt: skip
def test_two_samples_are_told_apart(change: object, right: bool) -> None:
    rng = np.random.default_rng(0)
    one, other = rng.standard_normal(4096), rng.standard_normal(4096)
    assert callable(change)
    assert (same_distribution(one, change(other), 1e-5, 1e-5) >= FALSE_ALARM) is right


def test_its_false_alarms_are_as_rare_as_stated() -> None:
    """The p-values of equal distributions are not smaller than uniform ones."""
    rng = np.random.default_rng(1)
    found = np.array([same_distribution(*rng.standard_normal((2, 300)), 0.0, 0.0) for _ in range(1500)])
    for level in (0.01, 0.05, 0.2):
        assert (found < level).mean() <= level + 3 * np.sqrt(level / 1500)


def test_a_reference_that_gives_no_answer_is_told_in_one_line() -> None:
    error = RunFailedError("numpy failed", why="ValueError: shapes\n  why: 2 and 1\n\n  fix: the inputs")
    told = undecided_reference("reference", "numpy", error).reason
    assert (
        told == "the reference gave no answer in numpy: numpy failed: ValueError: shapes; why: 2 and 1; fix: the inputs"
    )
