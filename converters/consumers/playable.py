"""Whether ML-Agents' players of a profile's releases can play what is written; what they cannot is refused by name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from export_model.converters.consumers.importable import other_format
from export_model.converters.consumers.profile import Profile
from export_model.converters.consumers.unity.checker import UnityVerdict, check_nn, check_onnx
from export_model.converters.consumers.unity.consumers import consumer
from export_model.converters.consumers.unity.onnx_file import parsed_onnx
from export_model.converters.files.chunks import Pieces
from export_model.converters.formats.barracuda.format import parse
from export_model.converters.formats.registry import BARRACUDA, ONNX
from export_model.signatures.errors import ProfileError


def playable(profile: Profile, files: Mapping[str, Pieces], name: str) -> None:
    """Raise ProfileError where the model of a player ends in anything but warnings, in any mode of inference."""
    for verdict in _verdicts(profile, files):
        refused = verdict.refused
        if refused is not None:
            _refuse(profile, verdict, name, refused.where, f"{refused.exception}: {refused.message}")
        for played in (p for p in verdict.played if p.fails):
            why = f"{played.outcome.value}: {played.message} ({played.exception or 'no exception'})"
            advice = "" if f"--for {profile.name}" in played.fix else f"{played.fix}, "
            _refuse(profile, verdict, name=name, where=played.where, why=why, evidence=played.evidence, advice=advice)


def _verdicts(profile: Profile, files: Mapping[str, Pieces]) -> Iterator[UnityVerdict]:
    releases = [consumer(player) for player in profile.players]
    for path, data in files.items():
        if path.endswith(".onnx"):
            file = parsed_onnx(data.to_bytes())
            yield from (check_onnx(file, Path(path), r) for r in releases if ONNX.key in r.formats)
        elif path.endswith(".nn"):
            model = parse(data.to_bytes())
            yield from (check_nn(model, Path(path), r) for r in releases if BARRACUDA.key in r.formats)


def _refuse(
    profile: Profile, verdict: UnityVerdict, name: str, where: str, why: str, evidence: str = "", advice: str = ""
) -> None:
    """``advice`` is what else mends it, unless it is this very profile."""
    written = verdict.path.suffix
    raise ProfileError(
        f"{name!r} cannot be made for {profile.name}: {verdict.consumer.package} cannot play its {written}",
        where=where,
        why=f"{why}{f' (measured: {evidence})' if evidence else ''}",
        fix=f"{advice}{other_format(profile, written[1:])}export for a later consumer (--for help lists them)",
    )
