"""How long a child may compute what anyone's file asks of it first: to load it, and to answer one input.

A graph of a few bytes can loop for ever, and which does cannot be told from its bytes. So it is given little processor
time until it has answered once; after that ``TIMEOUT`` (process.py) alone bounds it. Processor time says the same on a
busy machine as on a quiet one. Linux only: elsewhere nothing but ``TIMEOUT`` ends it.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

#: Seconds of processor time, and so many more for each byte of the model (a million bytes take milliseconds).
FIRST = 8.0
PER_BYTE = 1 / (4 << 20)


def time_limit(size: int) -> float:
    """Seconds of processor time for a model of ``size`` bytes."""
    return FIRST + size * PER_BYTE


def processor_time(pid: int) -> float | None:
    """Seconds of processor time that a process has taken, all its threads; None where the system does not say."""
    if sys.platform != "linux":
        return None
    try:
        # The name, in brackets, may hold anything; utime and stime are the 12th and 13th field behind it (proc(5)).
        fields = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()
    except OSError:  # it has ended
        return None
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
