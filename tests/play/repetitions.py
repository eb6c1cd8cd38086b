"""``python -m tests.play.repetitions``: how often ``play`` is wrong or undecided about players that are right.

Trained policies of ours and of fixtures/gym play in their environments once per seed, by the numpy kernels and in
onnxruntime, both in this process; the verdict is that of ``play``. Nothing has a fault, so every DIFFERENT is a false
alarm. It prints a line for each policy: how many comparisons were open after the first episodes and in the end, how
many episodes decided, and the seconds of processor time. Ends with status 1 where something was DIFFERENT or more than
one comparison in twenty was open.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from msgspec import Struct

from exporter import export_model
from exporter.acting.loading import load_policy
from exporter.acting.policy import LoadedPolicy
from exporter.play.episodes import Episodes, play_episodes
from exporter.play.equivalence import Equivalence
from exporter.play.match import decide, seed_of
from exporter.play.named import world_maker
from exporter.play.options import PlayOptions
from exporter.verify.plays import DIFFERENT, NOT_DECIDED
from fixtures import gym, trained

OURS = ("3DBall", "GridWorld", "Hallway", "Tennis-LeftBrain", "Tennis-RightBrain", "Crawler2D")
POLICIES = (*OURS, *gym.ENVIRONMENTS)
RUNTIMES = ("numpy", "onnxruntime")
#: Of comparisons that may be open in the end.
OPEN_SHARE = 0.05


class Tally(Struct):
    """What came of one policy's repetitions."""

    comparisons: int = 0
    different: int = 0
    #: open after the first episodes, and in the end
    open_first: int = 0
    open_last: int = 0
    #: the most episodes that one comparison took, and those of all
    most: int = 0
    episodes: int = 0
    seconds: float = 0.0

    def add(self, compared: Equivalence, first: int, seconds: float) -> None:
        """Count one repetition."""
        self.comparisons += 1
        self.different += compared.verdict == DIFFERENT
        self.open_last += compared.verdict == NOT_DECIDED
        self.open_first += compared.verdict == NOT_DECIDED or compared.episodes > first
        self.most = max(self.most, compared.episodes)
        self.episodes += compared.episodes
        self.seconds += seconds

    def line(self, name: str) -> str:
        """The figures of one policy."""
        count = max(self.comparisons, 1)
        return (
            f"{name}: {self.comparisons} comparisons, {self.different} DIFFERENT, open after the first episodes "
            f"{self.open_first}, in the end {self.open_last} ({self.open_last / count:.1%}); decided by "
            f"{self.episodes / count:,.0f} episodes on average, {self.most:,} at most; {self.seconds:.0f} s"
        )


def repeat(name: str, seeds: range, given: PlayOptions) -> Iterator[tuple[int, Equivalence, float]]:
    """Play one policy once per seed."""
    ours = name not in gym.ENVIRONMENTS
    with tempfile.TemporaryDirectory() as folder:
        source = trained.FOLDER / name.partition("-")[0] if ours else gym.path(name)
        results = export_model(source, folder, to="bytes,onnx", verify="none")
        (bundle,) = (r.folder for r in results if not ours or r.policy.name == name)
        reference, candidate = (load_policy(bundle, runtime=runtime) for runtime in RUNTIMES)
        world = world_maker(name.partition("-")[0] if ours else name, Path(bundle))(reference.signature)
        for seed in seeds:
            begun = time.process_time()

            def play(player: LoadedPolicy, more: int, seed: int = seed) -> Episodes:
                return play_episodes(world, player, more or given.episodes, seed_of(seed, more))

            first = play(reference, 0)
            own = lambda more, first=first: play(reference, more) if more else first  # noqa: E731
            margin = given.bound.of(first.returns)
            _, compared, _ = decide(own, lambda more: play(candidate, more), given, margin)
            yield seed, compared, time.process_time() - begun


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.play.repetitions", description=__doc__.splitlines()[0])
    parser.add_argument("policies", nargs="*", default=POLICIES, metavar="POLICY", help=", ".join(POLICIES))
    parser.add_argument("--repeat", type=int, default=200, help="seeds")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--verbose", action="store_true", help="a line for each comparison")
    given = parser.parse_args()
    total, options = Tally(), PlayOptions()
    for name in given.policies:
        tally = Tally()
        for seed, compared, seconds in repeat(name, range(given.first, given.first + given.repeat), options):
            for counted in (tally, total):
                counted.add(compared, options.episodes, seconds)
            if given.verbose:
                print(f"  {name} {seed}: {compared.verdict} {compared.episodes} {seconds:.1f} s", flush=True)
        print(tally.line(name), flush=True)
    print(total.line("all"))
    return 1 if total.different or total.open_last > OPEN_SHARE * total.comparisons else 0


if __name__ == "__main__":
    sys.exit(main())
