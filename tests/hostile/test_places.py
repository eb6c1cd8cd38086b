"""Pipes, sockets, devices, holes, and links that lead back: where a folder, a pattern, a list or a bundle has them."""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from fixtures import path as fixture
from tests.commands import Ran, export_model

pytestmark = pytest.mark.skipif(os.name != "posix", reason="they are POSIX's")


def fifo(path: Path) -> None:
    os.mkfifo(path)


def local_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(os.path.relpath(path))


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def hole(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 40)


def itself(path: Path) -> None:
    path.symlink_to(path.name)


def elsewhere(path: Path) -> None:
    path.symlink_to("/etc/passwd")


def folder(path: Path) -> None:
    path.mkdir()


ODD = (fifo, local_socket, device, hole, itself, elsewhere, folder)


def is_harmless(ran: Ran) -> None:
    assert ran.status in (0, 1, 2, 3), ran.err
    assert "Traceback" not in ran.err + ran.out
    assert "did not expect" not in ran.err + ran.out
    assert "root:" not in ran.err + ran.out


@pytest.fixture
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with one model, every odd thing under names of models, and two links that lead back to it."""
    place = tmp_path / "models"
    place.mkdir()
    monkeypatch.chdir(place)
    shutil.copy(fixture("continuous"), place / "good.bytes")
    for make in ODD:
        make(place / f"{make.__name__}.bytes")
        (place / f"run_{make.__name__}").mkdir()
        make(place / f"run_{make.__name__}" / "checkpoint")
        make(place / f"run_{make.__name__}" / "saved_model.pb")
    for name in ("loop", "back"):
        (place / name).symlink_to(place)
    return place


def commands(models: Path, out: Path) -> Iterator[tuple[str, ...]]:
    (models.parent / "list.txt").write_text("\n".join(f"{p}" for p in sorted(models.iterdir())) + "\nlist.txt\n\0\n")
    for given in (models, models / "**", models / "**/*.bytes", models / "*", models.parent / "list.txt"):
        yield str(given), "-o", str(out), "--to", "bytes", "--verify", "none"


def test_folders_patterns_and_lists_with_odd_things_end(models: Path, tmp_path: Path) -> None:
    for command in commands(models, tmp_path / "out"):
        ran = export_model(*command)
        is_harmless(ran)
        shutil.rmtree(tmp_path / "out", ignore_errors=True)


@pytest.mark.parametrize("make", ODD)
def test_an_odd_thing_as_a_source_is_refused(make: object, models: Path, tmp_path: Path) -> None:
    name = make.__name__  # type: ignore[attr-defined]
    for given in (f"{name}.bytes", f"run_{name}"):
        for command in (("inspect", given), (given, "-o", str(tmp_path / "out"), "--verify", "none")):
            ran = export_model(*command)
            is_harmless(ran)
            assert ran.status == 2, (command, ran.out)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["policy.json", "continuous.bytes", "tfjs/model.json"])
def test_a_pipe_in_a_bundle_is_not_waited_for(name: str, tmp_path: Path) -> None:
    ran = export_model(fixture("continuous"), "-o", tmp_path, "--to", "bytes,tfjs", "--verify", "none")
    assert ran.status == 0, ran.err
    bundle = tmp_path / "continuous"
    (bundle / name).unlink()
    os.mkfifo(bundle / name)
    is_harmless(export_model("snippets", bundle))
    is_harmless(export_model("compare", bundle, bundle, "--runtimes", "numpy"))
