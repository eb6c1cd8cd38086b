"""Folders as huggingface_hub's cache lays them out: ``snapshots/<revision>`` holds links to ``blobs/<hash>``."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Mapping
from pathlib import Path

import pytest

from export_model.converters.files.fetch import inside
from fixtures import path as fixture
from tests.commands import export_model, is_refused
from tests.exporting import load_policy
from tests.fuzz.seeds import _seeds, files_of
from tests.hostile.test_files_in_place_of_weights import external

pytestmark = pytest.mark.skipif(os.name != "posix", reason="on Windows the cache holds copies, unless it may link")


def snapshot(cache: Path, files: Mapping[str, bytes]) -> Path:
    """What ``snapshot_download()`` returns: a folder of the files of one revision, each a relative link."""
    folder = cache / "models--me--walker" / "snapshots" / ("1f" * 20)
    blobs = folder.parent.parent / "blobs"
    blobs.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        blob = blobs / hashlib.sha256(data).hexdigest()
        blob.write_bytes(data)
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).symlink_to(os.path.relpath(blob, (folder / name).parent))
    return folder


def is_read(source: Path, out: Path) -> None:
    ran = export_model("inspect", source)
    assert ran.status == 0, ran.err
    ran = export_model(source, "-o", out, "--to", "bytes", "--verify", "none")
    assert ran.status == 0, ran.err
    assert "blobs" not in {p.name for p in out.iterdir()}


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """In all formats."""
    out = tmp_path_factory.mktemp("bundle")
    ran = export_model(fixture("continuous"), "-o", out, "--verify", "none")
    assert ran.status == 0, ran.err
    return out / "continuous"


@pytest.mark.parametrize("place", ["", "Walker/"])
def test_a_bundle_is_read(place: str, bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = snapshot(tmp_path, {place + name: data for name, data in files_of(bundle).items()}) / place
    ran = export_model("verify", given, "--runtimes", "numpy,onnxruntime")
    assert ran.status == 0, ran.err + ran.out
    ran = export_model("compare", given, bundle, "--runtimes", "numpy,onnxruntime")
    assert ran.status == 0, ran.err + ran.out
    load_policy(given, runtime="onnxruntime")
    for of in ("tfjs", "tfjs/model.json", "saved_model", "saved_model/saved_model.pb", "continuous.onnx"):
        is_read(given / of, tmp_path / re.sub("[/.]", "-", of))
    is_read(given, tmp_path / "out")
    monkeypatch.chdir(given)
    is_read(Path(), tmp_path / "here")


@pytest.mark.parametrize("number", range(3))
def test_weights_of_a_layers_model_are_read(number: int, tmp_path: Path) -> None:
    files = _seeds("layers model")[number]
    (tmp_path / "plain").mkdir()
    for name, data in files.items():
        (tmp_path / "plain" / name).write_bytes(data)
    said = [
        (ran.status, (ran.out + ran.err).replace(f"{folder}", "").replace(folder.name, ""))
        for folder in (tmp_path / "plain", snapshot(tmp_path, files))
        for ran in (export_model("inspect", folder),)
    ]
    assert said[0] == said[1]
    assert "weights" not in said[1][1]


@pytest.mark.parametrize("given", ["", "policy.onnx"])
def test_weights_beside_an_onnx_model_are_read(given: str, tmp_path: Path) -> None:
    (tmp_path / "plain").mkdir()
    external(tmp_path / "plain")
    is_read(snapshot(tmp_path, files_of(tmp_path / "plain")) / given, tmp_path / "out")


@pytest.mark.parametrize("name", ["../../blobs/weights", "a/../../../blobs/weights", "ABSOLUTE"])
def test_a_name_itself_leads_to_no_blob(name: str, tmp_path: Path) -> None:
    """It may be of a model that was never asked for."""
    folder = snapshot(tmp_path, {"model.json": b"{}"})
    blob = folder.parent.parent / "blobs" / "weights"
    blob.write_bytes(b"1")
    (folder / "a").mkdir()
    said = str(blob) if name == "ABSOLUTE" else name
    assert (folder / said).resolve() == blob.resolve()
    assert inside(folder, said) is None
    (folder / "weights.bin").symlink_to(blob)
    assert inside(folder, "weights.bin") == blob.resolve()
    assert inside(folder / "a", "../weights.bin") is None


@pytest.mark.parametrize(
    "target",
    ["secret", "models--me--walker/secret", "models--me--other/blobs/secret", "models--me--walker/blobs/d/secret"],
)
def test_a_link_to_elsewhere_is_refused(target: str, bundle: Path, tmp_path: Path) -> None:
    folder = snapshot(tmp_path, files_of(bundle))
    place = tmp_path / target
    place.parent.mkdir(parents=True, exist_ok=True)
    for name, of in (("tfjs/group1-shard1of1.bin", "tfjs"), ("continuous.onnx", "")):
        place.write_bytes((folder / name).read_bytes())
        (folder / name).unlink()
        (folder / name).symlink_to(place)
        assert inside(folder, name) is None
        is_refused(export_model("inspect", folder / of) if of else export_model("verify", folder), "cp -rL")


def test_a_blob_that_is_a_link_is_none(tmp_path: Path) -> None:
    """What came with the model may hold a cache of its own, whose blobs lead anywhere."""
    folder = snapshot(tmp_path, {"weights.bin": b"1"})
    blob = (folder / "weights.bin").resolve()
    blob.unlink()
    blob.symlink_to("/etc/passwd")
    assert inside(folder, "weights.bin") is None
    blob.unlink()
    blobs = blob.parent
    blobs.rmdir()
    blobs.symlink_to("/etc")
    (folder / "passwd").symlink_to("../../blobs/passwd")
    assert inside(folder, "passwd") is None
