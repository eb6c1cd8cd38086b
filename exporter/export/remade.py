"""A bundle's policy, made from its source once more: what the bundle's files are held against."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import TYPE_CHECKING, get_args

from msgspec.structs import replace

from export_model.converters.compiler.options import CompileOptions, NoiseMode
from export_model.converters.formats.bundle.bundle import Bundle, unfit
from export_model.converters.formats.format import Format
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.formats.source import ReadOptions, SourceModel
from export_model.converters.interfaces.isaac_lab import RAW_ACTION
from export_model.converters.interfaces.registry import NO_INTERFACE
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.job import Job, bake, smaller
from export_model.exporter.export.options import storage_of
from export_model.exporter.export.sources import Source, read_source
from export_model.signatures.contract import POLICY, Contract, safe_name
from export_model.signatures.errors import BundleError
from export_model.signatures.interface import Quantity
from export_model.signatures.spec import PolicySignature, SourceMap

if TYPE_CHECKING:
    from export_model.converters.consumers.profile import Profile


def made_again(found: Source, contract: Contract, wanted: Profile) -> Job:
    """A bundle's policy from its source, in the names of its consumer; raises BundleError where none is like it."""
    for model, own in _candidates(found, contract):
        dressed = wanted.dress(own)
        if _alike(dressed, contract):
            own = replace(own, name=contract.name)  # as a file may be called
            return Job(found, model, replace(dressed, name=contract.name), wanted, own)
    raise _not_like_its_source(found, "leave --source out, or export it again")


def baked_again(found: Source, contract: Contract) -> Job:
    """A bundle's policy from its source, its action baked anew by the bundle's interface.

    Raises BundleError where none is like it. What a file beside the source stated is in the contract.
    """
    interface = contract.signature.interface
    if interface is not None:
        raw = tuple(
            Quantity(name=t.name, source=t.source, clip=t.clip) for t in interface.baked if t.name == RAW_ACTION
        )
        by_name = {t.name: t for t in interface.baked}
        actions = tuple(by_name.get(t.name, t) for t in interface.actions)
        interface = replace(interface, baked=(), actions=actions, limits=(*raw, *interface.limits))
    for model, own in _candidates(found, contract):
        if _alike(own, contract):
            policy = replace(own, name=contract.name, signature=replace(own.signature, interface=interface))
            return _round_like(bake(Job(found, model, policy), contract.tool["bake"]), contract)
    raise _not_like_its_source(found, "leave --source out, or export it again")


def compiled_again(found: Source, contract: Contract) -> Job:
    """The policy of a bundle that has no file which the kernels run, from its source; raises BundleError as above."""
    for model, own in _candidates(found, contract):
        if _alike(own, contract):
            return _round_like(Job(found, model, replace(own, name=contract.name)), contract)
    raise _not_like_its_source(found, "export it again with bytes among --to")


def read_back(found: Bundle) -> tuple[Job, Format]:
    """The policy of a bundle that has no file which the kernels run, read from the first of its files that is a source.

    Raises BundleError where none is, or where it is read as another policy than policy.json says.
    """
    form = next((f for f in WRITTEN.values() if f.read is not None and found.has(f)), None)
    if form is None:
        held = ", ".join(f.key for f in WRITTEN.values() if found.has(f))
        raise BundleError(
            f"has no file that is read back: only {held}",
            where=str(found.folder),
            why="source code is compiled and run, and a reference is what export-model reads by itself",
            fix=f"give what it was made from: --source {found.contract.origin.path}; or export the policy again, with "
            "bytes among --to",
        )
    source = read_source(found.path(form), ReadOptions(interface=NO_INTERFACE))
    wanted = tensors(found.signature)
    for model, own in _candidates(source, found.contract):
        if tensors(own.signature) == wanted:
            return Job(source, model, replace(own, name=found.name)), form
    raise unfit(
        found.path(form), f"is read as another policy than {POLICY} says", "its inputs and outputs are not those there"
    )


def _candidates(found: Source, contract: Contract) -> Iterator[tuple[SourceModel, Policy]]:
    """The source's policies of the bundle's name, or its only one, by each choice of names, noise and chance.

    A contract does not keep these choices, but what follows from them.
    """
    for names, noise, deterministic in product(("canonical", "source"), get_args(NoiseMode), (False, True)):
        compiled = list(found.compile_models(CompileOptions(names=names, noise=noise, deterministic=deterministic)))
        named = [(m, p) for m, p in compiled if safe_name(p.name) == contract.name]
        yield from named or compiled[: len(compiled) == 1]


def _alike(policy: Policy, contract: Contract) -> bool:
    """Whether a policy has the contract's inputs and outputs, made from the same tensors, and draws where it does."""
    return tensors(policy.signature) == tensors(contract.signature) and _origins(
        policy.signature, policy.source
    ) == _origins(contract.signature, contract.source)


def _round_like(job: Job, contract: Contract) -> Job:
    """A job with its weights stored as those of the bundle are."""
    weights = contract.tool.get("weights")
    return smaller(job, storage_of(weights)) if weights else job


def _origins(signature: PolicySignature, source: SourceMap) -> tuple[object, ...]:
    """What of the source a policy's tensors come from, and which chance is left in them."""
    made_from = [spec.source for spec in (*signature.inputs, *signature.outputs)]
    fixed = {name: value.tolist() for name, value in source.fixed.items()}
    return made_from, fixed, {**source.noise}, source.noise_kept, source.branches


def _not_like_its_source(found: Source, fix: str) -> BundleError:
    return BundleError(
        "cannot be held against its source",
        where=str(found.path),
        why="the source gives other inputs and outputs than the bundle has: it was exported with options",
        fix=fix,
    )


def tensors(signature: PolicySignature) -> list[tuple[object, ...]]:
    """What a caller sees of a policy's inputs and outputs."""
    return [(s.name, s.role, s.dtype, s.shape) for s in (*signature.inputs, *signature.outputs)]
