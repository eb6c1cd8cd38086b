"""The trained policies exported once, and the runtimes that play them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.play.environments import ENVIRONMENTS
from export_model.exporter.play.environments.tennis import BRAINS
from fixtures import trained
from fixtures.evaluate import Contract, Decide, Player, Score, play, together
from fixtures.trained.scores import EPISODES, SEED
from tests.exporting import export_model

Array = np.ndarray[Any, Any]
Run = Callable[[Mapping[str, Array], Sequence[str]], Mapping[str, Array]]
#: format → where its file lies in a bundle
ARTEFACTS = {"bytes": "{0}.bytes", "saved_model": "saved_model", "tfjs": "tfjs", "onnx": "{0}.onnx"}


@pytest.fixture(scope="session")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All trained policies, exported from their frozen graphs to every format."""
    folder = tmp_path_factory.mktemp("trained")
    export_model(trained.FOLDER, folder, verify="none")
    return folder


@dataclass
class Stage:
    """Where exported policies play, in the runtime that is asked for."""

    folder: Path
    pool: RuntimePool
    scores: dict[str, Score] = field(default_factory=dict)

    def run(self, bundle: str, kind: str, runtime: str) -> Run:
        path = self.folder / bundle / ARTEFACTS[kind].format(bundle)
        options = {"kind": kind, "signature": "serving_default"} if kind == "saved_model" else {"kind": "graph"}
        model = self.pool.process(runtime).load(str(path), **options)
        return lambda feeds, fetch: model.run(feeds, fetch)

    def decide(self, name: str, kind: str = "onnx", runtime: str = "onnxruntime", **how: Any) -> Decide:
        def player(bundle: str) -> Player:
            contract = Contract.read(self.folder / bundle / "policy.json")
            return Player(self.run(bundle, kind, runtime), contract, **how)

        if name == "Tennis":
            return together({brain: player(f"Tennis-{brain}") for brain in BRAINS})
        return player(name)

    def score(self, name: str) -> Score:
        """The exported ONNX in onnxruntime, deterministic, in the report's episodes; played once."""
        if name not in self.scores:
            self.scores[name] = play(ENVIRONMENTS[name](EPISODES), self.decide(name), seed=SEED)
        return self.scores[name]


@pytest.fixture(scope="session")
def stage(bundles: Path, pool: RuntimePool) -> Stage:
    return Stage(bundles, pool)
