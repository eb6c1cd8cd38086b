"""LiteRT: with XNNPACK, as it comes and as phones run it, and with its own kernels alone, as boards do."""

from functools import partial

from msgspec.structs import replace

from export_model.converters.runtimes.packages import package_runtime

DISTRIBUTIONS = ("ai-edge-litert", "ai-edge-litert-nightly")
_litert = partial(
    package_runtime,
    how="pip install 'export-model[litert]'",
    distributions=DISTRIBUTIONS,
    package="ai_edge_litert",
)
_BOTH = (_litert("litert"), _litert("litert-plain", child=("litert", "plain")))
RUNTIMES = tuple(replace(runtime, arithmetic="phone") for runtime in _BOTH)
