"""What sources state, put to the inputs and outputs that a policy has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from msgspec.structs import replace

from export_model.converters.interfaces.table import cut_text
from export_model.signatures.interface import Interface, Statement, Term
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature


def fit_interface(
    stated: Interface, signature: PolicySignature, feeds: Mapping[str, str]
) -> tuple[Interface | None, tuple[str, ...]]:
    """Return the interface with observations by input and the actions that fit, and notes on what does not.

    ``feeds`` maps inputs to the nodes, by which observations may be stated; "" stands for the only vector. Terms whose
    sizes do not add up to the tensor's are kept as text.
    """
    notes: list[str] = []
    kept = list(stated.kept)
    observations: dict[str, tuple[Term, ...]] = {}
    nodes = {node: name for name, node in feeds.items()}
    vectors = [s.name for s in signature.observations if s.role is Role.VECTOR and len(s.shape) == 2]
    for key, terms in stated.observations.items():
        only = vectors[0] if len(vectors) == 1 else None
        name = only if key == "" else nodes.get(key) or (key if signature.has_input(key) else None)
        if name is None or not _fits(terms, signature.input(name).shape[-1], name, notes):
            kept += _texts(terms)
        else:
            observations[name] = terms
    head = next((h.spec for h in signature.heads if h.is_continuous), None)
    actions = stated.actions
    if actions and (head is None or not _fits(actions, head.shape[-1], head.name, notes)):
        kept += _texts(actions)
        actions = ()
    found = replace(stated, observations=observations, actions=actions, kept=tuple(kept))
    return (found or None), tuple(notes)


def _fits(terms: Sequence[Term], width: int | None, name: str, notes: list[str]) -> bool:
    """Whether the terms may be those of a tensor, whose last axis is ``width``; a note says why they are not."""
    sizes = [term.width for term in terms]
    known = [n for n in sizes if n is not None]
    if width is None or (len(known) < len(sizes) and sum(known) + len(sizes) - len(known) <= width):
        return True
    if len(known) == len(sizes) and sum(known) == width:
        return True
    notes.append(
        f"{terms[0].source[:300]} states {sum(known)} numbers where {name} has {width}: kept as text, not used"
    )
    return False


def _texts(terms: Sequence[Term]) -> list[Statement]:
    return [Statement(cut_text(term.to_dict()), term.source) for term in terms]


def number_names(terms: Sequence[Term]) -> list[str]:
    """A name for each number of a tensor, where sizes and names are stated and there is one frame; else none."""
    if len(terms) == 1 and not terms[0].elements:
        return []
    found: list[str] = []
    for term in terms:
        if term.size is None or (term.history or 1) > 1:
            return []
        words = term.elements or [str(i) for i in range(term.size)]
        alone = len(terms) == 1 or term.size == 1 == len(term.elements)
        found += [word if alone and term.elements else f"{term.name} {word}" for word in words]
    return [name[:120] for name in found]


def name_numbers(signature: PolicySignature) -> PolicySignature:
    """The signature with labels from its interface, where people gave none of their own."""
    interface = signature.interface
    if interface is None:
        return signature
    labels = dict(signature.labels)
    own = labels.get("observations", {})
    stated = {n: names for n, terms in interface.observations.items() if (names := number_names(terms))}
    fitting = {n: v for n, v in stated.items() if len(v) == signature.input(n).shape[-1]}
    if fitting and set(fitting) - set(own):
        labels["observations"] = {**fitting, **own}
    names = number_names(interface.baked or interface.actions)
    head = next((h.spec for h in signature.heads if h.is_continuous), None)
    if names and "actions" not in labels and head is not None and head.shape[-1] == len(names):
        labels["actions"] = names
    return replace(signature, labels=labels)
