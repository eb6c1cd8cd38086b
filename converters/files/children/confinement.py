"""What a runtime's process may do: read, compute, and write to a folder of its own.

A model file decides what a runtime computes, and runtimes have had faults. So a child gives up, before it has seen a
model, what it does not need: files are not written outside a scratch folder, TCP is neither listened on nor called
(Landlock, security/landlock.rst of the kernel's documentation), no socket of any other kind is made either (seccomp),
no core is dumped, files and their number are bounded. Memory is bounded while a request runs (process.py), because
what is fair depends on it. All of it is Linux; elsewhere, and where a kernel lacks a part, that part is not in force,
and ``export-model runtimes`` says so.

A child in Python calls ``begin`` before anything else. For others this file is a program:
``python confinement.py FOLDER PARENT COMMAND…`` gives up the same and becomes the
command. It imports the standard library only.
"""

from __future__ import annotations

import ctypes
import os
import struct
import sys
from collections.abc import Sequence

#: Bytes of a file that a child may write, descriptors that it may have open.
MAX_FILE = 1 << 30
MAX_OPEN = 1024
#: Seconds of computing in all of a process's life: a request has a time of its own, this ends what slips through.
MAX_CPU = 4 * 3600
#: The variable that tells a command with which parent the kernel kills it: it need not look by itself (js/serve.mjs).
KILLED_WITH = "EXPORT_MODEL_KILLED_WITH"

# landlock.h: system calls (the same on all machines since they are new), rights, rules.
_CREATE, _ADD, _RESTRICT = 444, 445, 446
_VERSION = 1
_PATH_BENEATH = 1
_WRITE_FILE, _REMOVE_DIR, _REMOVE_FILE = 1 << 1, 1 << 4, 1 << 5
_MAKE = sum(1 << bit for bit in range(6, 13))  # char, dir, reg, sock, fifo, block, sym
_REFER, _TRUNCATE, _IOCTL = 1 << 13, 1 << 14, 1 << 15
_TCP = 0b11  # bind, connect
_SCOPES = 0b11  # abstract sockets, signals
_SET_NO_NEW_PRIVS, _SET_SECCOMP, _FILTER = 38, 22, 2
_SET_PDEATHSIG, _SIGKILL = 1, 9

#: Machine → (its number in audit.h, the system calls that make sockets or look into other processes).
_CALLS = {
    # socket, socketpair, ptrace, process_vm_readv, process_vm_writev, io_uring_setup (which makes sockets, too)
    "x86_64": (0xC000003E, (41, 53, 101, 310, 311, 425)),
    "aarch64": (0xC00000B7, (198, 199, 117, 270, 271, 425)),
}
_X32 = 0x40000000  # the calls of x86-64's other numbering begin here
_PERMISSION = 1  # EPERM


def landlock_version() -> int:
    """The version of Landlock that this kernel has; 0: none."""
    if sys.platform != "linux":
        return 0
    found = int(_libc().syscall(_CREATE, None, ctypes.c_size_t(0), ctypes.c_uint32(_VERSION)))
    return max(found, 0)


def in_force() -> dict[str, bool]:
    """What of a child is confined on this machine: ``writing``, ``network``, ``memory``, ``processor``."""
    version, linux = landlock_version(), sys.platform == "linux"
    return {
        "writing": version >= 1,
        "network": version >= 4 or (linux and os.uname().machine in _CALLS),
        "memory": linux,
        "processor": sys.platform != "win32",
    }


def begin(scratch: str, parent: int) -> None:
    """The first act of a child: confined to ``scratch``, it is killed with ``parent`` (0: it looks by itself)."""
    if parent and sys.platform == "linux":
        _libc().prctl(_SET_PDEATHSIG, _SIGKILL, 0, 0, 0)
        if os.getppid() != parent:  # it was killed before this line
            os._exit(1)
    confine(scratch)


def confine(scratch: str | None) -> None:
    """Give up everything but reading, computing, and writing below ``scratch``; what a kernel lacks is left out."""
    limit()
    if sys.platform != "linux":
        return
    _libc().prctl(_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    _landlock(scratch)
    _seccomp()


def limit() -> None:
    """Bound what a process may write, open and compute. POSIX only."""
    try:
        import resource
    except ImportError:  # Windows
        return
    for kind, bound in (
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_FSIZE, MAX_FILE),
        (resource.RLIMIT_NOFILE, MAX_OPEN),
        (resource.RLIMIT_CPU, MAX_CPU),
    ):
        soft, hard = resource.getrlimit(kind)
        least = bound if hard == resource.RLIM_INFINITY else min(bound, hard)
        if soft == resource.RLIM_INFINITY or soft > least:
            resource.setrlimit(kind, (least, hard))


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _landlock(scratch: str | None) -> None:
    version = landlock_version()
    if version < 1:
        return
    rights = _WRITE_FILE | _REMOVE_DIR | _REMOVE_FILE | _MAKE
    rights |= (_REFER if version >= 2 else 0) | (_TRUNCATE if version >= 3 else 0)
    # handled_access_fs, then as the kernel knows them handled_access_net, scoped
    attributes = struct.pack("<QQQ", rights, _TCP if version >= 4 else 0, _SCOPES if version >= 6 else 0)
    size = 8 if version < 4 else 16 if version < 6 else 24
    libc = _libc()
    rules = libc.syscall(_CREATE, attributes, ctypes.c_size_t(size), ctypes.c_uint32(0))
    if rules < 0:
        return
    try:
        places = [("/dev/null", rights & (_WRITE_FILE | _TRUNCATE))]
        if scratch is not None:
            places.append((scratch, rights))
        for path, allowed in places:
            place = os.open(path, os.O_PATH | os.O_CLOEXEC)  # type: ignore[attr-defined,unused-ignore]
            try:
                rule = struct.pack("<Qi", allowed, place)
                libc.syscall(_ADD, ctypes.c_int(rules), ctypes.c_int(_PATH_BENEATH), rule, ctypes.c_uint32(0))
            finally:
                os.close(place)
        libc.syscall(_RESTRICT, ctypes.c_int(rules), ctypes.c_uint32(0))
    finally:
        os.close(rules)


def _seccomp() -> None:
    """Refuse the system calls that make sockets: datagrams, raw and local ones are no matter of Landlock's."""
    known = _CALLS.get(os.uname().machine)
    if known is None:
        return
    machine, calls = known
    load, equal, least, answer = 0x20, 0x15, 0x35, 0x06  # BPF_LD|W|ABS, BPF_JMP|JEQ|K, BPF_JMP|JGE|K, BPF_RET|K
    allow, refuse = 0x7FFF0000, 0x00050000 | _PERMISSION
    # The machine (offset 4 of seccomp_data), else refuse; then the call's number. Jumps count from the next step.
    steps = [(load, 0, 0, 4), (equal, 0, len(calls) + 3, machine), (load, 0, 0, 0), (least, len(calls) + 1, 0, _X32)]
    for position, call in enumerate(calls):
        steps.append((equal, len(calls) - position, 0, call))
    steps += [(answer, 0, 0, allow), (answer, 0, 0, refuse)]
    program = ctypes.create_string_buffer(b"".join(struct.pack("<HBBI", *step) for step in steps))

    class Program(ctypes.Structure):
        _fields_ = (("length", ctypes.c_ushort), ("steps", ctypes.c_void_p))

    whole = Program(len(steps), ctypes.cast(program, ctypes.c_void_p))
    _libc().prctl(_SET_SECCOMP, _FILTER, ctypes.byref(whole), 0, 0)


def main(arguments: Sequence[str]) -> None:
    """``FOLDER PARENT COMMAND…``: confined to the folder, become the command."""
    scratch, parent, *command = arguments
    begin(scratch, int(parent))
    os.environ[KILLED_WITH] = parent if sys.platform == "linux" else "0"
    os.execvp(command[0], command)


if __name__ == "__main__":
    main(sys.argv[1:])
