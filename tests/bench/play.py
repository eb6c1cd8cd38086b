"""``python -m tests.bench.play [SECONDS]``: decisions a second of every runtime that plays, and what 200 episodes take.

Of each trained policy all formats play in every installed runtime; an environment's own steps are part of it. Fails
where 200 episodes take longer than SECONDS (20) in one runtime.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from exporter import export_model
from exporter.play.options import PlayOptions
from exporter.play.play import play_policy
from exporter.tables import table
from fixtures import trained

EPISODES = 200
TARGET = 20.0
POLICIES = ("3DBall", "GridWorld", "Hallway", "Tennis-LeftBrain", "Crawler2D")


@dataclass(frozen=True)
class Speed:
    """One artefact in one runtime."""

    policy: str
    where: str
    rate: float
    seconds: float


def measure_speeds(names: Sequence[str] = POLICIES, episodes: int = EPISODES) -> list[Speed]:
    """Play each policy once in all runtimes."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        export_model(trained.FOLDER, folder, verify="none")
        for name in names:
            options = PlayOptions(episodes, most=0)
            report = play_policy(Path(folder) / name, name.partition("-")[0], options=options)
            found.append(Speed(name, f"reference, {report.reference}", report.episodes.rate, report.episodes.seconds))
            found += [Speed(name, p.where, p.episodes.rate, p.episodes.seconds) for p in report.played]
    return found


def main(target: float) -> int:
    """Return 1 where something is slower than the target."""
    speeds = measure_speeds()
    rows = [[s.policy, s.where, f"{s.rate:,.0f}", f"{s.seconds:.1f} s"] for s in speeds]
    print(table(("policy", "where", "decisions/s", f"{EPISODES} episodes"), rows))
    slow = [s for s in speeds if s.seconds > target]
    print(f"{len(slow)} of {len(speeds)} take longer than {target:g} s")
    return 1 if slow else 0


if __name__ == "__main__":
    sys.exit(main(float(sys.argv[1]) if sys.argv[1:] else TARGET))
