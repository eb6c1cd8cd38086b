"""docs/python-guide.md: its blocks run, in order, as they are printed; tests/live runs those of training scripts."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from export_model.converters.runtimes.javascript.node import js_home, node_executable
from tests.acting.test_page_snippets import resolved
from tests.commands import PYTHONPATH, ROOT
from tests.docs.blocks import blocks

PAGE = ROOT / "docs" / "python-guide.md"


@pytest.mark.slow
def test_its_blocks_run(tmp_path: Path) -> None:
    kinds = ("sh", "python", "js")
    parts = [(b.language, b.text) for b in blocks(PAGE) if b.verb != "skip" and b.language in kinds]
    assert {kind for kind, _ in parts} == set(kinds)
    tool = tmp_path / "bin" / "export-model"
    tool.parent.mkdir()
    tool.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m export_model "$@"\n')
    tool.chmod(0o755)
    path = f"{tool.parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PYTHONPATH": PYTHONPATH, "PATH": path}
    modules: list[str] = []
    for number, (kind, code) in enumerate(parts):
        if kind == "js":
            file = tmp_path / f"block-{number}.mjs"
            map_ = {
                "@tensorflow/tfjs": "./node_modules/@tensorflow/tfjs/dist/tf.fesm.min.js",
                "onnxruntime-web": "./node_modules/onnxruntime-web/dist/ort.wasm.bundle.min.mjs",
            }
            if (js_home() / map_["@tensorflow/tfjs"]).is_file():
                file.write_text(resolved(code, map_, js_home(), tmp_path), encoding="utf-8")
                modules.append(str(file))
            continue
        command = ["sh", "-e"] if kind == "sh" else [sys.executable, "-"]
        done = subprocess.run(command, input=code, capture_output=True, encoding="utf-8", cwd=tmp_path, env=environment)
        assert done.returncode == 0, (code, done.stderr[-2000:])
    assert (tmp_path / "recurrent.svg").is_file()
    assert list((tmp_path / "logs").rglob("*tfevents*"))
    node = node_executable()
    if node is None or not modules:
        pytest.skip("the JavaScript was not run: Node.js with @tensorflow/tfjs and onnxruntime-web is not here")
    done = subprocess.run(
        [node, str(Path(__file__).with_name("run_pages.mjs"))],
        input=json.dumps(modules),
        capture_output=True,
        encoding="utf-8",
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    logs = json.loads(done.stdout)
    assert [len(log) for log in logs] == [1, 1]
    assert all(len(values[0]) == 1 for log in logs for (values,) in log)
