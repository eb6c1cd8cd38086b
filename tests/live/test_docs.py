"""The programs of the Python guide on training scripts run as they are printed."""

from __future__ import annotations

import ast
import importlib.util
import json
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from export_model.exporter.export.sources import read_source
from fixtures import path as fixture
from tests.commands import PYTHONPATH, ROOT, python

GUIDE = (ROOT / "docs/python-guide.md").read_text(encoding="utf-8")
PAGE = GUIDE.partition("\n## From a training script\n")[2].partition("\n## ")[0]
#: Heading → the program under it.
PROGRAMS = {
    text.partition("\n")[0]: match[1]
    for text in PAGE.split("\n### ")[1:]
    if (match := re.search(r"```python\n(.*?)```", text, re.DOTALL))
}
WRITES = {"A session of TensorFlow 1": "Walker", "A tf.function": "Chooser", "A Keras model": "Runner"}
OLD = "Trainers on Python 3.6 and 3.7"


def test_every_program_is_tested() -> None:
    assert PROGRAMS.keys() == {*WRITES, OLD}
    assert PAGE.count("```python") == len(PROGRAMS)


@pytest.mark.slow
@pytest.mark.xdist_group("live")
def test_each_program_exports_its_policy(tmp_path: Path) -> None:
    if importlib.util.find_spec("tensorflow") is None:
        pytest.skip("TensorFlow is not installed; get it with: pip install tensorflow-cpu")
    files = [f"train_{name}.py" for name in WRITES.values()]
    for heading, file in zip(WRITES, files, strict=True):
        (tmp_path / file).write_text(PROGRAMS[heading], encoding="utf-8")
    quiet = {"TF_CPP_MIN_LOG_LEVEL": "3", "CUDA_VISIBLE_DEVICES": "-1"}
    ran = python("-m", "tests.live.programs", *files, cwd=tmp_path, environment=quiet)
    assert ran.status == 0, ran.err[-3000:]
    assert ran.out.split() == [str(Path("exported") / name) for name in WRITES.values()]
    for name in WRITES.values():
        folder = tmp_path / "exported" / name
        (found,) = read_source(folder).policies()
        assert found.name == name
        assert (folder / "parity.json").is_file()


# ------------------------------------------------------------------ older trainers


@pytest.fixture
def export_policies(monkeypatch: pytest.MonkeyPatch) -> tuple[Callable[..., list[str]], dict[str, Any]]:
    """(the function of the page, its globals), with the command of this checkout."""
    names: dict[str, Any] = {}
    exec(PROGRAMS[OLD], names)
    assert names["EXPORT_MODEL"] == ["export-model"]
    names["EXPORT_MODEL"] = [sys.executable, "-m", "export_model"]
    monkeypatch.setenv("PYTHONPATH", PYTHONPATH)
    return names["export_policies"], names


def test_old_trainers_can_run_it() -> None:
    ast.parse(PROGRAMS[OLD], feature_version=(3, 6))
    assert not {"capture_output", "text="} & set(re.findall(r"\w+=?", PROGRAMS[OLD]))  # subprocess has them since 3.7


@pytest.mark.slow
def test_a_run_is_exported_after_training(export_policies: Any, tmp_path: Path) -> None:
    call, _ = export_policies
    run = tmp_path / "models/ppo"
    run.mkdir(parents=True)
    shutil.copy(fixture("continuous"), run / "ppo.bytes")
    assert call(run, tmp_path / "out") == [str(tmp_path / "out/ppo")]
    (found,) = read_source(tmp_path / "out/ppo").policies()
    assert found.name == "ppo"


def test_what_is_no_run_is_said(export_policies: Any, tmp_path: Path) -> None:
    call, _ = export_policies
    with pytest.raises(ValueError, match="no model found in this folder"):
        call(tmp_path, tmp_path / "out")


def saying(status: int, *, out: str = "", err: str = "") -> list[str]:
    """A command that does nothing but say so."""
    code = f"import sys; sys.stdout.write({out!r}); sys.stderr.write({err!r}); sys.exit({status})"
    return [sys.executable, "-c", code]


def test_the_other_exit_codes_are_said(export_policies: Any) -> None:
    call, names = export_policies
    policies = [{"folder": "out/a", "passed": True}, {"folder": "out/b.failed", "passed": False}]
    names["EXPORT_MODEL"] = saying(1, out=json.dumps({"policies": policies}))
    with pytest.raises(RuntimeError, match=r"disagree, see parity.json in out/b.failed$"):
        call("run")
    names["EXPORT_MODEL"] = saying(3, err="no tensorflow")
    with pytest.raises(RuntimeError, match="is missing:\nno tensorflow"):
        call("run")
