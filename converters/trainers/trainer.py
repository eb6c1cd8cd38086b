"""What a trainer is: one object that recognises what was saved and rebuilds the policy's network from it.

A room of ``converters/trainers`` declares one as ``TRAINER``; ``registry.py`` lists the rooms.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct, field

from export_model.converters.files.fetch import Fetched
from export_model.converters.graph.nodes import Graph
from export_model.converters.policy.facts import SourceFacts
from export_model.converters.trainers.pytorch.weights import TensorFile, Weights
from export_model.signatures.errors import SourceError, UsageError


class Saved(Struct, frozen=True):
    """What was saved, and what the user says of it.

    ``archive`` is the file with the tensors; ``settings`` what the trainer wrote beside it in the same source (None:
    nothing). ``sensors`` are the shapes of what is observed, ``goals`` the places of those that are goals,
    ``activation`` the one between layers, ``script`` the one that saved it: what weights do not tell. ``statistics`` is
    a file that observations were normalised by, beside the weights: its name and its bytes.
    """

    given: Fetched
    archive: TensorFile
    settings: Mapping[str, Any] | None = None
    sensors: tuple[tuple[int, ...], ...] = ()
    goals: tuple[int, ...] = ()
    activation: str | None = None
    script: str | None = None
    statistics: tuple[str, bytes] | None = None

    @property
    def value(self) -> Any:
        """What ``torch.save`` was given, its tensors still in the file."""
        return self.archive.value

    def refuse_activation(self, maker: str, why: str) -> None:
        """Raise UsageError where ``--activation`` is given to a trainer whose networks have one of their own."""
        if self.activation is not None:
            raise UsageError(f"--activation says nothing about {maker}", why=why, fix="leave it out")

    def image_shape(self, channels: int, channels_are: str = "") -> tuple[int, int, int]:
        """Return the shape of the one image that convolutions of so many channels see, [C, H, W], which the user says.

        ``channels_are`` says what a trainer stacks there. Raises SourceError, UsageError.
        """
        if len(self.sensors) != 1 or len(self.sensors[0]) != 3:
            raise SourceError(
                "the checkpoint does not say the size of the image that it sees",
                why="convolutions take any",
                fix=f"say it: --sensors {channels}x84x84 (channels, height, width{channels_are})",
            )
        ((found, height, width),) = self.sensors
        if found != channels:
            raise UsageError(
                "--sensors does not fit the checkpoint", why=f"its image has {channels} channels", fix="say them"
            )
        return channels, height, width


class Modules(Struct, frozen=True):
    """The network as PyTorch builds it (converters/runtimes/torch): of which trainer, of which weights, what is told.

    ``arrays`` are numbers that do not stand in the state: statistics of a file beside it.
    """

    kind: str
    weights: Weights
    told: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict)

    def write(self, folder: Path) -> Path:
        """Write the state as plain arrays; return the file. Raises DamagedFileError, OSError."""
        np.savez(file := folder / "state.npz", **{**self.weights.arrays(), **self.arrays})  # type: ignore[arg-type]
        return file


class Rebuilt(Struct, frozen=True):
    """A policy, what is known of it, and the files beside the checkpoint that said something.

    ``modules``: its network for PyTorch, where that is one that is built there.
    """

    graph: Graph
    facts: SourceFacts
    files: tuple[Path, ...] = ()
    modules: Modules | None = None


class Trainer(Struct, frozen=True):
    """A trainer whose state dictionaries are known.

    - ``label``: what people call it.
    - ``recognise`` looks at what was saved and gives what it found, for ``rebuild``; None where another wrote it.
    - ``rebuild`` gives the policy. It raises SourceError for parts that are not known, DamagedFileError, UsageError for
      options that do not fit.
    - ``by_names``: the names of its tensors alone tell it, nothing that lies beside them.
    - ``scripts``: it is several scripts, of which ``Saved.script`` names one.
    """

    label: str
    recognise: Callable[[Saved], Any]
    rebuild: Callable[[Saved, Any], Rebuilt]
    by_names: bool = True
    scripts: bool = False
