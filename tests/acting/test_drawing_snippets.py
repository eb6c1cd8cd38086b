"""Snippets that are given log-probabilities draw classes by them; none calls these drawn."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.runtimes.csharp import tools
from export_model.converters.runtimes.javascript.node import node_executable
from export_model.exporter.snippets.csharp import _draws
from export_model.exporter.verify.statistics import FALSE_ALARM, fit
from tests.acting.snippet_bundles import bundle_of, code_of

COUNT, BRANCHES = 4096, (3, 2, 4)
ODDS = np.log(np.array([0.7, 0.2, 0.1, 1.0, 0.0, 0.1, 0.2, 0.3, 0.4]) + 1e-30)


def fits(drawn: list[list[int]]) -> None:
    """Each branch by its own part of the odds; what has none is never drawn."""
    assert len(drawn) == COUNT
    for column, part in zip(np.array(drawn).T, np.split(ODDS, np.cumsum(BRANCHES)[:-1]), strict=True):
        assert fit(column, part) > FALSE_ALARM


@pytest.mark.parametrize("target", ["tfjs", "tfjs-node", "onnxruntime-web", "onnxruntime-web-node"])
def test_javascript_draws(target: str, out: Path) -> None:
    code = code_of(out, "discrete", target)
    (draw,) = re.findall(r"const draw = .*?\n};\n", code, re.DOTALL)
    assert '// drawn; deterministic: outputs["deterministic_action"]' in code
    text = f"{draw}const odds = {json.dumps(ODDS.tolist())};\n"
    text += f"console.log(JSON.stringify(Array.from({{ length: {COUNT} }}, () => draw(odds))));\n"
    command = [str(node_executable()), "--input-type=module", "-e", text]
    fits(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))


def test_csharp_draws(out: Path, tmp_path: Path) -> None:
    mcs, mono = tools() or pytest.skip("Mono is not installed")
    bundle = bundle_of(out, "discrete")
    lines = _draws(bundle, "action", bundle.heads[0], "Odds()")
    assert "\n".join(f"            {line}" for line in lines[1:]) in code_of(out, "discrete", "tensorflowsharp")
    numbers = ", ".join(f"{x:.9g}f" for x in ODDS)
    program = "\n".join(
        [
            "using System;\nstatic class Program\n{",
            f"    static float[,] Odds() {{ return new float[,] {{ {{ {numbers} }} }}; }}",
            f"    static void Main()\n    {{\n        var random = new Random(5);\n"
            f"        for (int turn = 0; turn < {COUNT}; turn++)\n        {{",
            *lines,
            '            foreach (int one in action) Console.Write(one + " ");\n        }\n    }\n}',
        ]
    )
    (tmp_path / "main.cs").write_text(program)
    subprocess.run([mcs, "-out:main.exe", "main.cs"], check=True, cwd=tmp_path)
    said = subprocess.run([mono, "main.exe"], check=True, capture_output=True, text=True, cwd=tmp_path).stdout
    fits(np.array(said.split(), int).reshape(COUNT, 3).tolist())
