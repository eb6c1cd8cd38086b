"""Errors on a candidate name its own options, --candidate-…, whichever of them would help; the reference's none."""

from __future__ import annotations

from pathlib import Path

import pytest

from export_model.exporter.cli.rows import READING
from export_model.exporter.compare.reading import APART
from fixtures import path
from tests.commands import export_model
from tests.torch_checkpoint import test_state_dicts
from tests.torchscript.test_modules import FOLDER


def test_every_option_that_each_side_has_is_known() -> None:
    assert {row.flag for row in READING if not row.both} == {f"--{name}" for name in APART}


DICTS = {"activation": "rsl_5_5", "script": "ppo_pytorch_discrete"}


def files(folder: Path) -> dict[str, tuple[Path, tuple[str, ...]]]:
    """Option → a file whose error names it, and what else is given."""
    return {
        "sensors": (FOLDER / "chosen_script.pt", ()),
        **{option: (folder / f"{name}.pt", ()) for option, name in DICTS.items()},
        "brain": (path("twobrains"), ()),
        "output": (path("continuous"), ("output", "nothing=action")),
        "input": (path("continuous"), ("input", "nothing=vector")),
        "set": (path("continuous"), ("set", "nothing=1")),
        "step": (path("continuous"), ("step", "3")),
        "sensors of no shape": (FOLDER / "chosen_script.pt", ("sensors", "round")),
        "set to a word": (path("continuous"), ("set", "speed=fast")),
        "repair": (FOLDER.parent / "sb3/sb3_stochastic.onnx", ("repair", "gru-reset")),
    }


def test_several_policies_are_called_as_brain_takes_them() -> None:
    ran = export_model("compare", path("twobrains"), path("twobrains"), "--verify", "none")
    named = ran.err.partition("why: ")[2].partition("\n")[0].split(", ")
    assert len(named) == 2
    for brain in named:
        flags = ("--brain", brain, "--candidate-brain", brain)
        assert (
            export_model("compare", path("twobrains"), path("twobrains"), "--verify", "tensorflow", *flags).status == 0
        )


CASES = [(name, side) for name in files(Path()) for side in ("reference", "candidate")]
CASES.remove(("brain", "candidate"))  # a graph of several is fed by its own names


@pytest.mark.parametrize(("case", "side"), CASES)
def test_an_error_names_the_option_of_its_own_side(case: str, side: str, tmp_path: Path) -> None:
    file, told = files(tmp_path)[case]
    option = case.partition(" ")[0]
    if option in DICTS:
        test_state_dicts.saved(tmp_path, DICTS[option])
    sides = (file, path("discrete")) if side == "reference" else (path("discrete"), file)
    prefix = "" if side == "reference" else "candidate-"
    flags = (f"--{prefix}{told[0]}", told[1]) if told else ()
    ran = export_model("compare", *sides, "--verify", "onnxruntime", *flags)
    assert ran.status == 2, ran.err
    assert f" --{prefix}{option}" in ran.err.replace(": --", " --"), ran.err
    other = f" --{option}" if prefix else f"--candidate-{option}"
    assert other not in ran.err
