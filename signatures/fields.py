"""Content of JSON files as records: types and bounds stand in the records, and an error names the field.

msgspec converts and refuses. What it says is put into this project's words, by the schema of what was wanted: where the
value lies (``inputs[0].shape``), and what it must be.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Annotated, Any, TypeAlias, TypeVar

from msgspec import Meta, Struct, ValidationError, convert, field, to_builtins

T = TypeVar("T")
Steps: TypeAlias = Sequence[str | int]

#: What one text may hold: a note is a sentence or two.
MOST_CHARACTERS = 4000
_TEXT = f"text of 1 to {MOST_CHARACTERS} printable characters"
Text = Annotated[str, Meta(min_length=1, max_length=MOST_CHARACTERS, title=_TEXT)]
Blank = Annotated[str, Meta(max_length=MOST_CHARACTERS, title=f"text of at most {MOST_CHARACTERS} characters")]
Whole = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Real = Annotated[float, Meta(ge=-1.7976931348623157e308, le=1.7976931348623157e308, title="a finite number")]
Number = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1, title="a finite number")] | Real
Size = Annotated[int, Meta(ge=0, le=2**31 - 1)]
#: Sizes of axes, None for a free one.
Shape = Annotated[tuple[Size | None, ...], Meta(max_length=32)]
Many = Annotated[tuple[T, ...], Meta(max_length=100_000)]
#: Members whose texts may be any: what they hold is looked at elsewhere.
_LOOSE = ("distribution", "metadata")


#: What the field is called that is all of a document.
WHOLE = "the whole"


class FieldError(ValueError):
    """A value is not what stands there; ``field`` is its path (``inputs[0].shape``)."""

    def __init__(self, field: str, why: str) -> None:
        self.field, self.why = field, why
        super().__init__(f"{field}: {why}")


class Record(Struct, frozen=True, omit_defaults=True):
    """A record that JSON keeps: its fields in order, without those that are None or empty (see ``explicit_default``).

    msgspec leaves out the very object that is the default: one that is neither would be written after a pickle.
    """

    def to_dict(self) -> dict[str, Any]:
        """As in JSON."""
        made: dict[str, Any] = _lists(to_builtins(self, enc_hook=_plain))
        return made


def explicit_default(make: Callable[[], T]) -> T:
    """A default that is written like any other value."""
    return field(default_factory=lambda: make())


def one_of(words: Iterable[str]) -> Meta:
    """One of these words."""
    words = [*words]
    return Meta(pattern=f"^({'|'.join(words)})$", extra_json_schema={"enum": words})


def _plain(value: Any) -> Any:
    """Numpy's arrays and numbers as JSON has them."""
    import numpy as np

    if isinstance(value, np.ndarray):
        return {"dtype": value.dtype.name, "value": value.tolist()}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} is not written to JSON")


def _lists(value: Any) -> Any:
    if isinstance(value, tuple | list):
        return [_lists(item) if isinstance(item, tuple | list | dict) else item for item in value]
    return {key: _lists(entry) for key, entry in value.items()} if isinstance(value, dict) else value


# ------------------------------------------------------------------ reading


def read(content: Any, kind: Any, path: str = "") -> Any:
    """Parsed JSON as a record; members that ``kind`` does not have are left alone. Raises FieldError."""
    try:
        record = convert(content, kind)
        for where, text in _texts(to_builtins(record, enc_hook=_plain), ()):
            if not text.isprintable():
                raise FieldError(path_text(where, path), f"must be {_TEXT}")
    except ValidationError as error:
        raise _explain(error, content, kind, path) from error
    except UnicodeEncodeError as error:  # half of a surrogate pair, which JSON can spell
        where = next((where for where, text in _texts(content, ()) if not text.isprintable()), ())
        raise FieldError(path_text(where, path), f"must be {_TEXT}") from error
    except RecursionError as error:
        raise FieldError(path or WHOLE, "is nested too deeply") from error
    return record


def path_text(steps: Steps, path: str = "") -> str:
    """``inputs[0].shape``."""
    text = path + "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in steps)
    return text.removeprefix(".") or WHOLE


def _texts(value: Any, where: tuple[str | int, ...]) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """The texts in builtins with their places, names included."""
    if isinstance(value, str):
        yield where, value
    elif isinstance(value, dict):
        for key, entry in value.items():
            yield where, key
            if key not in _LOOSE:
                yield from _texts(entry, (*where, key))
    elif isinstance(value, tuple | list):
        for number, item in enumerate(value):
            if isinstance(item, str | dict | tuple | list):
                yield from _texts(item, (*where, number))


def _explain(error: ValidationError, content: Any, kind: Any, path: str) -> FieldError:
    """What msgspec found wrong with ``content``, in our words."""
    said, _, place = str(error).partition(" - at `")
    steps: list[str | int] = [
        name or (int(number) if number.isdigit() else number)
        for name, number in re.findall(r"\.([^.\[`]+)|\[([^\]]+)\]", place)
    ]
    for number, step in enumerate(steps):
        if step == "...":
            steps[number] = _guilty_entry(error, content, kind, steps[:number])
    if lacks := re.match(r"Object missing required field `(.+)`", said):
        steps.append(lacks[1])
    if place.startswith("key"):
        return FieldError(f"{path_text(steps, path)}: the name", f"must be {_TEXT}")
    return FieldError(path_text(steps, path), _expectation(kind, content, steps) or said)


def _guilty_entry(error: ValidationError, content: Any, kind: Any, steps: Steps) -> str:
    """The name of the entry that is wrong in the object at ``steps``, which msgspec writes as three dots."""

    def cut(value: Any, way: Steps, count: int) -> Any:
        if not way:
            return dict(list(value.items())[:count])
        copy: Any = value.copy() if isinstance(value, dict) else list(value)
        copy[way[0]] = cut(copy[way[0]], way[1:], count)
        return copy

    names = list(_at(content, steps))
    low, high = 1, len(names)
    while low < high:
        middle = (low + high) // 2
        try:
            convert(cut(content, steps, middle), kind)
            right = True
        except ValidationError as found:
            right = str(found) != str(error)
        low, high = (middle + 1, high) if right else (low, middle)
    return str(names[low - 1])


def _at(content: Any, steps: Steps) -> Any:
    """The value at a place, None where it is missing."""
    for step in steps:
        content = content.get(step) if isinstance(content, dict) else content[step]
    return content


def _expectation(kind: Any, content: Any, steps: Steps) -> str:
    """What the value at ``steps`` must be, by the schema of ``kind``; empty where that does not say."""
    from msgspec.json import schema_components

    (root,), parts = schema_components([kind], schema_hook=lambda custom: {"type": "object"}, ref_template="{name}")

    def leaves(node: Mapping[str, Any], value: Any) -> list[Mapping[str, Any]]:
        node = parts.get(node.get("$ref", ""), node)
        if "anyOf" not in node:
            return [node]
        kinds = [leaf for each in node["anyOf"] for leaf in leaves(each, value)]
        kind = value.get("kind") if isinstance(value, dict) else None
        return [leaf for leaf in kinds if kind in leaf.get("properties", {}).get("kind", {}).get("enum", ())] or kinds

    found = leaves(root, content)
    for depth, step in enumerate(steps):
        value, inner = _at(content, steps[: depth + 1]), list[Mapping[str, Any]]()
        for leaf in found:
            members = leaf.get("prefixItems") if isinstance(step, int) else leaf.get("properties", {})
            others = leaf.get("items" if isinstance(step, int) else "additionalProperties")
            node = members[step] if members and (isinstance(step, int) or step in members) else others
            inner += leaves(node, value) if isinstance(node, dict) else ()
        found = inner
    words = [word for leaf in found for word in leaf.get("enum", ())]
    if words:
        return f"is {str(_at(content, steps))[:80]!r}, and none of {', '.join(map(str, words))}"
    wanted = dict.fromkeys(_word(leaf) for leaf in found if leaf.get("type") not in (None, "null"))
    return f"must be {' or '.join(wanted)}" if wanted else ""


def _word(leaf: Mapping[str, Any]) -> str:
    """What a schema allows."""
    kind = leaf["type"]
    if kind == "array":
        most, least = leaf.get("maxItems"), leaf.get("minItems")
        bounds = f"{most}" if least == most else f"at most {most}" if least is None else f"{least} to {most}"
        return "a list" if most is None else f"a list of {bounds} items"
    if kind == "object":
        return "an object"
    if "title" in leaf:
        return str(leaf["title"])
    if kind == "integer":
        return f"an integer from {leaf.get('minimum', '-2^63')} to {leaf.get('maximum', '2^63 - 1')}"
    return {"number": "a finite number", "boolean": "true or false", "string": "text"}[kind]


def printable(text: str, keep: str = "") -> str:
    """The text with U+FFFD for what cannot be printed.

    That is controls (a terminal obeys them), C1, what turns the direction of writing, lone surrogates. Characters in
    ``keep`` stay.
    """
    return text if text.isprintable() else "".join(c if c.isprintable() or c in keep else "\ufffd" for c in text)
