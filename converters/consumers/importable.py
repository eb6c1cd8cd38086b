"""Whether every construct of an ONNX is read rightly by a profile's importers; what is not is refused by name."""

from __future__ import annotations

from collections.abc import Mapping

from export_model.converters.consumers.profile import Profile
from export_model.converters.consumers.unity.constructs import constructs
from export_model.converters.consumers.unity.readings import MEASURED, misreadings
from export_model.converters.files.chunks import Pieces
from export_model.signatures.errors import ProfileError


def other_format(profile: Profile, tried: str) -> str:
    """What to try first: a format of the same consumer whose layers are others."""
    return "".join(f"write a .{key} for the same one (--to {key}), or " for key in profile.formats if key != tried)


def importable(profile: Profile, files: Mapping[str, Pieces], name: str) -> None:
    """Raise ProfileError where an importer misreads or refuses a construct, or none is known to read it."""
    import onnx

    for path, data in files.items():
        if not path.endswith(".onnx"):
            continue
        model = constructs(onnx.ModelProto.FromString(data.to_bytes()))
        found = list(misreadings(model, profile.importers))
        unknown = [c for c in model if c.op not in MEASURED]
        if found:
            first, tried = found[0], path.rpartition(".")[2]
            raise ProfileError(
                f"{name!r} cannot be made for {profile.name}: {first.importer} does not read its {first.construct.op}",
                where=f"node {first.construct.name}",
                why=f"{first.rule.reading.value}: {first.rule.says} (measured: {first.rule.evidence})",
                fix=f"{other_format(profile, tried)}export for a later consumer (--for help lists them)",
            )
        if unknown:
            raise ProfileError(
                f"{name!r} cannot be made for {profile.name}: nobody has seen its importer read {unknown[0].op}",
                where=f"node {unknown[0].name}",
                why="no construct with that operator was run in Unity's importers",
                fix="export without --for, and try the file in Unity yourself",
            )
