"""What the verifications of several policies have in common."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from msgspec import Struct, field

from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import RuntimeInfo
from export_model.exporter.verify.options import VerifyOptions


class Session(Struct, frozen=True):
    """The runtimes that were chosen, all that are known, their processes, how to verify, and who is told of a step."""

    runtimes: Sequence[str]
    known: Sequence[RuntimeInfo]
    pool: RuntimePool
    options: VerifyOptions = field(default_factory=VerifyOptions)
    progress: Callable[[str], None] = lambda text: None
