"""Source code beside any model: judged by the functions that its callers call, under any name of its file."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from export_model.converters.formats.programs import artifact
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.signatures.errors import NotAPolicyError, SourceError, UnsupportedOpError
from fixtures import path as fixture
from tests.comparing import compare_artefacts
from tests.programs.test_programs import need

SUFFIXES = {"c": ".h", "csharp": ".cs", "js": ".mjs"}
each_language = pytest.mark.parametrize("key", SUFFIXES)


def written(key: str, name: str, folder: Path, target: Path, **options: str) -> Path:
    """The source code of a fixture alone in a folder, under another name."""
    (result,) = export([fixture(name)], ExportOptions(folder, targets=(key,), verify="none", **options))
    target.parent.mkdir(exist_ok=True)
    target.write_bytes((result.folder / f"{name}{SUFFIXES[key]}").read_bytes())
    return target


@each_language
def test_source_code_agrees_with_what_it_was_made_of(key: str, tmp_path: Path, pool: RuntimePool) -> None:
    need(WRITTEN[key])
    file = written(key, "recurrent", tmp_path, tmp_path / "alone" / f"policy{SUFFIXES[key]}")
    report = compare_artefacts(fixture("recurrent"), file, pool=pool)
    assert report.passed is True, report.failures
    kinds = {c.kind for c in report.comparisons}
    assert kinds >= {"numbers", "rollout", "acting"}, "act and act_all were called, too"
    assert f"not compared, as {key} never had it: action_probs" in report.notes


@each_language
def test_a_changed_weight_fails(key: str, tmp_path: Path, pool: RuntimePool) -> None:
    need(WRITTEN[key])
    file = written(key, "recurrent", tmp_path, tmp_path / "alone" / f"policy{SUFFIXES[key]}")
    text = file.read_text()
    weight = re.search(r"\b0\.\d{6,}", text)
    assert weight is not None
    file.write_text(text[: weight.start()] + "9" + text[weight.start() :])
    assert compare_artefacts(fixture("recurrent"), file, pool=pool).passed is False


def test_rounded_weights_are_known_by_the_contract_inside(tmp_path: Path, pool: RuntimePool) -> None:
    need(WRITTEN["c"])
    file = written("c", "recurrent", tmp_path, tmp_path / "alone/policy.h", weights="int8")
    report = compare_artefacts(fixture("recurrent"), file, pool=pool)
    assert report.passed is True, report.failures
    assert any(c.kind == "decisions" for c in report.comparisons)


def test_source_code_is_never_the_reference(tmp_path: Path) -> None:
    file = written("c", "recurrent", tmp_path, tmp_path / "alone/policy.h")
    with pytest.raises(NotAPolicyError, match="compare takes it second"):
        compare_artefacts(file, fixture("recurrent"))


def test_source_code_of_others_has_no_contract(tmp_path: Path) -> None:
    (tmp_path / "policy.h").write_text("int act(void);\n")
    with pytest.raises(SourceError, match="a text file cannot be compared"):
        compare_artefacts(fixture("recurrent"), tmp_path / "policy.h")


def test_source_code_is_not_compiled_where_nothing_confines_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pool: RuntimePool
) -> None:
    file = written("c", "recurrent", tmp_path, tmp_path / "alone/policy.h")
    monkeypatch.setattr(artifact, "can_confine", lambda: False)
    with pytest.raises(UnsupportedOpError, match="is not compiled"):
        compare_artefacts(fixture("recurrent"), file, pool=pool)
