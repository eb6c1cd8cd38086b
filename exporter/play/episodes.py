"""Episodes that a policy plays to their end, all of them side by side."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
from msgspec import Struct

from export_model.exporter.acting.policy import LoadedPolicy
from export_model.exporter.play.worlds import World
from export_model.signatures.errors import UsageError

Array = np.ndarray
#: Episodes that are played at once; more are played in turns.
SIDE_BY_SIDE = 512
#: An environment that never ends an episode is not played for ever.
MOST_STEPS = 100_000
#: (steps so far, which of the agents still play): called before each decision.
Watch = Callable[[int, Array], None]
#: (episodes that ended, of how many, decisions in a second)
Advance = Callable[[int, int, float], None]


class Episodes(Struct):
    """What came of each episode: ``returns`` float64, ``lengths`` int64, ``success`` bool, [episodes] each."""

    returns: Array
    lengths: Array
    success: Array
    #: of computing and waiting for the policy and the environment together
    seconds: float = 0.0

    @property
    def decisions(self) -> int:
        """Decisions that counted."""
        return int(self.lengths.sum())

    @property
    def rate(self) -> float:
        """Decisions in a second."""
        return self.decisions / max(self.seconds, 1e-9)

    def join(self, others: Episodes) -> Episodes:
        """Return these and others as one."""
        returns, lengths, success = (
            np.concatenate([getattr(e, n) for e in (self, others)]) for n in ("returns", "lengths", "success")
        )
        return Episodes(returns, lengths, success, self.seconds + others.seconds)


def play_episodes(
    world: World,
    policy: LoadedPolicy,
    episodes: int,
    seed: int,
    *,
    deterministic: bool = False,
    watch: Watch = lambda step, playing: None,
    advance: Advance = lambda ended, count, rate: None,
) -> Episodes:
    """Play so many episodes, one for each row.

    All rows are asked for decisions until the last episode ends, so that draw number k is the same row's in the same
    step whoever plays: that pairs the chance of two players, too. ``watch`` sees the first turn. Raises UsageError
    where an environment gives a reward that is not a number, or does not come to an end.
    """
    begun = time.monotonic()
    parts: list[Episodes] = []
    for turn, count in enumerate(_turns(episodes)):
        own = turn_seed(seed, turn)
        policy.seed(own)
        view, agent = world.begin(count, own), policy.agent(deterministic=deterministic)
        part = Episodes(np.zeros(count), np.zeros(count, np.int64), np.zeros(count, bool))
        playing, step = np.ones(count, bool), 0
        while playing.any():
            if not turn:
                watch(step, playing)
            decision = agent.decide(view.observations, masks=view.masks)
            after = world.step(decision.continuous, decision.discrete)
            _check_rewards(after.rewards[playing], step)
            part.returns[playing] += after.rewards[playing]
            part.lengths += playing
            part.success |= playing & after.success
            ended = playing & after.ended
            playing, view, step = playing & ~after.ended, after.view, step + 1
            if ended.any():
                done = sum(len(p.returns) for p in parts) + len(playing) - int(np.count_nonzero(playing))
                steps = sum(p.decisions for p in (*parts, part))
                advance(done, episodes, steps / max(time.monotonic() - begun, 1e-9))
            if step >= MOST_STEPS:
                raise UsageError(
                    f"--env {world.name}: {np.count_nonzero(playing)} episodes did not end within {MOST_STEPS} steps",
                    fix="give an environment that ends its episodes, for example with a time limit",
                )
        parts.append(part)
    returns, lengths, success = (
        np.concatenate([getattr(p, n) for p in parts]) for n in ("returns", "lengths", "success")
    )
    return Episodes(returns, lengths, success, time.monotonic() - begun)


def turn_seed(seed: int, turn: int) -> int:
    """Return the seed of one turn of episodes, 32 bits: another for every turn and seed."""
    return int(np.random.SeedSequence((seed, turn)).generate_state(1)[0])


def _turns(episodes: int) -> Iterator[int]:
    for first in range(0, episodes, SIDE_BY_SIDE):
        yield min(SIDE_BY_SIDE, episodes - first)


def _check_rewards(rewards: Array, step: int) -> None:
    if not np.isfinite(rewards).all():
        raise UsageError(
            f"the environment gave a reward of {rewards[~np.isfinite(rewards)][0]} in step {step + 1}",
            why="a return must be a finite number",
            fix="look at the environment, and at what the policy did there",
        )
