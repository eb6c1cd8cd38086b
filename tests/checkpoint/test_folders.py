"""Folders: what they are, which policies they hold, in which form each is read, what is said of the rest."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.recognise import recognise_path
from export_model.converters.formats.source import ReadOptions
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import ExportModelError, NotAPolicyError, SourceError, UsageError
from fixtures import path as fixture
from tests.checkpoint.test_source import OBSERVATION, answer, run_of
from tests.checkpoint.writing import bundle, expected, policy


def frozen(place: Path, name: str = "continuous") -> Path:
    place.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(fixture(f"{name}.bytes"), place)
    return place


def read_from(folder: Path, step: int | None = None) -> dict[str, list[str]]:
    """Policy → the files that it was read from."""
    source = read_source(folder, ReadOptions(step=step))
    assert source.format.key == "run_folder"
    names = [p.name for p in source.policies()]
    files = [sorted(str(f.relative_to(folder)) for f in m.files) for m in source.models]
    assert len(names) == len(files)
    return dict(zip(names, files, strict=True))


def checkpoint(folder: Path, *prefixes: str) -> None:
    graph = policy()
    for prefix in prefixes:
        bundle(folder / prefix, graph.variables)
    graph.write(folder / "raw_graph_def.pb")


def of(prefix: str) -> list[str]:
    folder = prefix.rpartition("/")[0]
    graph = f"{folder}/raw_graph_def.pb" if folder else "raw_graph_def.pb"
    return sorted([f"{prefix}.data-00000-of-00001", f"{prefix}.index", graph])


# ------------------------------------------------------------------ the layouts of ML-Agents


def test_exports_in_folders_beside_are_told_once(tmp_path: Path) -> None:
    for name in ("A.bytes", "B.bytes", "sub/C.bytes", "notes/readme.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        frozen(tmp_path / name)
    (tmp_path / "notes/readme.txt").write_text("no model")
    first, second = (p.signature.notes for p in read_source(tmp_path).policies())
    assert [n for n in first if n.startswith("also here")] == ["also here, not used: sub/ (give it by its path)"]
    assert not [n for n in second if n.startswith("also here")]
    assert not [n for p in read_source(tmp_path / "sub").policies() for n in p.signature.notes if "also here" in n]


def test_0_1_to_0_5(tmp_path: Path) -> None:
    run = tmp_path / "models/ppo"
    checkpoint(run, "model-50.cptk", "model-7000.cptk")
    assert read_from(run) == {"ppo": of("model-7000.cptk")}
    frozen(run / "MyEnv_ppo.bytes")
    assert read_from(run) == {"ppo": ["MyEnv_ppo.bytes"]}
    assert read_from(run, 50) == {"ppo": of("model-50.cptk")}
    (note, *_) = read_source(run).policies()[0].signature.notes
    assert note == "also here, not used: model-50.cptk, model-7000.cptk"
    frozen(run / "Other_ppo.bytes", "discrete")
    assert read_from(run) == {"MyEnv_ppo": ["MyEnv_ppo.bytes"], "Other_ppo": ["Other_ppo.bytes"]}


def test_0_6(tmp_path: Path) -> None:
    run = tmp_path / "run-0"
    checkpoint(run / "Walker", "model-10.cptk")
    checkpoint(run / "Crawler", "model-10.cptk", "model-20.cptk")
    frozen(run / "Walker.bytes")
    assert read_from(run) == {"Crawler": of("Crawler/model-20.cptk"), "Walker": ["Walker.bytes"]}
    assert read_from(run, 10) == {"Crawler": of("Crawler/model-10.cptk"), "Walker": of("Walker/model-10.cptk")}
    assert read_from(run, 20) == {"Crawler": of("Crawler/model-20.cptk")}
    notes = read_source(run, ReadOptions(step=20)).policies()[0].signature.notes
    assert "Walker has no checkpoint of step 20" in notes
    with pytest.raises(UsageError, match="the steps are 10, 20"):
        read_source(run, ReadOptions(step=30))


def test_0_17_to_0_23(tmp_path: Path) -> None:
    run = tmp_path / "results/first"
    checkpoint(run / "Hop", "Hop-500.ckpt", "Hop-1000.ckpt")
    frozen(run / "Hop/frozen_graph_def.pb")
    for name in ("Hop.nn", "Hop.onnx", "Hop/Hop-500.nn", "Hop/Hop-1000.onnx"):
        (run / name).write_bytes(b"not looked at")
    (run / "run_logs").mkdir()
    (run / "configuration.yaml").write_text("behaviors: {}")
    assert read_from(run) == {"Hop": ["Hop/frozen_graph_def.pb"]}
    assert read_from(run / "Hop") == {"Hop": ["frozen_graph_def.pb"]}
    assert read_from(run, 500) == {"Hop": of("Hop/Hop-500.ckpt")}
    (note, *_) = read_source(run).policies()[0].signature.notes
    for name in ("Hop.nn", "Hop.onnx", "Hop-500.ckpt", "Hop-1000.ckpt", "Hop-500.nn", "Hop-1000.onnx"):
        assert name in note


def test_a_torch_run_is_refused_or_read_by_its_export(tmp_path: Path) -> None:
    """What only a .pt holds is the reader of .pt's to say; an ONNX beside it goes before it."""
    run = tmp_path / "results/second"
    (run / "Hop").mkdir(parents=True)
    for name in ("Hop/Hop-10.pt", "Hop/checkpoint.pt"):
        (run / name).write_bytes(b"\x80\x02not a checkpoint")
    with pytest.raises(ExportModelError, match=r"Hop[/\\]Hop-10\.pt"):
        read_source(run)
    (run / "Hop.onnx").write_bytes(b"not an ONNX")
    with pytest.raises(ExportModelError, match=r"Hop\.onnx"):
        read_source(run)


def test_a_folder_of_models_gives_one_policy_each(tmp_path: Path) -> None:
    frozen(tmp_path / "TFModels/Walker.bytes")
    frozen(tmp_path / "TFModels/Hallway.bytes", "recurrent")
    assert read_from(tmp_path / "TFModels") == {"Hallway": ["Hallway.bytes"], "Walker": ["Walker.bytes"]}


def test_a_checkpoint_without_a_graph_gives_way_to_an_export_of_its_step(tmp_path: Path) -> None:
    run = tmp_path / "Hop"
    bundle(run / "Hop-9.ckpt", policy().variables)
    (run / "Hop-9.onnx").write_bytes(b"not an ONNX")
    with pytest.raises(ExportModelError, match=r"Hop-9\.onnx"):
        read_source(run)
    (run / "Hop-9.onnx").unlink()
    with pytest.raises(SourceError, match="graph is missing beside the checkpoint"):
        read_source(run)


def test_numbers_decide_not_text(tmp_path: Path) -> None:
    graphs = run_of(tmp_path / "r", (999, 1000, 99))
    (found,) = read_source(tmp_path / "r").policies()
    np.testing.assert_allclose(answer(found), expected(graphs[1000], OBSERVATION), rtol=1e-6)


def test_names_of_several_behaviors_are_the_bundles(tmp_path: Path) -> None:
    run = tmp_path / "run"
    checkpoint(run / "One", "model-1.cptk")
    checkpoint(run / "Two", "model-1.cptk")
    results = list(export([run], ExportOptions(tmp_path / "out", verify="none")))
    assert [r.folder.name for r in results] == ["One", "Two"]
    assert [r.contract["source"]["model"] for r in results] == ["One", "Two"]


# ------------------------------------------------------------------ other folders


def test_folders_are_told_apart(tmp_path: Path) -> None:
    (result,) = export([fixture("continuous.bytes")], ExportOptions(tmp_path, verify="none"))
    assert recognise_path(Fetched(result.folder)).key == "bundle"
    assert recognise_path(Fetched(result.folder / "saved_model")).key == "saved_model"
    assert recognise_path(Fetched(result.folder / "tfjs")).key == "tfjs"
    run_of(tmp_path / "run")
    assert recognise_path(Fetched(tmp_path / "run")).key == "run_folder"


def test_a_folder_without_a_model_says_what_is_in_it(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="it is empty"):
        read_source(tmp_path)
    (tmp_path / "notes.txt").write_text("nothing")
    (tmp_path / "events").mkdir()
    with pytest.raises(SourceError, match=r"it holds events/, notes\.txt\n  fix: give a run's folder"):
        read_source(tmp_path)
    run_of(tmp_path / "models/first/Brain")
    with pytest.raises(SourceError) as caught:
        read_source(tmp_path)
    assert str(tmp_path / "models") not in str(caught.value.fix)
    with pytest.raises(SourceError, match="give one of the folders in it") as caught:
        read_source(tmp_path / "models")
    assert str(tmp_path / "models/first") in str(caught.value.fix)


def test_first_format_checkpoints_are_refused_with_the_remedy(tmp_path: Path) -> None:
    from tests.checkpoint.writing import table

    run = tmp_path / "old"
    policy().write(run / "raw_graph_def.pb")
    (run / "model-100.ckpt").write_bytes(table([(b"", b"\x0a\x02\x12\x00"), (b"\0dense", b"")]))
    for path in (run, run / "model-100.ckpt", run / "raw_graph_def.pb"):
        with pytest.raises(NotAPolicyError, match=r"first format \(V1\)") as caught:
            read_source(path)
        assert "Saver" in str(caught.value.fix)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no such file"):
        read_source(tmp_path / "model-1.cptk")
