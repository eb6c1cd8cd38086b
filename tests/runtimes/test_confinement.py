"""A runtime's process reads, computes, writes to its own folder; it has no network and no more memory than is fair."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.files.children import memory_limits as memory
from export_model.converters.files.children.confinement import in_force
from export_model.converters.files.children.environment import child_environment, readable_places
from export_model.converters.files.children.memory_limits import FREE
from export_model.converters.files.children.process import RunFailedError, RuntimeProcess
from export_model.converters.files.children.python import child_command, confined_command
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.runtimes.javascript.node import _program
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.signatures.errors import RuntimeUnavailableError
from tests.bench.big_policies import OBSERVED, frozen
from tests.commands import PLACES

pytestmark = pytest.mark.skipif(not all(in_force().values()), reason="this kernel lacks Landlock or seccomp")

#: Asked of what is neither terminal nor file: EPERM is the filter's answer, ENOTTY the kernel's.
ASKED = """
import fcntl, os
from tests.commands import PLACES
try:
    fcntl.ioctl(os.pipe()[0], {:#x}, bytes(32))
except OSError as error:
    exit(error.errno == 1)
"""
ATTEMPTS = {
    "write": "open({outside!r} + '/new', 'w')",
    "write over": "open({outside!r} + '/there', 'w')",
    "append": "open({outside!r} + '/there', 'a').write('x')",
    "cut off": "import os; os.truncate({outside!r} + '/there', 0)",
    "remove": "import os; os.unlink({outside!r} + '/there')",
    "rename": "import os; os.rename({outside!r} + '/there', {outside!r} + '/gone')",
    "make a folder": "import os; os.mkdir({outside!r} + '/folder')",
    "make a link": "import os; os.symlink('/etc', {outside!r} + '/link')",
    "write by another program": "import subprocess; subprocess.run(['cp', '/etc/hostname', {outside!r}], check=True)",
    "call": "import socket; socket.create_connection(('127.0.0.1', {port}), 2)",
    "send a datagram": "import socket; socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(b'x', ('127.0.0.1', 9))",
    "a local socket": "import socket; socket.socket(socket.AF_UNIX)",
    "signal its parent": "import os; os.kill(os.getppid(), 0)",
    "change a mode": "import os; os.chmod({outside!r} + '/there', 0o777)",
    "change an owner": "import os; os.chown({outside!r} + '/there', os.getuid(), os.getgid())",
    "change a time": "import os; os.utime({outside!r} + '/there', (1, 1))",
    "change an attribute": "import os; os.setxattr({outside!r} + '/there', 'user.x', b'y')",
    "start a process": "import os; os.fork() or os._exit(0); os.wait()",
    "start a program": "import subprocess; subprocess.run(['true'], check=True)",
    "raise a limit": "import resource as r; r.setrlimit(r.RLIMIT_DATA, (r.RLIM_INFINITY, r.RLIM_INFINITY))",
    "limit its parent": "import os, resource as r; r.prlimit(os.getppid(), r.RLIMIT_NOFILE, (9, 9))",
    "be nicer": "import os; os.nice(1)",
    "choose a processor": "import os; os.sched_setaffinity(0, os.sched_getaffinity(0))",
    "share memory": "import ctypes; exit(ctypes.CDLL(None).shmget(0, 4096, 0o1600) < 0)",
    "use a keyring": "import ctypes; exit(ctypes.CDLL(None).syscall(250, 0, -3, 0) < 0)",
    "leave for a namespace": "import ctypes; exit(ctypes.CDLL(None).unshare(0x10000000) < 0)",
    "read": "open({outside!r} + '/there').read()",
    "read a folder": "import os; os.listdir({outside!r})",
    "read its parent's variables": "import os; open(f'/proc/{{os.getppid()}}/environ').read()",
    "read its parent's memory map": "import os; open(f'/proc/{{os.getppid()}}/maps').read()",
    "read passwords": "open('/etc/shadow').read()",
    "open by a handle": "import ctypes; exit(ctypes.CDLL(None).open_by_handle_at(-1, bytes(16), 0) < 0)",
    "make a device": "import os; os.mknod({scratch!r} + '/null', 0o20600, os.makedev(1, 3))",
    "type into a terminal": ASKED.format(0x5412),
    "ask the console": ASKED.format(0x541C),
    "make a file append-only": ASKED.format(0x40086602),
    "set a file's attributes": ASKED.format(0x401C5820),
    "have a capability": "exit(int(open('/proc/self/status').read().split('CapEff:')[1].split()[0], 16) & ~4 == 0)",
    "keep accounts": "import ctypes; exit(ctypes.CDLL(None).acct({outside!r}.encode() + b'/there') < 0)",
    "set the clock": "import time; time.clock_settime(time.CLOCK_REALTIME, time.time())",
    "name the machine": "import socket; socket.sethostname(socket.gethostname())",
    "reboot": "import ctypes; exit(ctypes.CDLL(None).syscall(169, 0xfee1dead, 672274793, 0, 0) < 0)",
    "trace its parent": "import ctypes, os; exit(ctypes.CDLL(None).ptrace(16, os.getppid(), 0, 0) != 0)",
}


#: A child in Python gives up by itself, for other programs another does (confinement.py); a compiler is started by one.
OURS, OTHERS, COMPILER = "a child of ours", "another program", "a compiler"
#: A compiler starts its parts, and may ask whether what started it, which is confined with it, is alive.
OF_COMPILERS = {"start a process", "start a program", "signal its parent"}
STARTING = """
import sys
from pathlib import Path
from export_model.converters.files.children import bounded, confinement
confinement.confine({scratch!r}, starts=True)
done = bounded.run_bounded([sys.executable, "-c", {code!r}], Path({scratch!r}), 1 << 30, 20)
sys.stderr.write(done.stderr)
sys.exit(done.returncode)
"""


def tried(code: str, scratch: Path, way: str = OURS) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-c", code]
    variables = child_environment(scratch, readable_places(command))
    if way == COMPILER:
        command[2] = STARTING.format(scratch=str(scratch), code=code)
        return subprocess.run(command, capture_output=True, check=False, env=variables)
    if way == OURS:
        *start, program = child_command("x")
        command = [*start, program.partition("import runpy")[0] + code]
    done = confined_command(command, str(scratch))
    assert any("confinement.py" in part for part in done) == (way == OTHERS)
    return subprocess.run(done, capture_output=True, check=False, env=variables)


@pytest.mark.parametrize(
    ("name", "way"),
    [(n, way) for way in (OURS, OTHERS, COMPILER) for n in ATTEMPTS if way != COMPILER or n not in OF_COMPILERS],
)
def test_it_cannot(name: str, way: str, tmp_path: Path) -> None:
    outside, scratch = tmp_path / "outside", tmp_path / "scratch"
    outside.mkdir()
    scratch.mkdir()
    (outside / "there").write_text("kept")
    (outside / "there").chmod(0o644)
    with socket.create_server(("127.0.0.1", 0)) as server:
        code = ATTEMPTS[name].format(outside=str(outside), scratch=str(scratch), port=server.getsockname()[1])
        assert tried(code, scratch, way).returncode != 0
    assert [p.name for p in outside.iterdir()] == ["there"]
    found = (outside / "there").stat()
    assert (found.st_mode & 0o777, found.st_mtime > 9) == (0o644, True)
    assert (outside / "there").read_text() == "kept"


@pytest.mark.parametrize(
    "code",
    [
        "open({scratch!r} + '/new', 'w').write('x')",
        "import os; os.mkdir({scratch!r} + '/a'); os.rmdir({scratch!r} + '/a')",
        "open('/dev/null', 'w').write('x')",
        "open('/etc/passwd').read()",
        "import threading; t = threading.Thread(target=print); t.start(); t.join()",
    ],
)
@pytest.mark.parametrize("way", [OURS, COMPILER])
def test_it_can(code: str, way: str, tmp_path: Path) -> None:
    done = tried(code.format(scratch=str(tmp_path)), tmp_path, way)
    assert done.returncode == 0, done.stderr.decode()


def test_a_part_that_is_refused_ends_the_process(tmp_path: Path) -> None:
    """The kernel takes 16 rulesets of Landlock from a process: one more is not left out in silence."""
    code = "from export_model.converters.files.children import confinement as c\n"
    code += "for _ in range(17): c._landlock(None, ['/'])"
    done = tried(code, tmp_path)
    assert done.returncode != 0 and b"this process cannot be confined" in done.stderr


@pytest.mark.parametrize("way", [OURS, OTHERS, COMPILER])
def test_what_fails_is_the_attempt(way: str, tmp_path: Path) -> None:
    """All that the attempts import is there, and a kernel that refuses none of them says so."""
    assert tried("import ctypes, fcntl, os, pty, resource, socket, subprocess, time", tmp_path, way).returncode == 0


def test_no_core_and_no_endless_file() -> None:
    """For good: the hard limits are the same."""
    code = "import resource as r; print(*r.getrlimit(r.RLIMIT_CORE), *r.getrlimit(r.RLIMIT_FSIZE))"
    done = tried(code, Path("/tmp"))
    assert done.stdout.split() == [b"0", b"0", *[str(1 << 30).encode()] * 2]


def test_a_shim_of_node_is_looked_through(tmp_path: Path) -> None:
    """asdf and Volta start Node as a process of their own, which a confined one cannot."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("Node is not installed")
    shim = tmp_path / "node"
    shim.write_text(f'#!/bin/sh\n{node} "$@"\n')
    shim.chmod(0o755)
    assert Path(_program(str(shim))).resolve() == Path(node).resolve()
    assert _program(node) == node


HUNGRY = """
import numpy as np, sys
from export_model.converters.files.children.child import claim_stdout, serve
class Model:
    def run(self, feeds, fetch, request):
        size = int(feeds["x"][0])
        return {"y": np.full(size, 1, np.uint8)[:1]}
serve("hungry", "1", lambda header: Model(), (MemoryError,), claim_stdout())
"""


def hungry() -> list[str]:
    return [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(PLACES[0])!r})\n{HUNGRY}"]


def test_memory_is_bounded_by_what_it_is_given(tmp_path: Path) -> None:
    with RuntimeProcess("hungry", hungry()) as process:
        model = process.load(str(tmp_path))
        assert model.run({"x": np.array([1 << 20], np.int64)}, ["y"])["y"][0] == 1
        with pytest.raises(RunFailedError, match=r"MemoryError|ended while"):
            model.run({"x": np.array([FREE * 2], np.int64)}, ["y"])


CYCLIC = """
import numpy as np, weakref
from export_model.converters.files.children.child import claim_stdout, serve
loaded = weakref.WeakSet()
class Model:
    def __init__(self):
        self.itself = self  # as TensorFlow's graphs are
        loaded.add(self)
    def run(self, feeds, fetch, request):
        return {"alive": np.array(len(loaded))}
serve("cyclic", "1", lambda header: Model(), (), claim_stdout())
"""


def test_a_model_that_was_unloaded_is_gone(tmp_path: Path) -> None:
    """Its memory is not counted any more: kept by its own cycles, TensorFlow's died after some dozens of policies."""
    with RuntimeProcess("cyclic", [*hungry()[:2], hungry()[2].replace(HUNGRY, CYCLIC)]) as process:
        for _ in range(3):
            with process.load(str(tmp_path)) as model:
                assert model.run({}, ["alive"])["alive"] == 1


def test_memory_grows_with_what_it_is_fed(tmp_path: Path) -> None:
    with RuntimeProcess("hungry", hungry()) as process:
        model = process.load(str(tmp_path))
        fed = np.zeros(FREE // 16 // 8, np.int64)
        fed[0] = FREE + (FREE >> 1)
        assert model.run({"x": fed}, ["y"])["y"][0] == 1


@pytest.mark.slow
def test_tensorflow_has_what_a_large_saved_model_takes(
    pool: RuntimePool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of 200 MB made it die (a segmentation fault): what each byte may take is asked, with little beside it."""
    frozen(64, tmp_path / "large.bytes")
    options = ExportOptions(tmp_path / "out", targets=("saved_model",), verify="none")
    (result,) = export([tmp_path / "large.bytes"], options)
    monkeypatch.setattr(memory, "FREE", 64 << 20)
    with RuntimePool() as own:
        form = WRITTEN["saved_model"]
        model = own.process("tensorflow").load(
            str(result.folder / form.main_of("large")), **form.loader("serving_default")
        )
        (output,) = model.run({"state": np.zeros((3, OBSERVED), np.float32)}, ["action"]).values()
    assert output.shape[0] == 3


def test_its_folder_is_gone_when_it_is() -> None:
    code = "from export_model.converters.files.children.child import *; import os; out = claim_stdout(); "
    code += "serve('a', os.environ['TMPDIR'], None, (), out)"
    with RuntimeProcess(
        "a", [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(PLACES[0])!r}); {code}"]
    ) as process:
        folder = Path(process.start())
        assert folder.is_dir()
    assert not folder.exists()


def test_a_program_that_is_not_there_is_said() -> None:
    with pytest.raises(RuntimeUnavailableError, match="did not start"):
        RuntimeProcess("nothing", ["/no/such/program"]).launch()
