"""``policy.mjs`` acts by the module of ``--to js`` as it does by TensorFlow.js."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from export_model.converters.runtimes.javascript.node import node_executable
from export_model.exporter.export.pipeline import ExportOptions, export
from fixtures import FIXTURES, path
from tests.docs.workshop import MODULES

pytestmark = pytest.mark.xdist_group("programs")

MAIN = """
import * as tf from "@tensorflow/tfjs";
import { loadPolicy } from "./tfjs/policy.mjs";
await tf.setBackend("cpu");
const engines = [
    await loadPolicy("tfjs/model.json", { tf, seed: 5 }),
    await loadPolicy("policy.json", { code: await import("./NAME.mjs"), seed: 5 }),
];
for (const policy of engines) {
    const agents = policy.agent();
    const said = [];
    for (let step = 0; step < 3; step++) {
        const seen = Object.fromEntries(policy.observations.map(({ name, shape }) => {
            const count = 2 * shape.slice(1).reduce((a, b) => a * b, 1); // two agents
            const data = Float32Array.from({ length: count }, (_, i) => ((i * 7 + step * 5) % 17 - 8) / 8);
            return [name, { data, shape: [2, ...shape.slice(1)] }];
        }));
        const { continuous, discrete, memory } = await agents.decide(seen);
        const { continuous: mean } = await policy.decide(seen, { deterministic: true });
        said.push({ continuous, discrete, mean, memory: memory && Array.from(memory.data) });
    }
    console.log(JSON.stringify(said));
}
await loadPolicy("policy.json", { tf, code: {} }).catch((error) => console.log(JSON.stringify(error.message)));
"""


def close(a: object, b: object) -> bool:
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(close, a, b))
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(close(a[k], b[k]) for k in a)
    if isinstance(a, int | float) and isinstance(b, int | float):
        return abs(a - b) <= 1e-5 + 1e-5 * abs(b)
    return a == b


@pytest.mark.parametrize("name", FIXTURES)
def test_the_module_acts_as_tensorflow_js_does(name: str, tmp_path: Path) -> None:
    """Two agents, three steps, with their memory; draws are made by policy.mjs, from one seed."""
    if node_executable() is None or not MODULES.is_dir():
        pytest.skip("Node or its packages are not here; get them with: make install")
    (tmp_path / "node_modules").symlink_to(MODULES)
    options = ExportOptions(tmp_path, ("tfjs", "js"), verify="none")
    for result in export([path(name)], options):
        drawn = any(s.role.value == "sampled" for s in result.policy.signature.outputs)
        (result.folder / "main.mjs").write_text(MAIN.replace("NAME", result.policy.name))
        done = subprocess.run(
            [str(node_executable()), "main.mjs"], cwd=result.folder, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        expected, found, refused = map(json.loads, done.stdout.splitlines()[-3:])
        if not drawn:  # else by the graph, from streams of their own
            assert close(found, expected)
        assert len(found) == 3
        assert "{ code }" in refused
