"""policy.mjs in Chromium, on the page's own TensorFlow.js: it decides what Python decides, seeds included."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from export_model.exporter.serve.site import assemble
from fixtures import path as fixture
from tests.acting.test_load_policy import observed
from tests.exporting import load_policy
from tests.serve.browsing import CHECKED, served, visit, with_backends
from tests.serve.conftest import Bundle

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.xdist_group("browser")]

DECIDE = """(async () => {
  const { loadPolicy } = await import("./policy.mjs");
  const found = {};
  for (const backend of %s) {
    await tf.setBackend(backend);
    const policy = await loadPolicy("model/model.json", { tf });
    found[backend] = [];
    for (const [observations, options] of %s) {
      const { continuous, discrete, memory } = await policy.decide(observations, options);
      found[backend].push({ continuous, discrete, memory: memory && Array.from(memory.data) });
    }
    policy.dispose();
  }
  return found;
})()"""
BACKENDS = ["cpu", "wasm", "webgl"]


Answers = dict[str, list[dict[str, list[float]]]]


def in_the_page(bundle: Path, requests: list[object]) -> Answers:
    """What each backend decides; one visit for all, as starting Chromium takes longer than all of them."""
    with served(with_backends(assemble(bundle, "none"), "cpu", "wasm")) as server:  # what the script finds loaded
        script = DECIDE % (json.dumps(BACKENDS), json.dumps(requests))
        found: Answers = visit(server.url, [["wait", CHECKED], ["eval", script]]).results[1]
    assert list(found) == BACKENDS
    return found


@pytest.mark.parametrize("name", ["continuous", "sampled", "recurrent"])
def test_it_decides_as_python_does(name: str, bundle: Bundle) -> None:
    folder = bundle(name)
    policy = load_policy(folder, runtime="numpy")
    observations = observed(policy, rows=4)
    options = [{"seed": 11}, {"deterministic": True}, {"seed": 2**41 + 1}, {}]
    listed = {n: a.tolist() for n, a in observations.items()}
    answers = in_the_page(folder, [[listed, o] for o in options])
    for at, option in enumerate(options):
        decision = policy.decide(observations, **option)  # type: ignore[arg-type]
        for backend in BACKENDS:
            answer = answers[backend][at]
            if decision.continuous is not None:
                np.testing.assert_allclose(answer["continuous"], decision.continuous, atol=1e-5, rtol=1e-5)
            if decision.discrete is not None:
                np.testing.assert_array_equal(answer["discrete"], decision.discrete)
            if decision.memory is not None:
                np.testing.assert_allclose(answer["memory"], decision.memory.reshape(-1), atol=1e-5, rtol=1e-5)


def test_the_recorded_steps_come_out(bundle: Bundle) -> None:
    """TensorFlow's own values, from the fixture's archive."""
    with np.load(fixture("recurrent.npz")) as golden:
        given, expected = "step0/in/", golden["step0/out/recurrent_out"]
        options = {
            "masks": golden[f"{given}action_masks"].tolist(),
            "previous": golden[f"{given}prev_action"].tolist(),
            "memory": golden[f"{given}recurrent_in"].tolist(),
            "deterministic": True,
        }
        answers = in_the_page(bundle("recurrent"), [[{"state": golden[f"{given}state"].tolist()}, options]])
    for (answer,) in answers.values():
        np.testing.assert_allclose(answer["memory"], expected.reshape(-1), atol=1e-5, rtol=1e-5)
