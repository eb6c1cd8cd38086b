"""The interface of a policy: what its numbers mean beside their order, as far as a source states it.

- An observation's term is fed as ``clip(value - offset) * scale``, as Isaac Lab's and mjlab's observation managers
  compute it (clip, then scale).
- An action's term is applied as ``clip(action * scale + offset)``, as their action terms do.

Nothing is derived that no source states; each entry says which file and key it is from. What is ``baked`` is computed
by the graph already, and stands nowhere else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from msgspec import Meta, field
from msgspec.structs import replace

from export_model.signatures.fields import Blank, FieldError, Real, Record, Text, path_text, read

#: Bounds of a contract's interface: terms in all, numbers of one list, characters of metadata.
MAX_TERMS, MAX_VALUES, MAX_METADATA_CHARACTERS = 4096, 1 << 16, 1 << 18
#: Text of a key that is not understood, in characters; what is longer is cut there.
MAX_KEPT_CHARACTERS = 1000
MAX_NAME_CHARACTERS = 120

#: Lowest and highest value; None: not bounded.
Range = tuple[Real | None, Real | None]
_Values = Annotated[tuple[Real, ...], Meta(max_length=MAX_VALUES)]
_Ranges = Annotated[tuple[Range, ...], Meta(max_length=MAX_VALUES)]
_Names = Annotated[tuple[Text, ...], Meta(max_length=MAX_VALUES)]


class Term(Record, frozen=True, kw_only=True, rename={"source": "from"}):
    """Numbers that stand side by side in an observation or an action.

    - ``name``: its name.
    - ``size``: numbers of one frame; missing where no source says it.
    - ``elements``: a name for each number.
    - ``unit``: unit of all numbers.
    - ``scale``, ``offset``: one for all numbers, or one for each; missing: none is stated.
    - ``clip``: lowest and highest value, for all numbers or for each; None: not bounded.
    - ``history``: frames; 1: the present alone.
    - ``from``: the file and the key that state it.
    """

    name: Text
    size: Annotated[int, Meta(ge=1, le=1 << 24)] | None = None
    elements: _Names = ()
    unit: Text | None = None
    scale: _Values = ()
    offset: _Values = ()
    clip: _Ranges = ()
    history: Annotated[int, Meta(ge=1, le=1 << 16)] | None = None
    source: Text

    @property
    def width(self) -> int | None:
        """Numbers that it takes in the tensor, all frames; None where that is not stated."""
        return None if self.size is None else self.size * (self.history or 1)

    @property
    def changes(self) -> bool:
        """Whether the caller has something to compute."""
        return bool(self.scale or self.offset or self.clip)


class Quantity(Record, frozen=True, kw_only=True, rename={"source": "from"}):
    """Numbers beside inputs and outputs that a caller needs: gains, a default pose, limits.

    - ``name``: what it is.
    - ``values``: the numbers.
    - ``clip``: lowest and highest values.
    - ``elements``: what each number belongs to.
    - ``unit``: their unit.
    - ``from``: the file and the key that state it.
    """

    name: Text
    values: _Values = ()
    clip: _Ranges = ()
    elements: _Names = ()
    unit: Text | None = None
    source: Text


class Statement(Record, frozen=True, rename={"source": "from"}):
    """A sentence, or a key's text.

    - ``text``: the sentence, or the key's text.
    - ``from``: the file and the key that state it.
    """

    text: Blank
    source: Text


class Period(Record, frozen=True, rename={"source": "from"}):
    """Time from one decision to the next.

    - ``seconds``: seconds.
    - ``from``: the file and the key that state it.
    """

    seconds: Annotated[float, Meta(gt=0, le=1.7976931348623157e308, title="a finite number above 0")]
    source: Text


_Terms = Annotated[tuple[Term, ...], Meta(max_length=MAX_TERMS)]
_Quantities = Annotated[tuple[Quantity, ...], Meta(max_length=MAX_TERMS)]
_Statements = Annotated[tuple[Statement, ...], Meta(max_length=MAX_TERMS)]


class Interface(Record, frozen=True):
    """What sources state of a policy's inputs and outputs, and of its control loop.

    - ``observations``: input to its terms, in order: fed as clip(value - offset) × scale.
    - ``actions``: terms of the continuous action: applied as clip(action × scale + offset).
    - ``baked``: terms of the action that the graph computes already (--bake actions); ``actions`` lacks them then.
    - ``period``: time from one decision to the next.
    - ``resets``: what ends an episode, and what the memory starts from.
    - ``limits``: limits, by name.
    - ``quantities``: other numbers that a caller needs: gains, a default position.
    - ``kept``: keys that are not understood, as text.
    - ``metadata``: the source's own ONNX metadata, unchanged.
    """

    observations: Mapping[Text, _Terms] = field(default_factory=dict)
    actions: _Terms = ()
    baked: _Terms = ()
    period: Period | None = None
    resets: _Statements = ()
    limits: _Quantities = ()
    quantities: _Quantities = ()
    kept: _Statements = ()
    metadata: Mapping[str, str] = field(default_factory=dict)

    def __bool__(self) -> bool:
        """Whether anything is stated."""
        return self != Interface()


# ------------------------------------------------------------------ reading


def parse_interface(content: Any, inputs: Sequence[str], path: str = "interface") -> Interface | None:
    """The interface in a contract, None where it is missing. Raises FieldError that names the field."""
    if content is None:
        return None
    found: Interface = read(content, Interface, path)
    unknown = sorted(found.observations.keys() - set(inputs))
    if unknown:
        raise FieldError(f"{path}.observations", f"names {unknown[0][:80]!r}, which is not an input")
    for name, terms in found.observations.items():
        _check_terms(terms, f"{path}.observations.{name}")
    for key in ("actions", "baked"):
        _check_terms(getattr(found, key), f"{path}.{key}")
    for key in ("limits", "quantities"):
        for number, quantity in enumerate(getattr(found, key)):
            _check_ranges(quantity.clip, path_text((key, number, "clip"), path))
    if any("\ud800" <= c <= "\udfff" for pair in found.metadata.items() for text in pair for c in text):
        raise FieldError(f"{path}.metadata", "must be texts by their keys")
    if sum(len(key) + len(value) for key, value in found.metadata.items()) > MAX_METADATA_CHARACTERS:
        raise FieldError(f"{path}.metadata", f"has more than {MAX_METADATA_CHARACTERS} characters")
    return replace(found, observations={name: terms for name, terms in found.observations.items() if terms})


def _check_terms(terms: Sequence[Term], path: str) -> None:
    """Raise FieldError unless each term has one entry for all of its numbers, or one for each."""
    for number, term in enumerate(terms):
        for key in ("elements", "scale", "offset", "clip"):
            count = len(getattr(term, key))
            if count > 1 and term.size is not None and count != term.size:
                raise FieldError(f"{path}[{number}].{key}", f"has {count} entries, and the term {term.size} numbers")
        _check_ranges(term.clip, f"{path}[{number}].clip")


def _check_ranges(ranges: Sequence[Range], path: str) -> None:
    for number, (low, high) in enumerate(ranges):
        if low is not None and high is not None and low > high:
            raise FieldError(f"{path}[{number}]", "does not go up")
