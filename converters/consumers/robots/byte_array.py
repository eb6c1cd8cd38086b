"""A LiteRT file as the C++ source and header that PX4's module for neural networks is built with.

Names: PX4-Autopilot, src/modules/mc_nn_control/control_net.{cpp,hpp}.
"""

from __future__ import annotations

import re

SOURCE, HEADER = "control_net.cpp", "control_net.hpp"
_NAME = "control_net_tflite"
_BYTES = re.compile(_NAME + r"\[\] = \{([^}]*)\}")
_IN_A_LINE = 12


def sources(data: bytes) -> dict[str, bytes]:
    """Return the source and the header of a file, by their names."""
    rows = (data[i : i + _IN_A_LINE] for i in range(0, len(data), _IN_A_LINE))
    lines = "\n".join("\t" + " ".join(f"0x{byte:02x}," for byte in row) for row in rows)
    return {
        SOURCE: f'#include "{HEADER}"\n\nalignas(16) const unsigned char {_NAME}[] = {{\n{lines}\n}};\n'.encode(),
        HEADER: "#pragma once\n\n#include <cstdint>\n\n"
        f"constexpr unsigned int {_NAME}_size = {len(data)};\n"
        f"extern const unsigned char {_NAME}[];\n".encode(),
    }


def bytes_of_array(source: str) -> bytes:
    """Return the bytes that a source has; empty where it has none."""
    found = _BYTES.search(source)
    words = found[1].replace(",", " ").split() if found else []
    return bytes(int(word, 16) for word in words) if all(re.fullmatch("0x[0-9a-f]{2}", w) for w in words) else b""
