"""What is neither agreement nor a disagreement: NaN throughout, a reference that died, choices that are as good."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.children.process import RunFailedError
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.again import verify_folder
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.verify.difference import compare, compare_all
from export_model.exporter.verify.participants import Feeds
from export_model.exporter.verify.reference import Reference
from export_model.exporter.verify.tolerances import Tolerance
from tests.commands import export_model
from tests.comparing import compare_artefacts
from tests.exporter.test_what_is_compared import _epsilon_greedy
from tests.faults.test_blind_spots import Arrays, honest, verified
from tests.handmade import constant, graph_bytes, node, placeholder

F: dict[str, Any] = {"T": np.float32}


def layer(name: str, source: str, matrix: Any) -> list[Any]:
    return [
        constant(f"{name}/w", np.asarray(matrix, np.float32)),
        node(name, "MatMul", source, f"{name}/w", transpose_a=False, transpose_b=False, **F),
    ]


def with_value(spoiled: float = 1.0) -> bytes:
    """``action`` and ``value_estimate`` of [B, 3]; the value's weights times ``spoiled``."""
    rng = np.random.default_rng(0)
    return graph_bytes(
        [
            placeholder("vector_observation"),
            *layer("mean", "vector_observation", rng.standard_normal((3, 2))),
            node("action", "Tanh", "mean", **F),
            *layer("value_estimate", "vector_observation", rng.standard_normal((3, 1)) * spoiled),
        ]
    )


def chosen(gap: float = 0.0) -> bytes:
    """``action``: the best of four scores, which are no output; the third is the second plus ``gap``."""
    rng = np.random.default_rng(0)
    matrix = rng.standard_normal((3, 4))
    matrix[:, 2] = matrix[:, 1]
    return graph_bytes(
        [
            placeholder("vector_observation"),
            *layer("before", "vector_observation", matrix),
            constant("gap", np.array([0, 0, gap, 0], np.float32)),
            node("scores", "Add", "before", "gap", **F),
            constant("axis", 1, np.int32),
            node("action", "ArgMax", "scores", "axis", T=np.float32, Tidx=np.int32, output_type=np.int64),
        ]
    )


def written(tmp_path: Path, data: bytes, name: str = "policy.bytes") -> Path:
    source = tmp_path / name
    source.write_bytes(data)
    return source


# ------------------------------------------------------------------ nothing finite


def test_nan_throughout_is_not_decided(tmp_path: Path, processes: RuntimePool) -> None:
    assert verified(written(tmp_path, with_value()), tmp_path, processes, honest).passed is True
    report = verified(written(tmp_path, with_value(np.nan)), tmp_path, processes, honest)
    assert report.passed is None
    assert report.verdict == "not verified"
    assert "value_estimate has not one finite number" in report.undecided
    assert [(f.kind, f.output) for f in report.failures] == [("undecided", "value_estimate")]


def test_a_choice_among_nan_is_not_decided(tmp_path: Path, processes: RuntimePool) -> None:
    report = verified(written(tmp_path, chosen(np.nan)), tmp_path, processes, honest)
    assert report.passed is True, "three scores are numbers"
    nodes = [
        placeholder("vector_observation"),
        *layer("scores", "vector_observation", np.full((3, 4), np.nan)),
        constant("axis", 1, np.int32),
        node("action", "ArgMax", "scores", "axis", T=np.float32, Tidx=np.int32, output_type=np.int64),
    ]
    report = verified(written(tmp_path, graph_bytes(nodes)), tmp_path, processes, honest)
    assert report.passed is None
    assert "scores that action is chosen by are NaN" in report.undecided


def test_nan_throughout_ends_with_status_3(tmp_path: Path) -> None:
    source = written(tmp_path, with_value(np.nan))
    ran = export_model(source, "-o", tmp_path / "out", "--verify", "onnxruntime")
    assert ran.status == 3
    assert "NOT VERIFIED" in ran.out
    assert "not one finite number" in ran.out
    folder = tmp_path / "out" / "policy"
    for command in (("verify", folder), ("compare", source, folder)):
        ran = export_model(*command, "--runtimes", "onnxruntime")
        assert ran.status == 3, command
        assert "not one finite number" in ran.out
    ran = export_model("verify", folder, "--runtimes", "onnxruntime", "--json")
    assert ran.json["reports"][0]["passed"] is None


# ------------------------------------------------------------------ a reference that died


def test_a_reference_that_died_is_no_disagreement(
    tmp_path: Path, pool: RuntimePool, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = written(tmp_path, with_value())
    (result,) = export([source], ExportOptions(tmp_path / "out", verify="none"))

    def dies(self: Reference, inputs: Any) -> Any:
        raise RunFailedError("tensorflow ended", why="killed by signal 9")

    monkeypatch.setattr(Reference, "answers", dies)
    for report in (
        verify_folder(result.folder, source=source, runtimes="onnxruntime,tensorflow"),
        compare_artefacts(source, [result.folder], runtimes="onnxruntime,tensorflow", pool=pool),
    ):
        assert report.passed is None
        assert "killed by signal 9" in report.undecided


def test_a_source_that_its_runtime_refuses_is_no_disagreement(tmp_path: Path) -> None:
    nodes = [placeholder("vector_observation"), *layer("mean", "vector_observation", np.ones((3, 2)))]
    del nodes[-1].attr["T"]
    source = written(tmp_path, graph_bytes([*nodes, node("action", "Tanh", "mean", **F)]))
    ran = export_model(source, "-o", tmp_path / "out", "--verify", "tensorflow,onnxruntime")
    assert ran.status == 3
    assert "missing attr 'T'" in ran.out


# ------------------------------------------------------------------ choices that are as good


@pytest.mark.parametrize(("gap", "right"), [(0.0, True), (1e-6, True), (0.1, False)])
def test_a_tie_of_scores_that_are_no_output_may_go_either_way(
    gap: float, right: bool, tmp_path: Path, processes: RuntimePool
) -> None:
    def spoil(feeds: Feeds, answers: Arrays) -> Arrays:
        swapped = {n: np.where((a == 1) | (a == 2), 3 - a, a) for n, a in answers.items() if a.dtype.kind == "i"}
        return {**answers, **swapped}

    source = written(tmp_path, chosen(gap))
    report = verified(source, tmp_path, processes, spoil)
    assert report.passed is right, [f.explanation() for f in report.failures]


@pytest.mark.parametrize(("gap", "right"), [(0.0, True), (0.1, False)])
def test_a_tie_that_the_odds_of_a_mixture_hang_on_may_go_either_way(
    gap: float, right: bool, tmp_path: Path, processes: RuntimePool
) -> None:
    """Once in four times any class, else the best: the odds themselves are others where two are as good."""

    def spoil(feeds: Feeds, answers: Arrays) -> Arrays:
        swapped = {n: np.where((a == 1) | (a == 2), 3 - a, a) for n, a in answers.items() if a.dtype.kind == "i"}
        odds = {n: a[:, [0, 2, 1, 3]] for n, a in answers.items() if n == "action_log_probs"}
        return {**answers, **swapped, **odds}

    graph = schema.parse(schema.GraphDef, chosen(gap), "GraphDef")
    nodes = [n for n in graph.node if n.name not in ("action", "axis")]
    nodes.append(node("logits", "Identity", "scores", **F))
    source = written(tmp_path, graph_bytes([*nodes, *_epsilon_greedy()]))
    report = verified(source, tmp_path, processes, spoil)
    assert report.passed is right, [f.explanation() for f in report.failures]


def test_another_choice_at_a_tie_is_a_fault(tmp_path: Path, processes: RuntimePool) -> None:
    def spoil(feeds: Feeds, answers: Arrays) -> Arrays:
        return {n: np.where(a == 1, 3, a) if a.dtype.kind == "i" else a for n, a in answers.items()}

    assert verified(written(tmp_path, chosen()), tmp_path, processes, spoil).passed is False


# ------------------------------------------------------------------ large numbers that hardly vary


@pytest.mark.parametrize(("relative", "right"), [(4e-6, True), (3e-5, False)])
def test_a_column_that_hardly_varies_is_held_to_its_size(relative: float, right: bool) -> None:
    reference = (1e4 + np.linspace(0, 5, 64)).astype(np.float32)[:, None]
    candidate = (reference * np.float32(1 + relative)).astype(np.float32)
    most = np.array([[1e-3 * 5]])
    assert compare(reference, candidate, Tolerance(), most=most).passed is right
    (found,) = compare_all([reference], [candidate], Tolerance(), most=most)
    assert (found is not None) is right
