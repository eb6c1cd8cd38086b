"""What a user gives a verification: tolerances, budgets, options, and a recording's arrays in numpy's format."""

from __future__ import annotations

import io
import math
import struct
from typing import Any

import numpy as np
import pytest

from export_model.exporter.verify.checks.size import check_budget, parse_budget, sizes
from export_model.exporter.verify.npy import read_array
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.tolerances import Tolerance, ToleranceRule, check_rules, tolerance_by_rules
from export_model.signatures.errors import UsageError

# ------------------------------------------------------------------ rules and budgets


def test_the_last_rule_that_covers_a_comparison_decides() -> None:
    one, two = Tolerance(1.0), Tolerance(2.0)
    rules = [
        ToleranceRule(one, output="action"),
        ToleranceRule(two, format="saved_model"),
        ToleranceRule(one, policy="p"),
    ]
    assert tolerance_by_rules(rules, "q", "onnx", "r", "value") is None
    assert tolerance_by_rules(rules, "q", "onnx", "r", "action") is one
    assert tolerance_by_rules(rules, "q", "saved_model:x", "r", "action") is two
    assert tolerance_by_rules(rules, "p", "saved_model", "r", "action") is one
    assert tolerance_by_rules([ToleranceRule(one, runtime="r")], "p", "onnx", "s", "action") is None


@pytest.mark.parametrize(
    ("rule", "right"),
    [
        ({}, True),
        ({"policy": "p", "output": "action"}, True),
        ({"policy": "q", "output": "action"}, False),
        ({"output": "nothing"}, False),
        ({"format": "onnx", "runtime": "onnxruntime"}, True),
        ({"format": "onnx", "runtime": "tensorflow"}, False),
        ({"format": "tfjs"}, False),
        ({"runtime": "litert"}, False),
        ({"format": "reference", "runtime": "numpy"}, True),
        ({"format": "golden", "runtime": "onnxruntime"}, True),
        ({"format": "source", "runtime": "onnxruntime"}, True),
    ],
)
def test_a_rule_must_cover_something(rule: dict[str, str], right: bool) -> None:
    given = ([ToleranceRule(Tolerance(), **rule)], {"p": ["action"], "q": ["value"]})
    formats = {"onnx": ["onnxruntime", "tensorflow"], "tfjs": ["node"]}
    if right:
        check_rules(*given, formats, ["onnxruntime"])
        return
    with pytest.raises(UsageError, match="entry 1 covers no comparison"):
        check_rules(*given, formats, ["onnxruntime"])


@pytest.mark.parametrize(
    ("text", "budget"),
    [
        ("tfjs=60kB", {"tfjs": 60_000}),
        ("1.5MB", {"total": 1_500_000}),
        ("onnx = 2 KiB", {"onnx": 2048}),
        ("7", {"total": 7}),
        ("onnx=3b", {"onnx": 3}),
        ("1gb", {"total": 10**9}),
        ("1mib", {"total": 1 << 20}),
        ("1gib", {"total": 1 << 30}),
    ],
)
def test_a_budget_is_in_bytes(text: str, budget: dict[str, int]) -> None:
    assert parse_budget([text]) == budget


@pytest.mark.parametrize("text", ["=5", "x=", "x=5 apples", "-5", "kB", "5=kb"])
def test_a_budget_is_a_size(text: str) -> None:
    with pytest.raises(UsageError):
        parse_budget([text])


def test_a_file_that_is_larger_than_its_budget_is_a_finding() -> None:
    check_budget({"onnx": 1, "total": 2}, {"onnx": 3})
    with pytest.raises(UsageError, match="tfjs"):
        check_budget({"tfjs": 1}, {"onnx": 3})
    kept, over, none = sizes({"onnx": 3, "total": 4, "nn": 0}, {"onnx": 3, "bytes": 3, "nn": 0})
    assert (kept.passed, kept.max_abs_diff, kept.reason) == (True, 0.0, "")
    assert (over.passed, over.max_abs_diff, over.max_rel_diff) == (False, 2.0, 0.5) and over.reason
    assert none.passed and none.max_rel_diff == 0.0
    (much,) = sizes({"onnx": 0}, {"onnx": 3})
    assert not much.passed and much.max_rel_diff == math.inf


@pytest.mark.parametrize(
    ("options", "flag"),
    [
        ({"golden": "x"}, "--golden"),
        ({"budget": {"onnx": 1}}, "--max-size"),
        ({"rules": [ToleranceRule(Tolerance())]}, "--tolerances"),
        ({"require": ["onnx"]}, "--require"),
        ({"samples": 3}, "--samples"),
        ({"steps": 9}, "--steps"),
        ({"seed": 1}, "--seed"),
        ({"tolerance": Tolerance(1e-3)}, "--atol"),
        ({"tolerance": Tolerance(rtol=1e-3)}, "--rtol"),
    ],
)
def test_what_needs_a_verification_is_said_without_one(options: dict[str, Any], flag: str) -> None:
    made = VerifyOptions(**options)
    assert made.flags == [flag] and VerifyOptions().flags == []
    made.check_unverified((flag,))
    with pytest.raises(UsageError, match=flag):
        made.check_unverified()


@pytest.mark.parametrize(
    "options",
    [
        {"seed": -1},
        {"samples": 0},
        {"steps": 0},
        {"tolerance": Tolerance(-1e-9)},
        {"tolerance": Tolerance(0, math.inf)},
    ],
)
def test_an_option_has_its_least_value(options: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        VerifyOptions(**options)
    assert VerifyOptions(seed=0, samples=1, steps=1, tolerance=Tolerance(0, 0)).flags == [
        "--samples",
        "--steps",
        "--atol",
        "--rtol",
    ]


# ------------------------------------------------------------------ arrays of numpy's format


def saved(array: Any, version: tuple[int, int] | None = None) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, array, version)
    return buffer.getvalue()


@pytest.mark.parametrize("version", [(1, 0), (2, 0), (3, 0)])
@pytest.mark.parametrize(
    "array",
    [
        np.arange(6, dtype=np.float32).reshape(2, 3),
        np.asfortranarray(np.arange(6).reshape(2, 3)),
        np.array(5.0),
        np.zeros((0, 3), np.int8),
        np.array([True, False]),
        np.array(["ab", "c"]),
        np.arange(3, dtype=">i2"),
    ],
)
def test_an_array_is_read_as_it_was_written(array: Any, version: tuple[int, int]) -> None:
    made = read_array(saved(array, version))
    assert made.dtype == array.dtype and made.shape == array.shape and (made == array).all()


def header(text: str, numbers: bytes = bytes(24)) -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode() + numbers


RIGHT = "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3), }"


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (header(RIGHT), ""),
        (header(RIGHT.replace("3)", "3L)")), ""),
        (b"x" + header(RIGHT), "numpy array"),
        (header(RIGHT, bytes(23)), "has 23 bytes"),
        (header(RIGHT)[:20], "characters"),
        (header(RIGHT + " " * 10_000), "characters"),
        (header(RIGHT + " " * (10_000 - len(RIGHT))), ""),
        (header(RIGHT.replace("'shape'", "'form'")), "does not say"),
        (header("[1]"), "does not say"),
        (header(RIGHT.replace("(2, 3)", "6")), "its shape"),
        (header(RIGHT.replace("2, 3", "-2, 3")), "its shape"),
        (header(RIGHT.replace("2, 3", "2.0, 3")), "its shape"),
        (header(RIGHT.replace("2, 3", "True, 3")), "its shape"),
        (header(RIGHT.replace("'<f4'", "'O'")), "its numbers"),
        (header(RIGHT.replace("'<f4'", "4")), "its numbers"),
        (header(RIGHT.replace("False", "0")), "its numbers"),
    ],
)
def test_a_header_says_what_an_array_is(data: bytes, words: str) -> None:
    if not words:
        assert read_array(data).shape == (2, 3)
        return
    with pytest.raises(ValueError, match=words):
        read_array(data)
