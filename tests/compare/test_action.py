"""The GitHub Action, run as the script that it is."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from export_model.converters.runtimes.javascript.node import js_home, package_version
from export_model.exporter.export.pipeline import ExportOptions, export
from fixtures import path as fixture

ROOT = Path(__file__).resolve().parents[2]
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform == "win32", reason="GitHub's Windows runners have bash; this machine need not"),
]


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out")
    return next(iter(export([fixture("continuous")], ExportOptions(out, verify="none")))).folder


#: One of them in Node, where its packages are here.
HERE = "numpy,onnxruntime" + ("" if package_version(js_home(), "@tensorflow/tfjs") is None else ",tfjs-cpu")


class Job:
    """A runner of GitHub's: a folder, the files that steps write to."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.summary, self.output = folder, folder / "summary.md", folder / "output"

    def run(self, **inputs: str) -> subprocess.CompletedProcess[str]:
        environment = {
            "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
            "HOME": os.environ.get("HOME", str(self.folder)),
            "GITHUB_STEP_SUMMARY": str(self.summary),
            "GITHUB_OUTPUT": str(self.output),
            "EXPORT_MODEL_INSTALL": "",
            "EXPORT_MODEL_JAVASCRIPT": "false",
            "EXPORT_MODEL_RUNTIMES": "onnxruntime",
            **{f"EXPORT_MODEL_{name.upper()}": value for name, value in inputs.items()},
        }
        return subprocess.run(
            ["bash", str(ROOT / ".ci" / "action.sh")],
            cwd=self.folder,
            env=environment,
            capture_output=True,
            encoding="utf-8",
        )


@pytest.fixture
def job(tmp_path: Path) -> Job:
    return Job(tmp_path)


def test_a_bundle_is_verified_and_reported(job: Job, bundle: Path) -> None:
    done = job.run(paths=f"\n  {bundle}  \n", arguments=f"--source={fixture('continuous')}\n\n--seed=3")
    assert done.returncode == 0, done.stderr
    assert "PASSED" in done.stdout
    assert job.output.read_text() == "status=0\n"
    assert "continuous" in job.summary.read_text()
    assert ET.parse(job.folder / "parity" / "parity.xml").getroot().tag == "testsuites"
    assert (job.folder / "parity" / "parity.html").read_text().lower().startswith("<!doctype html>")


def test_a_disagreement_fails_the_step(job: Job, bundle: Path) -> None:
    done = job.run(paths=str(bundle), arguments="--max-size=onnx=1kB", report="out/reports")
    assert done.returncode == 1
    assert job.output.read_text() == "status=1\n"
    assert "::error" in done.stderr
    assert "out/reports/parity.html" in done.stderr
    assert ET.parse(job.folder / "out" / "reports" / "parity.xml").findall(".//failure")


def test_artefacts_are_compared(job: Job, bundle: Path) -> None:
    done = job.run(command="compare", paths=f"{fixture('continuous')}\n{bundle / 'continuous.onnx'}")
    assert done.returncode == 0, done.stderr + done.stdout


def test_a_source_is_exported(job: Job) -> None:
    done = job.run(command="export", paths=str(fixture("discrete")), arguments="--out=models")
    assert done.returncode == 0, done.stderr
    assert (job.folder / "models" / "discrete" / "policy.json").is_file()


@pytest.mark.parametrize(
    ("inputs", "words"),
    [({"command": "rm -rf ."}, "it is verify, compare or export"), ({"paths": " \n "}, "paths is empty")],
)
def test_bad_inputs_are_status_2(job: Job, inputs: dict[str, str], words: str) -> None:
    done = job.run(**{"paths": "bundle", **inputs})
    assert done.returncode == 2
    assert words in done.stderr


def test_no_input_is_ever_shell_code(job: Job) -> None:
    evil = "$(touch owned) `touch owned`; touch owned #"
    done = job.run(paths=evil, arguments=f"--source={evil}")
    assert done.returncode == 2
    assert not (job.folder / "owned").exists()


def test_every_input_of_the_action_reaches_the_script() -> None:
    text = (ROOT / "action.yml").read_text()
    inputs = set(re.findall(r"^  (\w+):\n    description", text.split("outputs:")[0], re.M))
    passed = dict(re.findall(r"EXPORT_MODEL_(\w+): \$\{\{ inputs\.(\w+) \}\}", text))
    assert {name.lower() for name in passed} == set(passed.values()) == inputs
    script = (ROOT / ".ci" / "action.sh").read_text()
    assert all(f"EXPORT_MODEL_{name}" in script for name in passed)


def test_nothing_of_the_checked_out_repository_is_run(job: Job, bundle: Path) -> None:
    """The action installs with pip and runs export-model in that folder; its modules are a stranger's."""
    marker = job.folder / "was-run"
    text = f"from pathlib import Path\nPath({str(marker)!r}).write_text(__name__)\n"
    names = ("pip", "json", "numpy", "onnxruntime", "click", "sitecustomize", "usercustomize", "struct", "runpy")
    for name in names:
        (job.folder / f"{name}.py").write_text(text)
    for package in ("export_model", "exporter", "converters", "signatures", "pip"):
        (job.folder / package).mkdir()
        (job.folder / package / "__init__.py").write_text(text)
        (job.folder / package / "__main__.py").write_text(text)
    (job.folder / "package.json").write_text('{"type": "module", "main": "./index.js"}')
    (job.folder / "node_modules" / "@tensorflow" / "tfjs").mkdir(parents=True)
    (job.folder / "node_modules" / "@tensorflow" / "tfjs" / "index.js").write_text(
        f"require('fs').writeFileSync({json.dumps(str(marker))}, 'node')"
    )
    (job.folder / "pip.conf").write_text("[global]\nindex-url = file:///nowhere\n")
    # pip itself is there already, so that nothing is fetched
    done = job.run(paths=str(bundle), install="pip", runtimes=HERE, arguments="--allow-unverified")
    assert not marker.exists(), marker.read_text()
    assert done.returncode == 0, done.stderr


def test_every_python_of_the_action_and_the_workflows_leaves_that_folder_out() -> None:
    """``-m`` looks in the folder that a job stands in; workflows of this repository stand in their own."""
    for line in (ROOT / ".ci" / "action.sh").read_text().splitlines():
        assert not re.search(r"\bpython3? (?!-I\b)", line.split("#")[0]), line
