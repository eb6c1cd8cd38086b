"""What the consumer that a bundle was made for (``--for``) says to it, by the rules of its own checkers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from exporter.verify.findings import Accepted, Finding
from exporter.verify.tolerances import Tolerance


def consumers(name: str | None, files: Mapping[str, Path], *, memory: bool = False) -> Iterator[Finding]:
    """A finding for each release of ML-Agents that loads what profile ``name`` writes; ``files`` by format.

    It is judged with Deterministic Inference off, the mode that all releases have, and with the agent that the file
    is made for. The checks of releases 1 to 16 are not known; release 20 reads their models too, but for those with a
    ``memory``, which are asked nothing. Raises UsageError where this version has no such profile, DamagedFileError for
    a file that is broken.
    """
    if name is None:
        return
    from converters.consumers.profiles import profile
    from converters.consumers.unity.checker import check_file
    from converters.consumers.unity.consumers import consumer

    wanted = profile(name)
    for release in wanted.checkers:
        for key in (k for k in ("onnx", "nn") if k in files and not (memory and k in wanted.own_names)):
            said = check_file(files[key], consumer(release))
            modes = [m for mode, m in said.modes.items() if mode == "stochastic"]
            thrown = [t.message for t in (said.refused, *(m.load for m in modes)) if t is not None]
            listed = [f.message for m in modes for f in m.checks]
            wrong = [*thrown, *listed, *(f.message for f in said.misread)]
            passed = said.checked["stochastic"] and not said.misread
            yield Accepted(key, release, "*", 0.0, 0.0, Tolerance(0.0, 0.0), passed, None, "; ".join(wrong)[:600])
