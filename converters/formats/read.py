"""From a path to models: fetched, recognised, read by its format; and what an artefact at a path takes and gives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from msgspec.structs import replace

from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.bundle import BUNDLE
from export_model.converters.formats.bundle.bundle import Bundle
from export_model.converters.formats.format import Format, Member, Ports
from export_model.converters.formats.recognise import not_readable, recognise_path
from export_model.converters.formats.registry import FORMATS
from export_model.converters.formats.source import ReadOptions, SourceModel
from export_model.converters.interfaces.merge import merge
from export_model.converters.interfaces.registry import NO_INTERFACE, read_beside
from export_model.signatures.contract import POLICY
from export_model.signatures.errors import BundleError, ExportModelError, RefusedError, SourceError, UsageError, naming

_Part = TypeVar("_Part")
_Made = TypeVar("_Made")
#: What only some sources have a use for: option, flag, and what to give to have one.
_TAKEN = (
    ("step", "a checkpoint or a run's folder"),
    ("sensors", "a .pt"),
    ("activation", "a state dictionary"),
    ("script", "a state dictionary"),
    ("repair", "an ONNX model"),
    ("normaliser", "a saved model of Stable-Baselines3"),
)


def fetch(path: Path) -> tuple[Fetched, Format]:
    """What lies at ``path``, recognised and not read yet. Raises SourceError, NotAPolicyError, DamagedFileError."""
    given = Fetched(path)
    found = recognise_path(given)
    if not found.readable and found is not BUNDLE:
        raise not_readable(found, path, given.data)
    return given, found


def check_options(found: Format, path: Path, options: ReadOptions) -> None:
    """Raise UsageError where an option was given that this kind of source has no use for."""
    for option, fix in _TAKEN:
        if getattr(options, option) not in (None, ()) and option not in found.takes:
            raise UsageError(
                f"--{option} says nothing about this source",
                where=str(path),
                why=f"it is {found.label}",
                fix=f"leave --{option} out, or give {fix}",
            )


def read_models(
    given: Fetched, found: Format, options: ReadOptions, refused: list[ExportModelError] | None = None
) -> list[SourceModel]:
    """The models of a source. Raises SourceError, GraphError and their kinds, UsageError.

    With ``refused``, which gets the errors, a member of a folder that cannot be read does not refuse the others.
    """
    import numpy as np

    with np.errstate(all="ignore"):  # weights may be any numbers
        if found.read is not None:
            return [_with_interface(model, given.path, options) for model in found.read(given, options)]
        members = [_artefact(given.path)] if found.members is None else found.members(given.path, options)
        inside = replace(options, step=None)
        if refused is None or len(members) < 2:
            return [model for member in members for model in _of_member(member, given, inside)]
        return each_or_refused(members, lambda member: _of_member(member, given, inside), refused)


def each_or_refused(
    parts: Sequence[_Part], made: Callable[[_Part], Sequence[_Made]], refused: list[ExportModelError]
) -> list[_Made]:
    """All that is ``made`` of the parts of a source; ``refused`` gets the errors of the others.

    Raises UsageError where the call is wrong, whatever the part, and the error where nothing is left.
    """
    found: list[_Made] = []
    errors: list[ExportModelError] = []
    for part in parts:
        try:
            found += made(part)
        except UsageError:
            raise
        except ExportModelError as error:
            errors.append(error)
    if errors and not found:
        raise errors[0] if len(errors) == 1 else RefusedError(errors, len(parts))
    refused += errors
    return found


def _artefact(folder: Path) -> Member:
    """The artefact that a bundle is read from, the first that can be. Raises BundleError where it was changed."""
    bundle = Bundle.open(folder)
    able = [f for f in FORMATS if f.main and f.read is not None]
    found = next((f for f in able if bundle.has(f)), None)
    if found is None:
        raise BundleError(
            "names no file that can be read",
            where=str(folder / POLICY),
            why=f"it has none of {', '.join(f.main_of(bundle.name) for f in able)}",
            fix=f"give what it was made from ({bundle.contract.origin.path}), or export that with bytes in --to",
        )
    bundle.verify_hashes(found)
    made_for = bundle.contract.tool.get("profile")
    notes = () if made_for is None else (f"the source is a bundle made with --for {made_for}",)
    return Member(bundle.path(found), bundle.name, notes=notes, files=(folder / POLICY,))


def _of_member(member: Member, folder: Fetched, options: ReadOptions) -> list[SourceModel]:
    """The models of one source inside of another; errors name it relative to the folder."""
    where = member.path.relative_to(folder.path)
    given = folder.inside(member.path)
    found = recognise_path(given)
    if found.read is None:
        raise not_readable(found, where, given.data)
    try:
        models = found.read(given, options)
    except ExportModelError as error:
        raise (error.at(str(where)) if member.path.is_file() else error) from error.__cause__
    return [_with_interface(_name_member(model, member), member.path, options) for model in models]


def _with_interface(model: SourceModel, path: Path, options: ReadOptions) -> SourceModel:
    """The model with what the files beside it state of its numbers; an artefact of ours says all by itself."""
    if model.facts.ours and options.interface is None:
        return model
    own = model.facts.interface
    stated, notes = read_beside(path, model.name, options.interface)
    if stated is None and not notes:
        left_out = options.interface == NO_INTERFACE
        return replace(model, facts=replace(model.facts, interface=None)) if left_out else model
    if own is not None and stated is not None:
        stated, conflicts = merge(own, stated)
        notes = (*notes, *conflicts)
    facts = replace(model.facts, interface=stated or own, notes=(*model.facts.notes, *notes))
    return replace(model, facts=facts)


def _name_member(model: SourceModel, member: Member) -> SourceModel:
    facts = replace(model.facts, notes=(*model.facts.notes, *member.notes))
    name = model.name if member.name is None else member.name
    return replace(model, name=name, facts=facts, files=(*member.files, *model.files))


def ports_of(path: Path) -> list[tuple[Format, Ports]]:
    """The artefacts at ``path``, one file or folder or every format of a bundle, and what each takes and gives.

    Raises SourceError where no runtime loads the format by itself, DamagedFileError, NotAPolicyError, BundleError.
    """
    found = recognise_path(Fetched(path))
    if found is BUNDLE:
        bundle = Bundle.open(path)
        artefacts = [(f, _ports(f, bundle.path(f))) for f in FORMATS if f.ports is not None and bundle.has(f)]
        if not artefacts:
            raise SourceError("the bundle holds no model", where=str(path), fix="export the policy again")
        return artefacts
    if found.ports is None:
        able = ", ".join(f.key for f in FORMATS if f.ports is not None or f is BUNDLE)
        raise SourceError(
            f"{found.label} cannot be compared as it is",
            where=str(path),
            why=f"no runtime loads it by itself; what can be compared: {able}",
            fix="export it, and compare the bundle",
        )
    return [(found, _ports(found, path))]


def _ports(found: Format, path: Path) -> Ports:
    assert found.ports is not None
    with naming(path):
        return found.ports(path)
