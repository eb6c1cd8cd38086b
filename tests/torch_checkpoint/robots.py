"""Checkpoints of robots' trainers (fixtures/robots), as the libraries write them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import yaml

from fixtures.robots import FOLDER
from fixtures.torch_checkpoint.cases import waves
from tests.torch_checkpoint.pt_files import RETURNS, Writer


def states(name: str) -> dict[str, dict[str, np.ndarray]]:
    """The checkpoint's state dictionaries by key."""
    return {
        key: {
            n: np.array(e["values"], e["dtype"]).reshape(e["shape"])
            if "values" in e
            else waves(n, e["shape"]).astype(e["dtype"])
            for n, e in layout.items()
        }
        for key, layout in json.loads((FOLDER / f"{name}.json").read_text()).items()
    }


def checkpoint(
    folder: Path, name: str, place: str = "run/nn/last.pth", settings: str = "run/params/agent.yaml"
) -> Path:
    """The checkpoint and its settings, laid out as Isaac Lab or Sample Factory does; of SBX the saved model."""
    if (FOLDER / f"{name}.zip").exists():
        return FOLDER / f"{name}.zip"
    if name.startswith("rllib_"):
        run = folder / "run/learner_group/learner/rl_module/default_policy"
        run.mkdir(parents=True, exist_ok=True)
        for file, short in (("module_state", "state"), ("class_and_ctor_args", "arguments")):
            (run / f"{file}.pkl").write_bytes((FOLDER / f"{name}.{short}.pkl").read_bytes())
        return run
    if name.startswith("sample_factory_"):
        place = place.replace("nn/last.pth", "checkpoint_p0/checkpoint_000000978_4005888.pth")
        settings = settings.replace("params/", "").replace("agent.yaml", "config.json")
    if name.startswith("fast_td3_"):
        settings = ""
    writer = Writer()
    path = folder / place
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = {"epoch": 3, "frame": 9, "last_mean_rewards": RETURNS}
    if not settings:
        beside["args"] = yaml.safe_load((FOLDER / f"{name}.yaml").read_text())
    path.write_bytes(writer.zip({**{k: writer.state(s) for k, s in states(name).items()}, **beside}))
    if settings:
        (folder / settings).parent.mkdir(parents=True, exist_ok=True)
        data = (FOLDER / f"{name}.yaml").read_bytes()
        data = json.dumps(yaml.safe_load(data)).encode() if settings.endswith(".json") else data
        (folder / settings).write_bytes(data)
    return path
