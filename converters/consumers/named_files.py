"""Formats whose files have a consumer's names, whichever names their bundle has: ``.nn``, which Unity alone loads."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from export_model.converters.formats.format import Artifact, Format, Kernels, WriteOptions

if TYPE_CHECKING:
    from export_model.converters.policy.policy import Policy
    from export_model.signatures.code import CodeOptions
    from export_model.signatures.spec import PolicySignature


def artifact_of(form: Format, policy: Policy, options: WriteOptions) -> Artifact:
    """Return the policy in a format, under the names of a consumer where its files have those alone.

    A policy that was made for a profile keeps its names. Raises GraphError and its like where it cannot be held.
    """
    if form.consumer and not policy.constants:
        from export_model.converters.consumers.mlagents.version2 import dress_nn

        policy = dress_nn(policy, form.consumer)
    return form.artifact(policy, options)


def answered_outputs(form: Format, signature: PolicySignature, code: CodeOptions) -> list[str]:
    """Return the outputs of a policy that its artefact in a format answers."""
    if form.consumer:
        from export_model.converters.consumers.mlagents import own_names

        return own_names.answered_outputs(signature)
    return [s.name for s in signature.outputs] if form.answers is None else form.answers(signature, code)


def kernels(form: Format, path: Path) -> Kernels | None:
    """Return what runs an artefact of a format by the numpy kernels; None where its graph is run as it is."""
    if not form.consumer:
        return None
    from export_model.converters.consumers.mlagents import own_names

    return own_names.kernels(path)
