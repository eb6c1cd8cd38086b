"""``export-model play``: whether artefacts play as well as their reference."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

from msgspec.structs import replace

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.files.children.process import RunFailedError
from export_model.converters.files.folders import scratch_folder
from export_model.converters.formats.bundle.bundle import Bundle
from export_model.converters.formats.source import ReadOptions
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.compare.comparison import CompareOptions, compare_artefacts
from export_model.exporter.export.options import ExportOptions
from export_model.exporter.export.pipeline import export
from export_model.exporter.play.match import Match
from export_model.exporter.play.named import world_maker
from export_model.exporter.play.options import PlayOptions
from export_model.exporter.play.record import keep_record
from export_model.exporter.play.report import PlayReport
from export_model.exporter.play.worlds import MakeWorld
from export_model.exporter.remote.fetching import nearby
from export_model.exporter.verify.options import VerifyOptions
from export_model.signatures.contract import POLICY
from export_model.signatures.errors import UsageError

_LOG = logging.getLogger(__name__)


def play_policy(
    reference: Path | str,
    env: str | MakeWorld,
    candidates: Path | str | Sequence[Path | str] = (),
    *,
    options: PlayOptions | None = None,
    partner: Path | str | None = None,
    names: Mapping[str, str] | None = None,
    understanding: CompileOptions | None = None,
    read: ReadOptions | None = None,
    judging: VerifyOptions | None = None,
    progress: Callable[[str], None] = _LOG.info,
    pool: RuntimePool | None = None,
) -> PlayReport:
    """Play a policy's artefacts in an environment beside their reference: recorded states first, then whole episodes.

    - ``reference``: a bundle, or a source of any kind. Without ``candidates`` the formats of the bundle play, or those
      that an export of the source would write; ``names`` maps names of the reference to those of the candidates.
    - ``env``: an environment of this package (``3DBall``), or a function that makes a World for a signature.
    - ``options``: episodes, seed, margin; ``partner``: the bundle that plays the other side, where there is one.
    - ``understanding``, ``read``: how to read the reference; ``judging``: the runtimes, the tolerances of the replay.

    What the formats of a bundle earned beside their own reference is kept in its parity.json.
    Raises ExportModelError. A disagreement is not raised: ``passed`` is False.
    """
    options = options or PlayOptions()
    judging = judging or VerifyOptions()
    if judging.runtimes == "none":
        raise UsageError("--verify none leaves nothing that plays", fix="leave it out, or name a runtime")
    with ExitStack() as opened:
        given = [candidates] if isinstance(candidates, Path | str) else [*candidates]
        whole = [opened.enter_context(nearby(Path(path))) for path in (reference, *given)]
        make = world_maker(env, whole[0], partner) if isinstance(env, str) else env
        for place in whole:
            if (place / POLICY).is_file():
                Bundle.open(place).verify_hashes()
        first, *others = whole
        match = Match(make, options)
        others = others or [_playable(first, understanding, read, opened, match.take_policy)]
        report = compare_artefacts(
            first,
            others,
            CompareOptions(
                names=names or {},
                judging=replace(judging, seed=options.seed),
                understanding=understanding,
                read=read,
            ),
            progress=progress,
            understood=match.take_policy,
            pool=pool,
            judge=match.judge,
        )
    assert match.policy is not None
    if match.reference is None:
        raise RunFailedError("the reference cannot play", why="\n".join(c.sentence() for c in report.failures) or None)
    played = PlayReport(
        policy=match.policy.name,
        environment=match.world_name,
        options=options,
        margin=match.margin,
        reference=match.reference_name,
        episodes=match.reference,
        played=tuple(match.played),
        replay=report,
        recorded=match.recorded,
        notes=match.notes,
    )
    own = not given and (first / POLICY).is_file() and first == Path(reference)
    return keep_record(first, played) if own else played


def _playable(
    source: Path,
    understanding: CompileOptions | None,
    read: ReadOptions | None,
    opened: ExitStack,
    understood: Callable[[Policy], object],
) -> Path:
    """Return a bundle as it is, or one of the formats that an export of a source writes, gone when ``opened`` is.

    ``understood`` is called with a source's one policy before any format is written.
    """
    if (source / POLICY).is_file():
        return source
    folder = Path(opened.enter_context(scratch_folder()))
    options = ExportOptions(
        folder, compile=understanding or CompileOptions(), read=read or ReadOptions(), verify="none"
    )

    def check(policies: Sequence[Policy]) -> None:
        if len(policies) != 1:
            raise UsageError(
                f"{source} holds {len(policies)} policies",
                why=", ".join(p.name for p in policies),
                fix="choose one with --brain, or export it and give a bundle",
            )
        understood(policies[0])

    (result,) = export([source], options, understood=check)
    return result.folder
