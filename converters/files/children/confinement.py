"""What a runtime's process may do: read what it needs, compute, and write to a folder of its own.

A model file decides what a runtime computes, and runtimes have had faults. So a child gives up, before it has seen a
model, what it does not need: files are not written outside a scratch folder, nor read outside the places that it was
told (environment.py), TCP is neither listened on nor called (Landlock, security/landlock.rst of the kernel's
documentation); no socket of any other kind is made, no process started, no mode, owner, time or attribute of a file
changed, and nothing shared with other processes (seccomp); no core is dumped, files and their number are bounded, for
good; root's capabilities go. Memory is bounded while a request runs (process.py), because what is fair depends on it.
All of it is Linux; elsewhere, and where a kernel lacks a part, that part is not in force, and ``export-model runtimes``
says so. A part that the kernel has and refuses ends the process.

A child in Python calls ``begin`` before anything else. For others this file is a program:
``python confinement.py FOLDER PARENT COMMAND…`` gives up the same and becomes the
command. It imports the standard library only.
"""

from __future__ import annotations

import ctypes
import errno
import os
import stat
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
#: The variable that lists what a child may read, a path a line; of a folder that ends in ``/``, the names alone.
READABLE = "EXPORT_MODEL_READABLE"

# landlock.h: system calls (the same on all machines since they are new), rights, rules.
_CREATE, _ADD, _RESTRICT = 444, 445, 446
_VERSION = 1
_PATH_BENEATH = 1
_WRITE_FILE, _READ_FILE, _READ_DIR, _REMOVE_DIR, _REMOVE_FILE = 1 << 1, 1 << 2, 1 << 3, 1 << 4, 1 << 5
_MAKE = sum(1 << bit for bit in range(6, 13))  # char, dir, reg, sock, fifo, block, sym
_DEVICES = 1 << 6 | 1 << 11
_REFER, _TRUNCATE, _IOCTL = 1 << 13, 1 << 14, 1 << 15
_TCP = 0b11  # bind, connect
_SCOPES = 0b11  # abstract sockets, signals
_SET_NO_NEW_PRIVS, _SET_SECCOMP, _FILTER = 38, 22, 2
_SET_PDEATHSIG, _SIGKILL = 1, 9
# capability.h: root reads files of mode 600 (Landlock says which); its other capabilities go.
_DROP_CAPABILITY, _AMBIENT, _CLEAR_ALL, _CAPABILITIES_3 = 24, 47, 4, 0x20080522
_READ_SEARCH = 2

#: What is refused → the numbers of its system calls on x86-64 and on AArch64 (asm/unistd.h of Linux 6.12).
_REFUSED: dict[str, tuple[tuple[int, ...], tuple[int, ...]]] = {
    # socket, socketpair, io_uring_setup (which makes sockets, too)
    "sockets": ((41, 53, 425), (198, 199, 425)),
    # ptrace, process_vm_readv, process_vm_writev, kcmp, pidfd_getfd, process_madvise, perf_event_open
    "other processes": ((101, 310, 311, 312, 438, 440, 298), (117, 270, 271, 272, 438, 440, 241)),
    # fork, vfork (AArch64 has clone alone)
    "processes": ((57, 58), ()),
    # chmod, fchmod, fchmodat, fchmodat2
    "modes": ((90, 91, 268, 452), (52, 53, 452)),
    # chown, fchown, lchown, fchownat
    "owners": ((92, 93, 94, 260), (54, 55)),
    # utime, utimes, futimesat, utimensat
    "times": ((132, 235, 261, 280), (88,)),
    # setxattr, lsetxattr, fsetxattr, removexattr, lremovexattr, fremovexattr, setxattrat, removexattrat
    "attributes": ((188, 189, 190, 197, 198, 199, 463, 466), (5, 6, 7, 14, 15, 16, 463, 466)),
    # setrlimit, setpriority, ioprio_set, sched_setparam, sched_setscheduler, sched_setaffinity, sched_setattr
    "limits and priorities": ((160, 141, 251, 142, 144, 203, 314), (164, 140, 30, 118, 119, 122, 274)),
    # shmget, shmat, shmctl, semget, semop, semctl, semtimedop, msgget, msgsnd, msgrcv, msgctl, mq_open, mq_unlink
    "what is shared": (
        (29, 30, 31, 64, 65, 66, 220, 68, 69, 70, 71, 240, 241),
        (194, 196, 195, 190, 193, 191, 192, 186, 189, 188, 187, 180, 181),
    ),
    # acct, settimeofday, clock_settime, adjtimex, clock_adjtime, reboot, sethostname, setdomainname, swapon, swapoff,
    # init_module, finit_module, delete_module, kexec_load, kexec_file_load, quotactl, syslog, vhangup, iopl, ioperm,
    # open_by_handle_at (which asks for no path, and so for no rule of Landlock)
    "the machine": (
        (163, 164, 227, 159, 305, 169, 170, 171, 167, 168, 175, 313, 176, 246, 320, 179, 103, 153, 172, 173, 304),
        (89, 170, 112, 171, 266, 142, 161, 162, 224, 225, 105, 273, 106, 104, 294, 60, 116, 58, 265),
    ),
    # add_key, request_key, keyctl
    "keyrings": ((248, 249, 250), (217, 218, 219)),
    # unshare, setns, mount, umount2, pivot_root, chroot, open_tree, move_mount, fsopen, fsmount, mount_setattr, bpf,
    # userfaultfd
    "namespaces": (
        (272, 308, 165, 166, 155, 161, 428, 429, 430, 432, 442, 321, 323),
        (97, 268, 40, 39, 41, 51, 428, 429, 430, 432, 442, 280, 282),
    ),
}
#: clone, clone3, prlimit64, ioctl.
_ASKED = ((56, 435, 302, 16), (220, 435, 261, 29))
#: What is not asked of a device or file: TIOCSTI, TIOCLINUX, FS_IOC_SETFLAGS (of 32 bits, too), FS_IOC_FSSETXATTR.
_IOCTLS = (0x5412, 0x541C, 0x40086602, 0x40046602, 0x401C5820)
#: Machine → (its number in audit.h, its place in the rows above).
_MACHINES = {"x86_64": (0xC000003E, 0), "aarch64": (0xC00000B7, 1)}
_THREAD = 0x10000  # CLONE_THREAD
_NO_SUCH_CALL = 38  # ENOSYS, at which the C library asks for clone in the place of clone3
_X32 = 0x40000000  # the calls of x86-64's other numbering begin here
_PERMISSION = 1  # EPERM
_ALLOW, _ERROR = 0x7FFF0000, 0x00050000  # SECCOMP_RET_ALLOW, SECCOMP_RET_ERRNO


#: What this process may read, since it was confined.
_readable: list[str] = []


def landlock_version() -> int:
    """The version of Landlock that this kernel has; 0: none."""
    if sys.platform != "linux":
        return 0
    found = int(_libc().syscall(_CREATE, None, ctypes.c_size_t(0), ctypes.c_uint32(_VERSION)))
    return max(found, 0)


def in_force() -> dict[str, bool]:
    """Which parts of a child's confinement this machine has, by their names."""
    landlock, linux = landlock_version() >= 1, sys.platform == "linux"
    return {
        "reading": landlock,
        "writing": landlock,
        "network": linux and _has_filters(),
        "memory": linux,
        "processor": sys.platform != "win32",
    }


def _has_filters() -> bool:
    """Whether the kernel takes a seccomp filter: it finds fault with none at all, but not with being asked."""
    refused = _libc().prctl(_SET_SECCOMP, _FILTER, None, 0, 0) != 0 and ctypes.get_errno() == errno.EFAULT
    return refused and os.uname().machine in _MACHINES


def begin(scratch: str, parent: int) -> None:
    """The first act of a child: confined to ``scratch``, it is killed with ``parent`` (0: it looks by itself)."""
    if parent:
        end_with(parent)
    confine(scratch)


def end_with(parent: int) -> None:
    """Let the kernel kill this process when its parent ends; end now where it has ended. Linux only."""
    if sys.platform == "linux":
        _libc().prctl(_SET_PDEATHSIG, _SIGKILL, 0, 0, 0)
        if os.getppid() != parent:  # it was killed before this line
            os._exit(1)


def confine(scratch: str | None, *, starts: bool = False) -> None:
    """Give up everything but computing, reading what ``READABLE`` lists, and writing below ``scratch``.

    What a kernel lacks is left out. ``starts``: it starts programs, each of which is to give up the rest
    (``confine_started``). Raises OSError where the kernel has a part and refuses it.
    """
    _readable[:] = [place for place in os.environ.pop(READABLE, "").split("\n") if place]
    limit()
    if sys.platform != "linux":
        return
    _libc().prctl(_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    _landlock(scratch, [*_readable, "/proc" if starts else "/proc/self"])
    _drop_capabilities()
    if not starts:
        refuse_calls()


def confine_started(scratch: str, *, starts: bool) -> None:
    """What a process of one that ``starts`` gives up besides: others' /proc, system calls. Raises OSError."""
    if sys.platform == "linux":
        _landlock(scratch, [*_readable, "/proc/self"])
    refuse_calls(starts=starts)


def limit() -> None:
    """Bound what a process may write, open and compute, for good. POSIX only."""
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
        soft, hard = (bound if n == resource.RLIM_INFINITY else min(n, bound) for n in resource.getrlimit(kind))
        resource.setrlimit(kind, (soft, hard))


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _landlock(scratch: str | None, readable: Sequence[str]) -> None:
    version = landlock_version()
    if version < 1:
        return
    reads, writes = _READ_FILE | _READ_DIR, _WRITE_FILE | _REMOVE_DIR | _REMOVE_FILE | _MAKE
    writes |= (_REFER if version >= 2 else 0) | (_TRUNCATE if version >= 3 else 0)
    handled = reads | writes | (_IOCTL if version >= 5 else 0)
    # handled_access_fs, then as the kernel knows them handled_access_net, scoped
    attributes = struct.pack("<QQQ", handled, _TCP if version >= 4 else 0, _SCOPES if version >= 6 else 0)
    size = 8 if version < 4 else 16 if version < 6 else 24
    libc = _libc()
    rules = _must(libc.syscall(_CREATE, attributes, ctypes.c_size_t(size), ctypes.c_uint32(0)))
    try:
        places = [("/dev/null", _READ_FILE | writes & (_WRITE_FILE | _TRUNCATE))]
        places += [(place, _READ_DIR if place.endswith("/") else reads) for place in readable]
        if scratch is not None:
            places.append((scratch, reads | writes & ~_DEVICES))
        for path, allowed in places:
            try:
                place = os.open(path, os.O_PATH | os.O_CLOEXEC)  # type: ignore[attr-defined,unused-ignore]
            except OSError:  # another system has other places
                continue
            try:
                if not stat.S_ISDIR(os.fstat(place).st_mode):
                    allowed &= ~_READ_DIR
                rule = struct.pack("<Qi", allowed, place)
                _must(libc.syscall(_ADD, ctypes.c_int(rules), ctypes.c_int(_PATH_BENEATH), rule, ctypes.c_uint32(0)))
            finally:
                os.close(place)
        _must(libc.syscall(_RESTRICT, ctypes.c_int(rules), ctypes.c_uint32(0)))
    finally:
        os.close(rules)


def _must(result: int) -> int:
    """The result of a system call that must not fail. Raises OSError."""
    if result < 0:
        raise OSError(ctypes.get_errno(), f"this process cannot be confined: {os.strerror(ctypes.get_errno())}")
    return result


def _drop_capabilities() -> None:
    """Leave root, for good, no more than a user may do who can read all files."""
    libc = _libc()
    for number in range(64):  # up to the last that the kernel knows; a user may drop none, and has none
        if number != _READ_SEARCH and libc.prctl(_DROP_CAPABILITY, number, 0, 0, 0) != 0:
            break
    libc.prctl(_AMBIENT, _CLEAR_ALL, 0, 0, 0)
    head, sets = struct.pack("<Ii", _CAPABILITIES_3, 0), ctypes.create_string_buffer(24)
    _must(libc.capget(head, sets))
    held = struct.unpack("<6I", sets.raw)[1] & 1 << _READ_SEARCH
    _must(libc.capset(head, struct.pack("<2I16x", held, held)))


def refuse_calls(*, starts: bool = False) -> None:
    """Refuse the system calls of ``_REFUSED``, and to start processes or to set limits; threads go on.

    ``starts``: a compiler, which may start processes; they give up the same. Raises OSError.
    """
    if sys.platform != "linux" or not _has_filters():
        return
    machine, column = _MACHINES[os.uname().machine]
    refused = [n for what, row in _REFUSED.items() if not (starts and what == "processes") for n in row[column]]
    program = _program(machine, refused, _ASKED[column], starts=starts)
    _libc().prctl(_SET_NO_NEW_PRIVS, 1, 0, 0, 0)  # without which only root may
    steps = ctypes.create_string_buffer(program)

    class Program(ctypes.Structure):
        _fields_ = (("length", ctypes.c_ushort), ("steps", ctypes.c_void_p))

    whole = Program(len(program) // _STEP.size, ctypes.cast(steps, ctypes.c_void_p))
    _must(_libc().prctl(_SET_SECCOMP, _FILTER, ctypes.byref(whole), 0, 0))


#: sock_filter of linux/filter.h: the instruction, how many steps to jump where it is so and where not, the operand.
_STEP = struct.Struct("<HBBI")
_Step = tuple[int, int | str, int | str, int]
_LOAD, _IF_EQUAL, _IF_LEAST, _IF_ANY, _ANSWER = 0x20, 0x15, 0x35, 0x45, 0x06


def _program(machine: int, refused: Sequence[int], asked: tuple[int, int, int, int], *, starts: bool) -> bytes:
    """The filter: seccomp_data has the call's number at 0, the machine at 4, its arguments from 16 on, 8 bytes each."""
    clone, clone3, prlimit, ioctl = asked
    end: list[tuple[str, _Step]] = [  # what the jumps lead to, by name
        ("clone", (_LOAD, 0, 0, 16)),
        ("", (_IF_ANY, "allow", "refuse", _THREAD)),
        ("prlimit", (_LOAD, 0, 0, 32)),  # the new limit: where it is no pointer, limits are read
        ("", (_IF_EQUAL, 0, "refuse", 0)),
        ("", (_LOAD, 0, 0, 36)),
        ("", (_IF_EQUAL, "allow", "refuse", 0)),
        ("ioctl", (_LOAD, 0, 0, 24)),
        *(("", (_IF_EQUAL, "refuse", 0, request)) for request in _IOCTLS),
        ("", (_IF_EQUAL, "allow", "allow", 0)),
        ("absent", (_ANSWER, 0, 0, _ERROR | _NO_SUCH_CALL)),
        ("allow", (_ANSWER, 0, 0, _ALLOW)),
        ("refuse", (_ANSWER, 0, 0, _ERROR | _PERMISSION)),
    ]
    start: list[tuple[str, _Step]] = [
        ("", (_LOAD, 0, 0, 4)),
        ("", (_IF_EQUAL, 0, "refuse", machine)),
        ("", (_LOAD, 0, 0, 0)),
        ("", (_IF_LEAST, "refuse", 0, _X32)),
        *(("", (_IF_EQUAL, "refuse", 0, call)) for call in refused),
        ("", (_IF_EQUAL, "allow" if starts else "clone", 0, clone)),
        ("", (_IF_EQUAL, "absent", 0, clone3)),
        ("", (_IF_EQUAL, "ioctl", 0, ioctl)),
        ("", (_IF_EQUAL, "prlimit", "allow", prlimit)),
    ]
    steps = [*start, *end]
    places = {name: at for at, (name, _) in enumerate(steps) if name}

    def jump(to: int | str, at: int) -> int:
        return to if isinstance(to, int) else places[to] - at - 1

    return b"".join(
        _STEP.pack(code, jump(yes, at), jump(no, at), operand) for at, (_, (code, yes, no, operand)) in enumerate(steps)
    )


def main(arguments: Sequence[str]) -> None:
    """``FOLDER PARENT COMMAND…``: confined to the folder, become the command."""
    scratch, parent, *command = arguments
    begin(scratch, int(parent))
    os.environ[KILLED_WITH] = parent if sys.platform == "linux" else "0"
    os.execvp(command[0], command)


if __name__ == "__main__":
    main(sys.argv[1:])
