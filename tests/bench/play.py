"""``python -m tests.bench.play``: decisions a second of every runtime that plays, and what a long log takes.

Of each trained policy all formats play in every installed runtime; an environment's own steps are part of it. A log of
100,000 steps, of a policy without memory and of one with, is then held against its bundle, once as it was and once with
a column in degrees. Seconds are of the clock, with those of the processor beside them where a whole process is
measured. Fails where 200 episodes take longer than 20 s in one runtime, or a log longer than 10 s of processor time.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from export_model.exporter.play.options import PlayOptions
from export_model.exporter.play.play import play_policy
from export_model.exporter.tables import table
from export_model.signatures.sampling import draw_typical
from fixtures import trained
from tests.exporting import export_model, load_policy

EPISODES, STEPS, AGENTS = 200, 100_000, 500
TARGET, LOG_TARGET = 20.0, 10.0
POLICIES = ("3DBall", "GridWorld", "Hallway", "Tennis-LeftBrain", "Crawler2D")
LOGGED = ("3DBall", "Hallway")


@dataclass(frozen=True)
class Speed:
    """One artefact in one runtime."""

    policy: str
    where: str
    rate: float
    seconds: float


@dataclass(frozen=True)
class LogTime:
    """One log held against its bundle: seconds of the clock and of the processor, and whether it fits."""

    policy: str
    fault: str
    seconds: float
    processor: float
    status: int


def measure_speeds(folder: Path, names: Sequence[str] = POLICIES, episodes: int = EPISODES) -> list[Speed]:
    """Play each policy once in all runtimes."""
    found = []
    for name in names:
        report = play_policy(folder / name, name.partition("-")[0], options=PlayOptions(episodes, most=0))
        found.append(Speed(name, f"reference, {report.reference}", report.episodes.rate, report.episodes.seconds))
        found += [Speed(name, p.where, p.episodes.rate, p.episodes.seconds) for p in report.played]
    return found


def write_log(bundle: Path, path: Path, *, steps: int = STEPS, factor: float = 1.0) -> None:
    """Have agents act side by side, and log one episode after the other; the policy is given ``factor`` × a column."""
    policy = load_policy(bundle, runtime="onnxruntime")
    agent, length = policy.agent(deterministic=True), steps // AGENTS
    (name,) = (s.name for s in policy.signature.observations)
    typical = np.concatenate([case.feeds[name] for case in draw_typical(policy.signature, seed=0, count=20)])
    random, seen, actions = np.random.default_rng(0), [], []
    for _ in range(length):
        seen.append(typical[random.integers(len(typical), size=AGENTS)])
        given = seen[-1].copy()
        given[:, 0] *= np.float32(factor)
        actions.append(agent.decide({name: given}).action)
    rows = {name: np.stack(seen, 1), policy.signature.heads[0].name: np.stack(actions, 1)}
    whole = {n: a.reshape(steps, *a.shape[2:]) for n, a in rows.items()}
    np.savez(path, **whole, episode=np.repeat(np.arange(AGENTS), length))  # type: ignore[arg-type]


def measure_logs(folder: Path, names: Sequence[str] = LOGGED, steps: int = STEPS) -> Iterator[LogTime]:
    """Check a log of each policy, with and without a fault, in a process of its own."""
    for name in names:
        for fault, factor in (("none", 1.0), ("degrees", 180 / np.pi)):
            path = folder / "run.npz"
            write_log(folder / name, path, steps=steps, factor=factor)
            command = [sys.executable, "-m", "export_model", "verify", str(folder / name), "--log", str(path)]
            before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
            done = subprocess.run(command, capture_output=True, check=False)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            yield LogTime(name, fault, time.monotonic() - begun, processor, done.returncode)


def main() -> int:
    """Return 1 where something is slower than its target, or a log is judged wrong."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        export_model(trained.FOLDER, folder, verify="none")
        speeds, logs = measure_speeds(folder), list(measure_logs(folder))
    rows = [[s.policy, s.where, f"{s.rate:,.0f}", f"{s.seconds:.1f} s"] for s in speeds]
    print(table(("policy", "where", "decisions/s", f"{EPISODES} episodes"), rows))
    slow = [s for s in speeds if s.seconds > TARGET]
    print(f"{len(slow)} of {len(speeds)} take longer than {TARGET:g} s\n")
    rows = [
        [x.policy, x.fault, f"{STEPS / x.seconds:,.0f}", f"{x.seconds:.1f} s", f"{x.processor:.1f} s"] for x in logs
    ]
    print(table(("log of", "fault", "steps/s", f"{STEPS:,} steps", "processor"), rows))
    slow_logs = [x for x in logs if x.processor > LOG_TARGET]
    wrong = [x for x in logs if x.status != (x.fault != "none")]
    print(
        f"{len(slow_logs)} of {len(logs)} take longer than {LOG_TARGET:g} s of processor time, {len(wrong)} are wrong"
    )
    return 1 if slow or slow_logs or wrong else 0


if __name__ == "__main__":
    sys.exit(main())
