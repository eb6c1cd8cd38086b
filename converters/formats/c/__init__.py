"""C: one header that needs no runtime, for microcontrollers, engines and robots."""

from __future__ import annotations

from typing import TYPE_CHECKING

from converters.formats.format import Format, defer_imports

if TYPE_CHECKING:
    from converters.formats.c import artifact as _artifact
    from converters.formats.c import contract as _contract
    from converters.formats.c import writer as _writer
else:
    _artifact, _contract, _writer = defer_imports(__name__, "artifact", "contract", "writer")

FORMATS = (
    Format(
        key="c",
        label="a C header",
        write=_writer.write,
        main="{name}.h",
        held=_artifact.held,
        ports=_artifact.ports,
        vetted=_artifact.vetted,
        answers=_contract.answers,
        runtimes=("c",),
        program=True,
    ),
)
