"""How much memory a child may take for a request: what it has when it is ready, and so much for every byte it is given.

A graph of a few bytes can ask for any amount (a Fill of 2³¹ elements). What bounds a child is RLIMIT_DATA, all that is
writable and its own; address space says nothing of TensorFlow or V8, which reserve far more than they use. It is set
from outside (prlimit), so that it holds for every runtime. Linux only: elsewhere nothing is bounded.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

#: Bytes that a child may take beside what it has when it is ready; and threads have stacks and pools, per processor.
FREE = 768 << 20
_PER_PROCESSOR = 16 << 20
#: Bytes that it may take for each byte of its models, and for each that it is fed in a request. TensorFlow 2.21 takes
#: 26 for a SavedModel of 200 MB with two signatures (each has copies of all constants), and dies where it gets fewer.
PER_MODEL_BYTE = 32
PER_FED_BYTE = 64


class ChildMemory:
    """The bound of one child that is ready."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._base = _data(pid)
        #: Bytes of the models that it has, and the most that it had at once: what it freed it may keep for the next.
        self._models = self._most = 0
        self._set = 0

    def allow(self, model: int) -> None:
        """Count a model of that many bytes, which is going to be loaded."""
        self._models += model
        self._most = max(self._most, self._models)

    def release(self, model: int) -> None:
        """Count a model no more, which was unloaded, or never loaded."""
        self._models -= model

    def allow_for_request(self, fed: int) -> None:
        """Bound what the child has, for a request that feeds it that many bytes."""
        if self._base is None:
            return
        bound = self._base + FREE + _PER_PROCESSOR * (os.cpu_count() or 1)
        bound += PER_MODEL_BYTE * self._most + PER_FED_BYTE * fed
        if bound != self._set:
            self._set = bound
            _limit(self.pid, bound)


def _data(pid: int) -> int | None:
    """What a process has that is writable and its own, in bytes; None where the system does not say."""
    if sys.platform != "linux":
        return None
    try:
        status = Path(f"/proc/{pid}/status").read_text(encoding="ascii", errors="replace")
    except OSError:  # it has ended
        return None
    found = [line.split()[1] for line in status.splitlines() if line.startswith("VmData:")]
    return int(found[0]) << 10 if found else None


def _limit(pid: int, bound: int) -> None:
    if sys.platform != "linux":
        return
    import resource

    try:
        _, hard = resource.prlimit(pid, resource.RLIMIT_DATA)
        least = bound if hard == resource.RLIM_INFINITY else min(bound, hard)
        resource.prlimit(pid, resource.RLIMIT_DATA, (least, hard))
    except (OSError, ValueError):  # it has ended, or a container forbids it
        return
