"""A program in a bundle that looks for secrets and tells what it finds: nothing of it gets out, nor into a terminal."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import shutil
import subprocess
import sys
import tempfile
import termios
from collections.abc import Sequence
from pathlib import Path

import pytest

from export_model.converters.files.children.confinement import in_force
from export_model.converters.formats.format import Format
from export_model.exporter.export.pipeline import ExportOptions, export
from fixtures import path
from tests.commands import PLACES
from tests.programs.test_programs import PROGRAMS, need

pytestmark = [
    pytest.mark.xdist_group("programs"),
    pytest.mark.skipif(not all(in_force().values()), reason="this kernel lacks Landlock or seccomp"),
]

TOKEN, KEY, SPOKEN = "token-of-the-job", "key-of-the-user", "words-of-the-program"
#: What each language does as its program is loaded: collect all that can be read, say it everywhere, type it into
#: whatever terminal there is, and fail with it. ``{home}`` is the user's folder, ``{parent}`` the command's id.
THIEVES = {
    "c": """
#ifdef CONTINUOUS_IMPLEMENTATION
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <unistd.h>
extern char **environ;
__attribute__((constructor)) static void steal(void)
{{
    static char all[1 << 18] = "{spoken} ";
    const char *files[] = {{"{home}/key", "/proc/{parent}/environ", "/proc/self/environ", "/etc/shadow"}};
    for (char **each = environ; *each; each++) strncat(all, *each, 2000);
    for (int i = 0; i < 4; i++) {{
        int file = open(files[i], O_RDONLY);
        size_t at = strlen(all);
        ssize_t n = file < 0 ? 0 : read(file, all + at, 8000);
        for (ssize_t k = 0; k < n; k++) if (all[at + (size_t)k] < ' ') all[at + (size_t)k] = ' ';
    }}
    const char *terminals[] = {{"/dev/tty", "{terminal}", "/proc/{parent}/fd/1", "/dev/stderr"}};
    for (int i = 0; i < 4; i++) {{
        int file = open(terminals[i], O_RDWR);
        if (file < 0) file = open(terminals[i], O_WRONLY);
        if (file < 0) continue;
        if (write(file, all, strlen(all)) < 0) continue;
        for (char *c = all; *c && i < 3; c++) ioctl(file, 0x5412, c);
    }}
    for (int file = 0; file < 3; file++) for (char *c = all; *c; c++) if (ioctl(file, 0x5412, c)) break;
    fputs(all, stderr);
    fflush(stderr);
    _exit(1);
}}
#endif
""",
    "csharp": """
namespace Policies
{{
static class Thief
{{
    internal static int Steal()
    {{
        string all = "{spoken} ";
        foreach (object each in System.Environment.GetEnvironmentVariables().Values) all += each;
        all = all.Replace("\\n", " ");
        foreach (string file in new[] {{"{home}/key", "/proc/{parent}/environ", "/etc/shadow"}})
            try {{ all += System.IO.File.ReadAllText(file); }} catch (System.Exception) {{ }}
        foreach (string file in new[] {{"/dev/tty", "{terminal}", "/proc/{parent}/fd/1"}})
            try {{ System.IO.File.WriteAllText(file, all); }} catch (System.Exception) {{ }}
        System.Console.Error.WriteLine(all);
        throw new System.Exception(all);
    }}
}}
}}
""",
    "js": """
import {{ readFileSync, writeFileSync }} from "node:fs";
let all = "{spoken} " + JSON.stringify(process.env);
for (const file of ["{home}/key", "/proc/{parent}/environ", "/proc/self/environ", "/etc/shadow"])
    try {{ all += readFileSync(file, "utf8"); }} catch {{}}
for (const file of ["/dev/tty", "{terminal}", "/proc/{parent}/fd/1"])
    try {{ writeFileSync(file, all); }} catch {{}}
console.error(all);
throw new Error(all);
""",
}
#: As who the command runs: root has a user's way in, too, who may then read every file (the interpreter may be root's).
_USER = ("setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", "--inh-caps=-all,+dac_read_search")
_CAPABLE = ("--ambient-caps=-all,+dac_read_search", "--bounding-set=-all,+dac_read_search")
AS = {"as it is": (), "as a user": (*_USER, *_CAPABLE)}
#: Put the id of the command and the name of its terminal into the program, renew its hash, and verify the bundle.
COMMAND = """
import hashlib, json, os, sys
from pathlib import Path
from export_model.exporter.cli.main import main
file = Path(sys.argv[1])
file.write_text(file.read_text().replace("PARENT", str(os.getpid())).replace("TERMINAL", os.ttyname(0)))
contract = json.loads(file.with_name("policy.json").read_text())
data = file.read_bytes()
contract["files"][file.name] = {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
file.with_name("policy.json").write_text(json.dumps(contract))
reports = ["--junit", "j.xml", "--html", "h.html", "--markdown", "m.md"]
main(["verify", str(file.parent), "-v", "--allow-unverified", *reports, "--runtimes", sys.argv[2]])
"""


def tampered(form: Format, folder: Path, text: str) -> Path:
    """The source code of a bundle, with ``text`` in it that runs as it is loaded."""
    (result,) = export([path("continuous")], ExportOptions(folder, ("bytes", form.key), verify="none"))
    file = result.folder / form.main_of(result.policy.name)
    file.write_text(
        (file.read_text() + text).replace("ulong stream;", "ulong stream; public readonly int made = Thief.Steal();")
    )
    return file


def run_on_terminal(command: list[str], cwd: Path, environment: dict[str, str]) -> str:
    """What the terminal of a command shows at its end, with what was typed into it. The command must end with 1."""
    ours, theirs = pty.openpty()

    def begin() -> None:
        os.setsid()
        fcntl.ioctl(theirs, termios.TIOCSCTTY, 0)

    ends = dict.fromkeys(("stdin", "stdout", "stderr"), theirs)
    done = subprocess.Popen(command, **ends, cwd=cwd, env=environment, preexec_fn=begin)
    os.close(theirs)
    shown = b""
    with contextlib.suppress(OSError):  # nobody has it open any more
        while piece := os.read(ours, 1 << 16):
            shown += piece
    os.close(ours)
    assert done.wait() == 1, shown.decode(errors="replace")
    return shown.decode(errors="replace")


@pytest.mark.parametrize("who", AS)
@pytest.mark.parametrize("form", PROGRAMS, ids=lambda form: form.key)
def test_nothing_gets_out(form: Format, who: str) -> None:
    need(form)
    if AS[who] and (os.geteuid() != 0 or shutil.which("setpriv") is None):
        pytest.skip("runs as a user already, or cannot become one")
    with tempfile.TemporaryDirectory() as folder:  # pytest's own are closed to another user
        look_for_secrets(form, AS[who], Path(folder))


def look_for_secrets(form: Format, start: Sequence[str], tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    (home / "key").write_text(KEY)
    (home / "key").chmod(0o600)
    file = tampered(
        form, tmp_path / "new", THIEVES[form.key].format(home=home, parent="PARENT", terminal="TERMINAL", spoken=SPOKEN)
    )
    if start:
        for place in (tmp_path, *tmp_path.rglob("*")):
            os.chown(place, 65534, 65534)
    environment = {**os.environ, "JOB_TOKEN": TOKEN, "HOME": str(home), "TMPDIR": str(tmp_path)}
    environment["PYTHONPATH"] = os.pathsep.join(map(str, PLACES))
    shown = run_on_terminal([*start, sys.executable, "-c", COMMAND, str(file), form.runtimes[0]], tmp_path, environment)
    reports = [(tmp_path / name).read_text() for name in ("j.xml", "h.html", "m.md")]
    for said in (shown, *reports):
        assert TOKEN not in said and KEY not in said
        assert "root:" not in said  # of /etc/shadow
    assert not any(SPOKEN in said for said in reports)
    spoken = [line for line in shown.splitlines() if SPOKEN in line]
    assert spoken, shown
    assert all(line.startswith("  | ") for line in spoken)  # what -v prints, and marks as the program's
