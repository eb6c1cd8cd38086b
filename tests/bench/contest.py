"""Both sides on one file: this program, and the three that a user would run instead."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

from tests.bench.measure import Cost, measure
from tests.peers.environment import Peers, environment

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = Path(__file__).with_name("write_saved_model.py")
OURS = "export-model"
PEERS = ("TensorFlow, SavedModel", "tensorflowjs_converter", "tf2onnx.convert")
#: What each peer writes, as paths in our bundle.
FORMATS = {PEERS[0]: "*/saved_model", PEERS[1]: "*/tfjs", PEERS[2]: "*/*.onnx"}


@dataclass
class Contest:
    """The runs on one policy: ``rounds[i][name]`` has the costs of one side in round ``i``, by the order of runs."""

    policy: str
    rounds: list[dict[str, list[Cost]]] = field(default_factory=list)
    #: peer → bytes that it wrote, and bytes of the same format in our bundle
    sizes: dict[str, tuple[int, int]] = field(default_factory=dict)

    def seconds(self, name: str) -> float:
        return median(c.seconds for r in self.rounds for c in r[name])

    def peak(self, name: str) -> float:
        return median(c.peak_mib for r in self.rounds for c in r[name])

    @property
    def speed_ratios(self) -> list[float]:
        """Per round: the peers' wall time together, in ours. Within a round the machine has one speed, more or less."""
        return [
            sum(c.seconds for name in PEERS for c in r[name]) / median(c.seconds for c in r[OURS]) for r in self.rounds
        ]

    @property
    def memory_ratio(self) -> float:
        """The largest peer's peak in ours."""
        return max(self.peak(name) for name in PEERS) / self.peak(OURS)

    def to_dict(self) -> dict[str, object]:
        return {
            "policy": self.policy,
            "rounds": len(self.rounds),
            "sides": {name: {"seconds": self.seconds(name), "peak_mib": self.peak(name)} for name in (OURS, *PEERS)},
            "bytes": {name: {"peer": theirs, "ours": ours} for name, (theirs, ours) in self.sizes.items()},
            "speed_ratio": median(self.speed_ratios),
            "speed_ratios": self.speed_ratios,
            "memory_ratio": self.memory_ratio,
        }


def run_contest(policy: str, rounds: int, peers: Peers, scratch: Path) -> Contest:
    """One uncounted round, which fills the file cache and writes bytecode on both sides, then ``rounds`` of them.

    Ours is run before each of the peers, so that a machine that changes its speed changes it for both.
    """
    places = {name: scratch / policy / str(i) for i, name in enumerate((OURS, *PEERS))}
    commands = _commands(policy, peers, places)
    contest = Contest(policy)
    for number in range(rounds + 1):
        costs: dict[str, list[Cost]] = {name: [] for name in commands}
        for peer in PEERS:
            for name in (OURS, peer):
                # Every run writes anew; the converter's input is the SavedModel that was just written before it.
                shutil.rmtree(places[name], ignore_errors=True)
                places[name].mkdir(parents=True)
                costs[name].append(measure(commands[name], environment()))
        if number:
            contest.rounds.append(costs)
    contest.sizes = {
        name: (_size(places[name].iterdir()), _size(places[OURS].glob(pattern))) for name, pattern in FORMATS.items()
    }
    return contest


def _commands(policy: str, peers: Peers, places: Mapping[str, Path]) -> dict[str, list[str]]:
    source = str(ROOT / "fixtures" / f"{policy}.bytes")
    entry = json.loads((ROOT / "fixtures" / "manifest.json").read_text(encoding="utf-8"))["fixtures"][policy]
    inputs, outputs = ([t["name"] for t in entry[side]] for side in ("inputs", "outputs"))
    saved_model = str(places[PEERS[0]] / "saved_model")
    ours = Path(sys.executable).with_name(OURS)
    return {
        OURS: [str(ours), source, "-o", str(places[OURS]), "--verify", "none"],
        PEERS[0]: [peers.python, str(SCRIPT), source, saved_model, ",".join(inputs), ",".join(outputs)],
        PEERS[1]: [
            *peers.tensorflowjs_converter(),
            "--input_format=tf_saved_model",
            saved_model,
            str(places[PEERS[1]] / "tfjs"),
        ],
        PEERS[2]: [
            *peers.tf2onnx(),
            "--graphdef",
            source,
            "--inputs",
            ",".join(f"{n}:0" for n in inputs),
            "--outputs",
            ",".join(f"{n}:0" for n in outputs),
            "--output",
            str(places[PEERS[2]] / "policy.onnx"),
        ],
    }


def _size(paths: Iterable[Path]) -> int:
    files = (file for path in paths for file in ([path] if path.is_file() else path.rglob("*")))
    return sum(file.stat().st_size for file in files if file.is_file())
