"""What a profile is: one consumer, and how a policy is made into what that one looks up."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NoReturn

from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.compiler.options import NoiseMode
from export_model.converters.files.chunks import Pieces
from export_model.converters.formats.format import Artifact, WriteOptions
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.policy.policy import Policy
from export_model.signatures.errors import ProfileError


class Profile(Struct, frozen=True, eq=False, kw_only=True):
    """A consumer of policies: ``--for NAME``.

    ``formats`` are those that it loads, the usual one first. ``dress`` gives the policy under the names, dtypes and
    layouts that the consumer looks up, or raises ProfileError. ``importers`` are those of
    ``converters/consumers/unity/readings.py`` that must read every construct of the ONNX rightly, ``misread`` gives
    the operators that one of them lacks or misreads in some form, ``checkers`` the
    releases of ``converters/consumers/unity/consumers.py`` whose checks must accept it, ``players`` those whose player
    must play it. ``opset`` is the ONNX opset.
    ``code`` is the snippet that says how to use its files. ``loaders`` are those of
    ``converters/consumers/robots/loaders.py`` whose rules the ONNX must meet. ``batch`` is the number of agents that
    the files are for (None: any). ``noise`` is what ``--noise`` may say of files in its names: most feed none, so that
    the model draws it or has none. ``beside`` gives what the consumer is built with beside the file, by name.
    """

    name: str
    aliases: tuple[str, ...] = ()
    purpose: str
    formats: tuple[str, ...]
    dress: Callable[[Policy], Policy]
    opset: int = 15
    importers: tuple[str, ...] = ()
    misread: Callable[[Sequence[str]], frozenset[str]] | None = None
    checkers: tuple[str, ...] = ()
    players: tuple[str, ...] = ()
    code: str = "agent"
    loaders: tuple[str, ...] = ()
    batch: int | None = None
    noise: tuple[NoiseMode, ...] = ("keep", "zero")
    beside: Callable[[bytes], Mapping[str, bytes]] | None = None

    @property
    def own_names(self) -> frozenset[str]:
        """The formats whose files have this consumer's names in every bundle (``.nn`` of API version 2)."""
        return frozenset(key for key in self.formats if WRITTEN[key].consumer == self.name)

    def complete(self, artifact: Artifact) -> Artifact:
        """Return an artefact with what the consumer has beside its file."""
        if self.beside is None:
            return artifact
        made = self.beside(artifact.files[artifact.main].to_bytes())
        return replace(artifact, files={**artifact.files, **{name: Pieces(data) for name, data in made.items()}})

    def write_options(self, contract: str) -> WriteOptions:
        """Return how a writer makes the files of this consumer."""
        misread = frozenset[str]() if self.misread is None else self.misread(self.importers)
        return WriteOptions(contract, self.opset, self.name, misread=misread, batch=self.batch)


def raise_profile_error(policy: Policy, profile: str, what: str, *, why: str, fix: str) -> NoReturn:
    """Raise the ProfileError of a policy that a profile cannot hold."""
    raise ProfileError(f"{policy.name!r} cannot be made for {profile}: {what}", why=why, fix=fix)
