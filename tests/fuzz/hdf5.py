"""Changes of an HDF5 file: of what its structures say, and of any of its bytes."""

from __future__ import annotations

import re
from random import Random

from tests.fuzz import mutation
from tests.fuzz.changes import Files

#: What the structures of an HDF5 file begin with: super block, B-trees, heaps, object headers and their parts.
_HDF5_SIGNS = (b"\x89HDF", b"TREE", b"HEAP", b"SNOD", b"GCOL", b"OHDR", b"OCHK")


def change_structures(files: Files, random: Random) -> Files:
    """Numbers near the signs of its structures, which say how much comes and where; or any bytes."""
    ((name, data),) = files.items()
    signs = [m.start() for sign in _HDF5_SIGNS for m in re.finditer(re.escape(sign), data)]
    for _ in range(random.choice((1, 1, 2, 3, 6))):
        if random.random() < 0.3:
            data = mutation.damaged(data, random)
            continue
        size = random.choice((1, 2, 4, 8))
        at = min(random.choice(signs) + random.randrange(4, 128), len(data) - size)
        number = mutation.number(random) % (1 << 8 * size)
        data = data[:at] + number.to_bytes(size, "little") + data[at + size :]
    return {name: data}
