"""Source code in a bundle may be any program: it is run again where it can only read, compute and answer."""

from __future__ import annotations

from pathlib import Path

import pytest

from export_model.converters.files.children.confinement import in_force
from export_model.converters.files.children.process import RunFailedError
from export_model.converters.formats.format import Format
from export_model.converters.formats.programs import artifact
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.signatures.errors import UnsupportedOpError
from fixtures import path
from tests.exporting import verify_bundle
from tests.programs.test_programs import PROGRAMS, need

pytestmark = [
    pytest.mark.xdist_group("programs"),
    pytest.mark.skipif(not all(in_force().values()), reason="this kernel lacks Landlock or seccomp"),
]
each_program = pytest.mark.parametrize("form", PROGRAMS, ids=lambda form: form.key)

#: Code that runs as a program is loaded, and ends it where an attempt succeeds; ``control`` always does.
ATTEMPTS = {
    "c": """
#ifdef CONTINUOUS_IMPLEMENTATION
int open(const char *path, int flags, ...);
int socket(int family, int type, int protocol);
int fork(void);
void *mmap(void *where, unsigned long size, int rights, int flags, int file, long offset);
void _exit(int status);
__attribute__((constructor)) static void attempt(void)
{{
    if ({control} || open("{outside}/new", 0101, 0600) >= 0) _exit(1);
    if (socket(2, 1, 0) >= 0 || socket(1, 1, 0) >= 0) _exit(2);
    if (fork() >= 0) _exit(3);
    if (mmap(0, 5ul << 30, 3, 0x22, -1, 0) != (void *)-1) _exit(4);
}}
#endif
""",
    "csharp": """
namespace Policies
{{
static class Attempts
{{
    [System.Runtime.InteropServices.DllImport("libc")] static extern int open(string path, int flags, int mode);
    [System.Runtime.InteropServices.DllImport("libc")] static extern int socket(int family, int type, int protocol);
    [System.Runtime.InteropServices.DllImport("libc")] static extern int fork();
    internal static int Made()
    {{
        if ({control} != 0 || open("{outside}/new", 65, 384) >= 0) System.Environment.Exit(1);
        if (socket(2, 1, 0) >= 0 || socket(1, 1, 0) >= 0) System.Environment.Exit(2);
        if (fork() >= 0) System.Environment.Exit(3);
        return 0;
    }}
}}
}}
""",
    "js": """
import {{ spawnSync }} from "node:child_process";
import {{ writeFileSync }} from "node:fs";
if ({control}) process.exit(1);
try {{
    writeFileSync("{outside}/new", "x");
    process.exit(1);
}} catch {{}}
if (spawnSync("true").status === 0) process.exit(3);
""",
}


@each_program
def test_a_bundles_program_is_run_again(form: Format, tmp_path: Path, processes: RuntimePool) -> None:
    runtime = need(form)
    options = ExportOptions(tmp_path, ("bytes", form.key), verify="none")
    (result,) = export([path("continuous")], options, pool=processes)
    report = verify_bundle(result.folder, allow_unverified=True)
    assert report.passed is True
    assert not any("not compiled" in note for note in report.notes)
    compared = {c.output for c in report.comparisons if (c.format, c.runtime) == (form.key, runtime)}
    assert "action" in compared


@each_program
def test_where_nothing_confines_it_its_bytes_are_compared(
    form: Format, tmp_path: Path, processes: RuntimePool, monkeypatch: pytest.MonkeyPatch
) -> None:
    (result,) = export([path("continuous")], ExportOptions(tmp_path, ("bytes", form.key), verify="none"))
    monkeypatch.setattr(artifact, "in_force", lambda: {"writing": False, "network": True})
    report = verify_bundle(result.folder, allow_unverified=True)
    assert any(f"not compiled again: {form.key}" in note for note in report.notes)
    assert form.key not in {c.format for c in report.comparisons}
    with pytest.raises(UnsupportedOpError, match="is not compiled"):
        artifact.vetted(result.folder / form.main.format(name=result.policy.name), [], tmp_path)


@pytest.mark.parametrize("control", [0, 1], ids=["attempts", "control"])
@each_program
def test_what_it_tries_fails(form: Format, control: int, tmp_path: Path, processes: RuntimePool) -> None:
    """It does not write outside of its folder, make a socket, start a process, or (in C) take 5 GiB: it would end."""
    runtime = need(form)
    outside = tmp_path / "outside"
    outside.mkdir()
    (result,) = export([path("continuous")], ExportOptions(tmp_path / "out", (form.key,), verify="none"))
    file = result.folder / form.main.format(name=result.policy.name)
    text = file.read_text() + ATTEMPTS[form.key].format(outside=outside, control=control)
    file.write_text(text.replace("ulong stream;", "ulong stream; public readonly int made = Attempts.Made();"))
    with RuntimePool() as pool:
        if control:
            with pytest.raises(RunFailedError):
                pool.process(runtime).load(str(file), kind="graph", format=form.key)
        else:
            pool.process(runtime).load(str(file), kind="graph", format=form.key).unload()
    assert list(outside.iterdir()) == []
