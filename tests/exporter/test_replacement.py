"""An old bundle is whole or the new one is, whenever the process is killed; what is not a bundle is left alone."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
from pathlib import Path

import pytest

from export_model.converters.files import folders
from export_model.converters.formats.bundle import bundle, exchange
from export_model.converters.formats.bundle.bundle import Bundle
from export_model.signatures.contract import safe_name
from export_model.signatures.errors import BundleError, UsageError
from fixtures import path as fixture
from tests.commands import Ran, export_model, files_in, python
from tests.hostile.kills import kill

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL is POSIX")

#: Runs an export that kills itself at a point of its way.
SUICIDE = """
import os, shutil, signal, sys
from pathlib import Path
from export_model.converters.formats.bundle import exchange as swap
from export_model.converters.files.chunks import Pieces
from export_model.exporter.cli.main import main

point, *arguments = sys.argv[1:]
kind, _, number = point.partition(":")
left = int(number or 0)
write, pieces, rename, exchange, remove = Path.write_bytes, Pieces.write, Path.rename, swap._exchange, shutil.rmtree

def die():
    os.kill(os.getpid(), signal.SIGKILL)

def dying_write(path, data):
    global left
    if left == 0 and path.name != "stage.txt":
        write(path, data[: len(data) // 2])
        die()
    left -= path.name != "stage.txt"
    return write(path, data)

def dying_pieces(data, path):
    global left
    if left == 0:
        dying_write(path, b"".join(map(bytes, data.chunks())))
    left -= 1
    return pieces(data, path)

def dying_rename(path, target):
    global left
    if left == 0:
        die()
    left -= 1
    return rename(path, target)

def dying_exchange(a, b):
    if kind == "before exchange":
        die()
    done = exchange(a, b)
    die()
    return done

if kind == "write":
    Path.write_bytes, Pieces.write = dying_write, dying_pieces
elif kind.endswith("exchange"):
    swap._exchange = dying_exchange
else:  # a system without an exchange
    swap._exchange = lambda a, b: False
    if kind == "rename":
        Path.rename = dying_rename
    else:
        shutil.rmtree = lambda path, *a, **k: die() if ".export-model-" in str(path) else remove(path, *a, **k)
main(arguments)
"""
#: Files that an export of one policy to all formats writes.
WRITES = 6


def exported(out: Path, *flags: str) -> Ran:
    exchange._next_look.clear()  # as in a process of its own: one that just looked through the folder rests
    return export_model(fixture("continuous"), "-o", out, "--verify", "none", *flags)


def killed(point: str, out: Path) -> None:
    """Export the deterministic variant over what is there, and die at ``point``."""
    arguments = (fixture("continuous"), "-o", out, "--verify", "none", "--deterministic")
    assert python("-c", SUICIDE, point, *arguments).status == -signal.SIGKILL


def is_whole(folder: Path) -> bool:
    """Whether every file of a bundle is the one that its policy.json names."""
    Bundle.open(folder).verify_hashes()
    return True


def is_deterministic(folder: Path) -> bool:
    return [t["name"] for t in json.loads((folder / "policy.json").read_text())["inputs"]] == ["state"]


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """An output folder that has the bundle of ``continuous`` already."""
    assert exported(tmp_path / "out").status == 0
    return tmp_path / "out"


@pytest.mark.runtimes
@pytest.mark.parametrize("point", [*(f"write:{i}" for i in range(WRITES)), "before exchange"])
def test_the_old_bundle_is_whole_when_a_run_is_killed_before_the_exchange(point: str, out: Path) -> None:
    killed(point, out)
    assert is_whole(out / "continuous")
    assert not is_deterministic(out / "continuous")
    assert {p.name for p in out.iterdir() if not p.name.startswith(".")} == {"continuous"}


@pytest.mark.runtimes
def test_the_new_bundle_is_whole_when_a_run_is_killed_after_the_exchange(out: Path) -> None:
    killed("after exchange", out)
    assert is_whole(out / "continuous")
    assert is_deterministic(out / "continuous")


@pytest.mark.runtimes
@pytest.mark.parametrize("point", [f"write:{i}" for i in range(WRITES)])
def test_nothing_is_in_the_place_when_the_first_run_is_killed(point: str, tmp_path: Path) -> None:
    killed(point, tmp_path / "out")
    assert not (tmp_path / "out" / "continuous").exists()
    assert exported(tmp_path / "out").status == 0
    assert is_whole(tmp_path / "out" / "continuous")


@pytest.mark.runtimes
def test_without_an_exchange_the_next_run_puts_the_old_bundle_back(out: Path) -> None:
    """Killed between the two renames; the next run is refused, and the old bundle is in its place all the same."""
    killed("rename:1", out)
    assert not (out / "continuous").exists()
    assert exported(out, "--opset", "99").status == 2
    assert is_whole(out / "continuous")
    assert not is_deterministic(out / "continuous")


@pytest.mark.runtimes
@pytest.mark.parametrize("point", ["rename:0", "remove"])
def test_without_an_exchange_a_bundle_is_whole_at_the_other_points(point: str, out: Path) -> None:
    killed(point, out)
    assert is_whole(out / "continuous")
    assert is_deterministic(out / "continuous") is (point == "remove")
    assert exported(out).status == 0
    assert is_whole(out / "continuous")


def test_without_an_exchange_the_old_bundle_goes_away_in_the_end(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exchange, "_exchange", lambda a, b: False)
    assert exported(out, "--deterministic").status == 0
    assert is_deterministic(out / "continuous")
    assert {p.name for p in out.iterdir()} == {"continuous"}


def test_without_an_exchange_a_rename_that_fails_puts_the_old_bundle_back(
    out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exchange, "_exchange", lambda a, b: False)
    rename = Path.rename

    def failing(path: Path, target: Path) -> Path:
        if path.name == "new":
            raise OSError(5, "Input/output error")
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", failing)
    ran = exported(out, "--deterministic")
    assert (ran.status, ran.out) == (2, "")
    assert "Input/output error" in ran.err
    assert is_whole(out / "continuous")
    assert not is_deterministic(out / "continuous")
    assert {p.name for p in out.iterdir()} == {"continuous"}


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux exchanges")
def test_linux_exchanges_two_folders_in_one_step(tmp_path: Path) -> None:
    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / name).touch()
    assert exchange._exchange(tmp_path / "a", tmp_path / "b")
    assert files_in(tmp_path) == {"a", "a/b", "b", "b/a"}
    assert not exchange._exchange(tmp_path / "a", tmp_path / "nothing")


def test_other_systems_do_not_try_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    assert not exchange._exchange(tmp_path, tmp_path)


def test_a_libc_without_the_call_is_no_trouble(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("export_model.converters.formats.bundle.exchange.ctypes.CDLL", lambda *a, **k: object())
    assert not exchange._exchange(tmp_path, tmp_path)


def test_a_replaced_bundle_leaves_nothing_of_the_old_one(out: Path) -> None:
    assert exported(out, "--to", "onnx").status == 0
    assert files_in(out) == {"continuous", "continuous/policy.json", "continuous/continuous.onnx"}


def test_only_a_bundle_or_an_empty_folder_is_replaced(tmp_path: Path) -> None:
    stage, place = tmp_path / "stage", tmp_path / "place"
    stage.mkdir()
    (place / "policy.json").mkdir(parents=True)  # a folder of that name is no contract
    with pytest.raises(BundleError, match="not a bundle"):
        bundle.put_in_place(stage, place)
    shutil.rmtree(place)
    bundle.put_in_place(stage, place)
    assert files_in(tmp_path) == {"place"}


def test_what_is_called_like_a_stage_but_is_not_ours_stays(out: Path) -> None:
    """Folders of the user's own, old and named like ours or like a bundle: neither removed nor taken for a bundle."""
    mine = [out / ".continuous.old", out / ".continuous.backup", out / ".export-model-continuous-mine"]
    for folder in mine:
        (folder / "old" / "continuous").mkdir(parents=True)
        (folder / "notes.txt").write_text("mine")
        os.utime(folder, (0, 0))
    shutil.rmtree(out / "continuous")
    assert exported(out, "--opset", "99").status == 2
    assert not (out / "continuous").exists()
    assert exported(out).status == 0
    for folder in mine:
        assert (folder / "notes.txt").read_text() == "mine"
        assert (folder / "old" / "continuous").is_dir()


@pytest.mark.runtimes
def test_what_a_killed_run_left_is_removed_by_the_next_and_what_lives_is_not(out: Path) -> None:
    killed("write:1", out)
    (left,) = [p for p in out.iterdir() if p.name.startswith(".")]
    unmarked, torn = (out / f".export-model-continuous-{digit * 16}" for digit in "ab")
    unmarked.mkdir()
    torn.mkdir()
    (torn / "stage.txt").write_bytes(folders.OURS[:9])
    with exchange.stage(out / "continuous") as new:
        os.utime(new.parent, (0, 0))
        assert exported(out).status == 0
        assert new.is_dir()
    assert not [p for p in (left, unmarked, torn, new) if p.exists()]


def test_a_run_that_makes_no_temporary_folder_removes_those_of_killed_ones(tmp_path: Path) -> None:
    left = tmp_path / f"export-model-{'a' * 16}"
    left.mkdir()
    (left / folders.MARKER).write_bytes(folders.OURS)
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    ran = python("-m", "export_model", "inspect", fixture("continuous"), environment=environment)
    assert ran.status == 0, ran.err
    assert not left.exists()


@pytest.mark.runtimes
@pytest.mark.parametrize("locks", [True, False])
def test_without_locks_a_folder_is_swept_a_day_later(locks: bool, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    killed("write:1", out)
    (left,) = [p for p in out.iterdir() if p.name.startswith(".")]
    if not locks:
        monkeypatch.setattr(folders, "_lock_folder", lambda path: None)
    assert exported(out).status == 0
    assert left.is_dir() is not locks
    if not locks:
        os.utime(left, (0, 0))
        assert exported(out).status == 0
        assert not left.exists()


def test_a_cleaning_that_fails_is_a_warning(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bundle is in its place: it was "cannot be written"."""
    monkeypatch.setattr(shutil, "rmtree", lambda path, **how: None)
    ran = exported(out, "--deterministic")
    assert ran.status == 0
    assert ran.err.startswith("warning: ")
    assert "could not be removed" in ran.err
    assert is_deterministic(out / "continuous")
    synced = exchange._sync

    def failing(path: Path) -> None:
        if path == out:
            raise OSError(5, "Input/output error")
        synced(path)

    monkeypatch.undo()
    monkeypatch.setattr(exchange, "_sync", failing)
    ran = exported(out)
    assert ran.status == 0
    assert "may be lost in a power cut" in ran.err
    assert not is_deterministic(out / "continuous")


#: Stops itself by a signal once its runtimes run, then once more in the middle of cleaning up.
STOPPED = """
import os, shutil, sys
from export_model.converters.runtimes import pool
from export_model.exporter.cli.main import main

number, again, *arguments = sys.argv[1:]
start, remove = pool.RuntimePool.start, shutil.rmtree
def stopping(self, names):
    start(self, names)
    os.kill(os.getpid(), int(number))
def removing(path, *rest, **more):
    if again == "again":
        shutil.rmtree = remove
        os.kill(os.getpid(), int(number))
    return remove(path, *rest, **more)
pool.RuntimePool.start = stopping
shutil.rmtree = removing
main(arguments)
"""


@pytest.mark.runtimes
@pytest.mark.parametrize("again", ["once", "again"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_no_folder_and_no_traceback(number: signal.Signals, again: str, tmp_path: Path) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    arguments = (fixture("continuous"), "-o", tmp_path / "out", "--verify", "numpy")
    ran = python("-c", STOPPED, int(number), again, *arguments, environment={"TMPDIR": str(temporary)})
    assert ran.status == 128 + number
    assert "Traceback" not in ran.err
    assert again == "again" or ran.err == "\nstopped\n"
    assert files_in(tmp_path) == {"out", "temporary"}


#: Loses the interrupt, as Python does where it comes in a destructor.
LOST = """
import os, signal, sys, time
from export_model.converters.runtimes import pool
from export_model.exporter.cli.main import main

start = pool.RuntimePool.start
def losing(self, names):
    start(self, names)
    try:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(1)
    except KeyboardInterrupt:
        time.sleep(60)
pool.RuntimePool.start = losing
main(sys.argv[1:])
"""


@pytest.mark.runtimes
def test_a_signal_that_was_lost_ends_it_all_the_same(tmp_path: Path) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    arguments = (fixture("continuous"), "-o", tmp_path / "out", "--verify", "numpy")
    ran = python("-c", LOST, *arguments, environment={"TMPDIR": str(temporary)})
    assert ran.status == 128 + signal.SIGTERM
    assert files_in(tmp_path) == {"out", "temporary"}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_exports_that_are_killed_at_random_tear_nothing_and_leave_nobody(tmp_path: Path) -> None:
    assert kill(6, 3, tmp_path, patience=60).faults == []


@pytest.mark.skipif(sys.platform != "linux", reason="asks /proc which file it is")
def test_all_is_on_the_disk_before_the_exchange(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []
    sync, exchanged = os.fsync, exchange._exchange
    monkeypatch.setattr(
        os, "fsync", lambda number: (seen.append(str(Path(f"/proc/self/fd/{number}").readlink())), sync(number))[1]
    )
    monkeypatch.setattr(exchange, "_exchange", lambda a, b: (seen.append("exchange"), exchanged(a, b))[1])
    assert exported(out).status == 0
    before = {Path(p).name for p in seen[: seen.index("exchange")]}
    assert before >= {"policy.json", "continuous.bytes", "continuous.onnx", "saved_model.pb", "tfjs", "new"}
    assert Path(seen[-1]) == out


def test_names_that_fall_together_are_found() -> None:
    bundle.distinct_names([("a", "x"), ("b", "y"), ("a", "x")])
    with pytest.raises(UsageError, match="x and y"):
        bundle.distinct_names([("Straße", "x"), ("STRASSE", "y")])


@pytest.mark.parametrize(
    ("given", "safe"),
    [("3DBall", "3DBall"), ("a b/c\\d:e", "a-b-c-d-e"), ("", "policy"), ("...", "policy"), ("ä", "-")],
)
def test_names_are_made_safe(given: str, safe: str) -> None:
    assert safe_name(given) == safe
    assert safe_name(safe) == safe


def test_what_is_swept_is_held_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a run that begins just then could have its new folder, empty yet, taken away."""
    left = folders.OwnFolder(tmp_path, "x-")
    folders._forget(left.path)  # its process has died
    seen: list[bool | None] = []

    def look(path: Path, **more: object) -> None:
        with folders.try_lock(path) as ours:
            seen.append(ours)

    monkeypatch.setattr(folders.shutil, "rmtree", look)
    folders.sweep(tmp_path, "x-")
    assert seen == [False]


def test_a_folder_of_very_many_is_not_looked_through_for_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exchange, "_QUICK", -1.0)
    monkeypatch.setattr(exchange, "_REST", 1e9)
    monkeypatch.setattr(exchange, "_next_look", {})
    for looks in (True, False):
        left = folders.OwnFolder(tmp_path, exchange._PREFIX)
        folders._forget(left.path)  # its process has died
        with exchange.stage(tmp_path / "3DBall"):
            assert left.path.exists() is not looks


def test_a_folder_that_goes_while_it_is_looked_at_is_nobodys_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two processes one may be done with its own while the other looks for what was left."""
    monkeypatch.setattr(exchange, "left_in", lambda parent, prefix: iter([tmp_path / ".export-model-gone"]))
    bundle.check_replaceable(tmp_path / "3DBall")
