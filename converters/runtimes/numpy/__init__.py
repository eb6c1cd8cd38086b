"""The numpy reference: the kernels of the op table in a process of their own."""

from export_model.converters.runtimes.packages import package_runtime

RUNTIMES = (package_runtime("numpy", "pip install export-model", ("numpy",), independent=False),)
