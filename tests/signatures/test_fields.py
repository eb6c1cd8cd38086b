"""JSON as records: what is wrong is said with its place, and what stands there as it must be."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Meta, Struct

from export_model.signatures.fields import (
    FieldError,
    Many,
    Number,
    Record,
    Shape,
    Size,
    Text,
    explicit_default,
    one_of,
    read,
)


class Round(Struct, tag_field="kind", tag="round"):
    radius: Number


class Square(Struct, tag_field="kind", tag="square"):
    sides: Annotated[tuple[Size, ...], Meta(min_length=2, max_length=2)]


class Part(Struct):
    name: Text
    form: Round | Square
    colour: Annotated[str, one_of(("red", "green"))] = "red"


class Machine(Record, frozen=True):
    parts: Mapping[Text, Part] = explicit_default(dict)
    shape: Shape = ()
    notes: Many[Text] = ()
    on: bool = explicit_default(bool)
    spare: Part | None = None


ROUND = {"kind": "round", "radius": 1}
GOOD = {f"p{i}": {"name": "a", "form": ROUND} for i in range(9)}
WRONG: tuple[tuple[Any, str], ...] = (
    ([], "the whole: must be an object"),
    ({"shape": [1, -1]}, "shape[1]: must be an integer from 0 to 2147483647"),
    ({"shape": [0] * 33}, "shape: must be a list of at most 32 items"),
    ({"on": 1}, "on: must be true or false"),
    ({"notes": ["a", "b\nc"]}, "notes[1]: must be text of 1 to 4000 printable characters"),
    ({"notes": ["a", "\ud800"]}, "notes[1]: must be text of 1 to 4000 printable characters"),
    ({"parts": {"\ud800": GOOD["p1"]}}, "parts: must be text of 1 to 4000 printable characters"),
    ({"notes": ["a", ""]}, "notes[1]: must be text of 1 to 4000 printable characters"),
    ({"parts": {"": {}}}, "parts: the name: must be text of 1 to 4000 printable characters"),
    ({"parts": {"a\x1b": GOOD["p1"]}}, "parts: must be text of 1 to 4000 printable characters"),
    ({"parts": {**GOOD, "q": {"form": ROUND}}}, "parts.q.name: must be text of 1 to 4000 printable characters"),
    ({"parts": {**GOOD, "q": 7, "r": 8}}, "parts.q: must be an object"),
    (
        {"parts": {"q": {"name": "a", "form": {"kind": "flat"}}}},
        "parts.q.form.kind: is 'flat', and none of round, square",
    ),
    (
        {"parts": {**GOOD, "q": {"name": "a", "form": {"kind": "round", "radius": "1"}}, **GOOD}},
        "parts.q.form.radius: must be a finite number",
    ),
    ({"spare": {"name": "a", "form": {"kind": "square", "sides": [1]}}}, "spare.form.sides: must be a list of 2 items"),
    ({"spare": {"name": "a", "form": ROUND, "colour": "blue"}}, "spare.colour: is 'blue', and none of red, green"),
    (
        {"spare": {"name": "a", "form": {"kind": "round", "radius": float("nan")}}},
        "spare.form.radius: must be a finite",
    ),
    ({"spare": {"name": "a", "form": {"kind": "round", "radius": 10**400}}}, "spare.form.radius: must be a finite"),
)


@pytest.mark.parametrize(("content", "words"), WRONG, ids=[words for _, words in WRONG])
def test_what_is_wrong_is_said_with_its_place(content: Any, words: str) -> None:
    with pytest.raises(FieldError) as caught:
        read(content, Machine)
    assert str(caught.value).startswith(words)


def test_unknown_members_are_left_alone_and_places_begin_where_the_caller_says() -> None:
    assert read({"shape": [None, 2], "weight": {"a": "\n"}}, Machine) == Machine(shape=(None, 2))
    with pytest.raises(FieldError, match=r"^source\.shape\[0\]: must be"):
        read({"shape": ["wide"]}, Machine, "source")


def test_a_record_writes_what_it_reads() -> None:
    content = {"parts": {"a": {"name": "a", "form": ROUND, "colour": "green"}}, "shape": [None, 3], "on": True}
    assert read(content, Machine).to_dict() == content
    assert Machine().to_dict() == {"parts": {}, "on": False}


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats() | st.text(max_size=3) | st.just("round"),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["parts", "shape", "notes", "on", "name", "form", "kind", "radius"]), inner)
    ),
    max_leaves=8,
)


@given(JSON)
def test_any_json_is_a_record_or_an_error_of_ours(content: Any) -> None:
    try:
        assert isinstance(read(content, Machine), Machine)
    except FieldError as error:
        assert error.field
        assert error.why.startswith(("must be ", "is "))
