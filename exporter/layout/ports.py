"""Which of a policy's tensors a layout is of, and the known robots that its widths fit. Nothing is run here."""

from __future__ import annotations

from export_model.converters.layouts.layouts import plausible_layouts
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature, TensorSpec


def ports_of(signature: PolicySignature) -> tuple[TensorSpec, TensorSpec] | None:
    """The one row of numbers that a policy sees and its continuous action without chance; None where it has others."""
    vectors = [s for s in signature.observations if s.role is Role.VECTOR and len(s.shape) == 2 and s.shape[-1]]
    head = next((h for h in signature.heads if h.is_continuous), None)
    if len(signature.observations) != 1 or len(vectors) != 1 or head is None:
        return None
    return vectors[0], head.plain or head.spec


def robots_that_fit(signature: PolicySignature) -> tuple[str, ...]:
    """Keys of the known robots whose layouts may have a policy's widths. Nothing is run."""
    ports = ports_of(signature)
    if ports is None or not ports[1].shape[-1]:
        return ()
    width, actions = ports[0].shape[-1] or 0, ports[1].shape[-1] or 0
    return tuple(dict.fromkeys(layout.robot.key for layout in plausible_layouts(width, actions)))
