"""PyTorch: a policy's own modules, on request.

State dictionaries that were read as data become the trainer's network of PyTorch's layers (networks.py). A TorchScript
module is loaded by PyTorch itself, which runs its code, and so only where its source is trusted (``--trust-source``).
"""

from msgspec.structs import replace

from export_model.converters.runtimes.packages import package_runtime

RUNTIMES = (replace(package_runtime("torch", "pip install 'export-model[torch]'", ("torch",)), taken_by="name"),)
