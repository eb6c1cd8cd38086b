"""What formats that are source code share: members' names, the contract in a comment, golden rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING

from export_model.converters.formats.format import Format, WriteOptions, defer_imports
from export_model.signatures.code import WEIGHTS_FILE

if TYPE_CHECKING:
    from export_model.converters.files.chunks import Pieces
    from export_model.converters.formats.programs import artifact as _artifact
    from export_model.converters.formats.programs import members as _members
    from export_model.converters.policy.policy import Policy
else:
    _artifact, _members = defer_imports(__name__, "artifact", "members")


def program_format(
    key: str, label: str, suffix: str, write: Callable[[Policy, WriteOptions], Mapping[str, Pieces]], *, runtime: str
) -> Format:
    """Return a format that is one file of source code, and maybe its weights beside it; ``runtime`` compiles it."""
    return Format(
        key=key,
        label=label,
        advice="it is written and run, never read: give the model that it was exported from (compare takes it second)",
        sniff=partial(_artifact.is_program, suffix),
        write=write,
        main=f"{{name}}{suffix}",
        beside=WEIGHTS_FILE,
        narrow=True,
        held=_artifact.held,
        misstatement=_artifact.misstatement,
        ports=_artifact.ports,
        vetted=_artifact.vetted,
        answers=_members.answers,
        runtimes=(runtime,),
        program=True,
    )
