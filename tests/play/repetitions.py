"""``python -m tests.play.repetitions``: how often ``play`` is wrong or undecided about players that are right.

Trained policies of ours and of fixtures/gym play in their environments once per seed, by the numpy kernels and in
onnxruntime, both in this process; the verdict is that of ``play``. Nothing has a fault, so every DIFFERENT is a false
alarm. With ``--pairs N`` so many pairs of episodes are played once, and each repetition draws its own from them, with
replacement: that takes a hundredth of the time.

It prints a line for each policy: how many comparisons were open after the first episodes and in the end, how many
episodes decided, and the seconds of processor time. Ends with status 1 where something was DIFFERENT or more than one
comparison in twenty was open.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from export_model.exporter.play.episodes import Episodes, play_episodes
from export_model.exporter.play.equivalence import Equivalence
from export_model.exporter.play.match import decide, seed_of
from export_model.exporter.play.named import world_maker
from export_model.exporter.play.options import PlayOptions
from export_model.exporter.verify.plays import DIFFERENT, NOT_DECIDED
from fixtures import gym, trained
from tests.exporting import export_model, load_policy

Array = np.ndarray
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


@contextmanager
def players(name: str) -> Iterator[Callable[[int, int, int], Episodes]]:
    """Yield what plays a policy: (which of RUNTIMES, episodes, seed)."""
    ours = name not in gym.ENVIRONMENTS
    with tempfile.TemporaryDirectory() as folder:
        source = trained.FOLDER / name.partition("-")[0] if ours else gym.path(name)
        results = export_model(source, folder, to="bytes,onnx", verify="none")
        (bundle,) = (r.folder for r in results if not ours or r.policy.name == name)
        policies = [load_policy(bundle, runtime=runtime) for runtime in RUNTIMES]
        world = world_maker(name.partition("-")[0] if ours else name, Path(bundle))(policies[0].signature)
        yield lambda player, count, seed: play_episodes(world, policies[player], count, seed)


def resample(name: str, pairs: int, seeds: range, given: PlayOptions) -> Iterator[tuple[int, Equivalence, float]]:
    """Play ``pairs`` pairs of episodes, and repeat with episodes that are drawn from them."""
    begun = time.process_time()
    with players(name) as play:
        own, other = (play(player, pairs, given.seed) for player in range(2))
    print(
        f"{name}: {pairs} pairs, {np.mean(own.returns != other.returns):.2%} with another return, mean difference "
        f"{np.mean(other.returns - own.returns):+.2g} of {own.returns.mean():.4g}, {time.process_time() - begun:.0f} s"
    )
    for seed in seeds:
        begun, rng = time.process_time(), np.random.default_rng(seed)
        drawn: dict[int, Array] = {}

        def taken(episodes: Episodes, more: int, drawn: dict[int, Array] = drawn, rng: Any = rng) -> Episodes:
            rows = drawn.setdefault(more, rng.integers(pairs, size=more or given.episodes))
            return Episodes(episodes.returns[rows], episodes.lengths[rows], episodes.success[rows])

        margin = given.bound.of(taken(own, 0).returns)
        _, compared, _ = decide(lambda more: taken(own, more), lambda more: taken(other, more), given, margin)
        yield seed, compared, time.process_time() - begun


def repeat(name: str, seeds: range, given: PlayOptions) -> Iterator[tuple[int, Equivalence, float]]:
    """Play one policy once per seed."""
    with players(name) as play:
        for seed in seeds:
            begun, kept = time.process_time(), {}

            def episodes(player: int, more: int, seed: int = seed, kept: dict[int, Episodes] = kept) -> Episodes:
                if player or more not in kept:
                    played = play(player, more or given.episodes, seed_of(seed, more))
                    if player:
                        return played
                    kept[more] = played
                return kept[more]

            margin = given.bound.of(episodes(0, 0).returns)
            _, compared, _ = decide(lambda more: episodes(0, more), lambda more: episodes(1, more), given, margin)
            yield seed, compared, time.process_time() - begun


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.play.repetitions", description=__doc__.splitlines()[0])
    parser.add_argument("policies", nargs="*", default=POLICIES, metavar="POLICY", help=", ".join(POLICIES))
    parser.add_argument("--repeat", type=int, default=200, help="seeds")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--pairs", type=int, default=0, help="draw from so many pairs of episodes, played once")
    parser.add_argument("--verbose", action="store_true", help="a line for each comparison")
    given = parser.parse_args()
    total, options = Tally(), PlayOptions()
    for name in given.policies:
        tally, seeds = Tally(), range(given.first, given.first + given.repeat)
        found = resample(name, given.pairs, seeds, options) if given.pairs else repeat(name, seeds, options)
        for seed, compared, seconds in found:
            for counted in (tally, total):
                counted.add(compared, options.episodes, seconds)
            if given.verbose:
                print(f"  {name} {seed}: {compared.verdict} {compared.episodes} {seconds:.1f} s", flush=True)
        print(tally.line(name), flush=True)
    print(total.line("all"))
    return 1 if total.different or total.open_last > OPEN_SHARE * total.comparisons else 0


if __name__ == "__main__":
    sys.exit(main())
