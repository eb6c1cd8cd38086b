"""LiteRT: with XNNPACK, as it comes and as phones run it, and with its own kernels alone, as boards do."""

from functools import partial

from converters.runtimes.packages import package_runtime

DISTRIBUTIONS = ("ai-edge-litert", "ai-edge-litert-nightly")
_litert = partial(
    package_runtime,
    how="pip install 'export-model[litert]'",
    distributions=DISTRIBUTIONS,
    package="ai_edge_litert",
)
RUNTIMES = (_litert("litert"), _litert("litert-plain", child=("litert", "plain")))
