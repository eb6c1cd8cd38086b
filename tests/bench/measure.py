"""Wall time and peak memory of a whole process."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

#: ru_maxrss counts bytes on macOS, kibibytes elsewhere.
_UNIT = 1 if sys.platform == "darwin" else 1024


@dataclass(frozen=True)
class Cost:
    """What one run of a process took."""

    seconds: float
    peak_mib: float
    #: seconds of the processor
    processor: float = 0.0


def measure(command: Sequence[str], env: Mapping[str, str]) -> Cost:
    """Run ``command`` to its end; raises RuntimeError, with what it printed, where it fails."""
    with tempfile.TemporaryFile() as said:
        start = time.perf_counter()
        process = subprocess.Popen(command, env=dict(env), stdin=subprocess.DEVNULL, stdout=said, stderr=said)
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            said.seek(0)
            text = said.read().decode("utf-8", "replace").strip().splitlines()[-15:]
            raise RuntimeError(f"{' '.join(command)}: status {process.returncode}\n" + "\n".join(text))
    # A process that is started keeps the peak of the one that started it, up to the moment of exec: what is measured is
    # only the child's own where this process is the smaller one.
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if usage.ru_maxrss <= own:
        raise RuntimeError(f"{command[0]} needs less memory than the process that measures it")
    return Cost(seconds, usage.ru_maxrss * _UNIT / 2**20, usage.ru_utime + usage.ru_stime)
