"""``python -m tests.play.repetitions``: how often ``play`` is wrong or undecided about players that are right.

Trained policies of ours and of fixtures/gym play in their environments, once per seed, in the runtimes that are named.
Nothing of it has a fault, so every DIFFERENT is a false alarm. It prints a line for each policy: how many comparisons
were open after the first episodes and in the end, how many episodes decided, and the seconds. Ends with status 1 where
something was DIFFERENT or more than one comparison in twenty was open.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator

from msgspec import Struct

from converters.runtimes.pool import RuntimePool
from exporter import export_model
from exporter.play.options import PlayOptions
from exporter.play.play import play_policy
from exporter.play.report import PlayReport
from exporter.verify.options import VerifyOptions
from exporter.verify.plays import DIFFERENT, NOT_DECIDED
from fixtures import gym, trained

OURS = ("3DBall", "GridWorld", "Hallway", "Tennis-LeftBrain", "Tennis-RightBrain", "Crawler2D")
POLICIES = (*OURS, *gym.ENVIRONMENTS)
#: Of comparisons that may be open in the end.
OPEN_SHARE = 0.05


class Tally(Struct):
    """What came of one policy's repetitions."""

    repetitions: int = 0
    comparisons: int = 0
    different: int = 0
    #: open after the first episodes, and in the end
    open_first: int = 0
    open_last: int = 0
    #: the most episodes that one comparison took
    most: int = 0
    seconds: float = 0.0

    def add(self, report: PlayReport, seconds: float) -> None:
        """Count one repetition."""
        first = report.options.episodes
        self.repetitions += 1
        self.seconds += seconds
        self.different += report.replay.passed is False
        for played in report.played:
            compared = played.compared
            self.comparisons += 1
            self.different += compared.verdict == DIFFERENT
            self.open_last += compared.verdict == NOT_DECIDED
            self.open_first += compared.verdict == NOT_DECIDED or compared.episodes > first
            self.most = max(self.most, compared.episodes)

    def line(self, name: str) -> str:
        """The figures of one policy."""
        return (
            f"{name}: {self.repetitions} repetitions, {self.comparisons} comparisons, {self.different} DIFFERENT, "
            f"open after the first episodes {self.open_first}, in the end {self.open_last} "
            f"({self.open_last / max(self.comparisons, 1):.1%}), at most {self.most:,} episodes, {self.seconds:.0f} s"
        )


def repeat(
    name: str, seeds: range, options: PlayOptions, runtimes: str, pool: RuntimePool
) -> Iterator[tuple[PlayReport, float]]:
    """Play one policy once per seed."""
    with tempfile.TemporaryDirectory() as folder:
        source = gym.path(name) if name in gym.ENVIRONMENTS else trained.FOLDER / name.partition("-")[0]
        results = export_model(source, folder, verify="none")
        (bundle,) = (r.folder for r in results if name in gym.ENVIRONMENTS or r.policy.name == name)
        for seed in seeds:
            own = PlayOptions(options.episodes, seed, options.margin, options.deterministic, options.most)
            begun = time.monotonic()
            env = name if name in gym.ENVIRONMENTS else name.partition("-")[0]
            report = play_policy(bundle, env, options=own, judging=VerifyOptions(runtimes=runtimes), pool=pool)
            yield report, time.monotonic() - begun


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.play.repetitions", description=__doc__.splitlines()[0])
    parser.add_argument("policies", nargs="*", default=POLICIES, metavar="POLICY", help=", ".join(POLICIES))
    parser.add_argument("--repeat", type=int, default=200, help="seeds")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--runtimes", default="onnxruntime,numpy", help="as --verify: these, comma-separated")
    parser.add_argument("--verbose", action="store_true", help="a line for each comparison that was not EQUIVALENT")
    given = parser.parse_args()
    total = Tally()
    with RuntimePool() as pool:
        for name in given.policies:
            tally = Tally()
            seeds = range(given.first, given.first + given.repeat)
            for report, seconds in repeat(name, seeds, PlayOptions(), given.runtimes, pool):
                for counted in (tally, total):
                    counted.add(report, seconds)
                if given.verbose:
                    for played in report.played:
                        if played.sentence:
                            print(f"  seed {report.options.seed}: {played.where}: {played.sentence}", flush=True)
            print(tally.line(name), flush=True)
    print(total.line("all"))
    return 1 if total.different or total.open_last > OPEN_SHARE * total.comparisons else 0


if __name__ == "__main__":
    sys.exit(main())
