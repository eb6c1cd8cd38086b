"""YAML as data, against PyYAML's own loader, and with what it refuses to read safely."""

from __future__ import annotations

from contextlib import suppress
from datetime import date, datetime
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from export_model.converters.files import yaml_data
from export_model.converters.files.yaml_data import read_yaml
from export_model.signatures.errors import DamagedFileError, SourceError

_LEAVES = st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats(allow_nan=False) | st.text(max_size=12)
_TREES = st.recursive(
    _LEAVES,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(min_size=1, max_size=8), inner, max_size=4),
    max_leaves=12,
)


def _plain(value: Any) -> Any:
    """What PyYAML gives, with keys and dates as text."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_plain(v) for v in value]
    return value.isoformat() if isinstance(value, date | datetime) else value


@given(_TREES, st.booleans())
def test_what_pyyaml_writes_is_read_back(tree: Any, flow: bool) -> None:
    text = yaml.safe_dump(tree, default_flow_style=flow, allow_unicode=True)
    assert read_yaml(text.encode("utf-8", "surrogatepass"), "a.yaml") == tree


@pytest.mark.parametrize(
    "text",
    [
        "a: &x [1, 2]\nb: *x\nc: {d: *x}\n",
        "params:\n  units: [256, 128, 64]\n  activation: elu\n  lr: 3e-4\n  clip: 0.2 # a comment\n  on: True\n",
        "- -.inf\n- 0x1F\n- ~\n- 'quoted: 1'\n- \"12\"\n- |\n  two\n  lines\n",
        "when: 2026-11-24\n",
        "3: one\n2.5: two\ntrue: three\n",
        "",
        "# nothing\n",
        "--- {a: 1}\n",
    ],
)
def test_written_by_hand_as_pyyaml_reads_it(text: str) -> None:
    assert read_yaml(text.encode(), "a.yaml") == _plain(yaml.safe_load(text))


def test_tags_of_python_are_data() -> None:
    text = """\
a: !!python/tuple [1, 2]
b: !!python/object/apply:builtins.slice [null, null, null]
c: !!python/name:os.system ''
"""
    with pytest.raises(yaml.YAMLError):
        yaml.safe_load(text)
    assert read_yaml(text.encode(), "env.yaml") == {"a": [1, 2], "b": [None, None, None], "c": ""}


def test_nothing_is_executed(tmp_path: Any) -> None:
    proof = tmp_path / "ran"
    text = f"!!python/object/apply:os.system ['touch {proof}']"
    assert read_yaml(text.encode(), "env.yaml") == [f"touch {proof}"]
    assert not proof.exists()


def _laughs() -> str:
    rows = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    rows += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 9)]
    return "\n".join(rows)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (_laughs(), "more than 200000 nodes"),
        ("[" * 5000, "nested deeper than 64"),
        ("a: &x [*x]", "not complete"),
        ("a: *unknown", "must be a YAML file|not complete"),
        ("a: 1\na: 2", "the key 'a' twice"),
        ("? [1, 2]\n: x", "a key that is not text"),
        ("a: [1, 2", "must be a YAML file"),
        ("\x00", "must be a YAML file"),
    ],
)
def test_what_is_beyond_the_bounds_is_refused(text: str, message: str) -> None:
    with pytest.raises(SourceError, match=message):
        read_yaml(text.encode(), "a.yaml")


def test_bytes_that_are_not_text_are_refused() -> None:
    with pytest.raises(DamagedFileError, match="must be a YAML file"):
        read_yaml(b"a: \xff\xfe", "a.yaml")


def test_a_large_file_is_refused_before_it_is_parsed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(yaml_data, "MAX_YAML_BYTES", 10)
    with pytest.raises(SourceError, match="11 bytes"):
        read_yaml(b"[" * 11, "a.yaml")


@given(st.binary(max_size=60) | st.text(alphabet="[]{}&*!:-,'\"\n |>?#%ab1.~", max_size=80).map(str.encode))
def test_any_bytes_are_read_or_refused(data: bytes) -> None:
    with suppress(SourceError):
        read_yaml(data, "a.yaml")
