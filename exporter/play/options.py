"""How to play."""

from __future__ import annotations

from msgspec import Struct
from msgspec.structs import force_setattr

from export_model.exporter.acting.generator import MAX_SEED
from export_model.exporter.play.equivalence import LEAST_EPISODES, MOST_EPISODES, Margin, parse_margin
from export_model.signatures.errors import whole


class PlayOptions(Struct, frozen=True):
    """How to play."""

    #: Episodes that each plays.
    episodes: int = 200
    #: Seed of the episodes and of drawn actions.
    seed: int = 0
    #: How far mean returns may be apart: a share of how large they are (``1%``), or a number in their unit.
    margin: str = "1%"
    #: Take the likeliest action and the mean, in place of draws.
    deterministic: bool = False
    #: Where the episodes do not decide, others join them until they do, up to this number.
    most: int = 12_800

    def __post_init__(self) -> None:
        force_setattr(self, "episodes", whole("--episodes", self.episodes, LEAST_EPISODES, MOST_EPISODES))
        force_setattr(self, "seed", whole("--seed", self.seed, 0, MAX_SEED))
        force_setattr(self, "most", whole("--most", self.most, 0, MOST_EPISODES))
        parse_margin(self.margin)

    @property
    def bound(self) -> Margin:
        """The margin as it is computed with."""
        return parse_margin(self.margin)
