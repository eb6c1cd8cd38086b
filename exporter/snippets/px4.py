"""What PX4 is built with for a policy made for it (``--for px4``); read, not built here.

Source: PX4-Autopilot, src/modules/mc_nn_control (CMakeLists.txt, mc_nn_control.cpp).
"""

from __future__ import annotations

from export_model.exporter.snippets.contract import SnippetBundle

_NAMES = ("control_net.cpp", "control_net.hpp")


def px4(bundle: SnippetBundle) -> str:
    """The commands, for a shell; a line that says how to get the files where it was made for another consumer."""
    if bundle.made_for != "px4":
        return f"# {bundle.name}.tflite has other sizes than mc_nn_control takes: export-model SOURCE --for px4\n"
    files = " ".join(bundle.path(name) for name in _NAMES)
    return f"""\
# From the folder that PX4-Autopilot lies in; the names of boards: src/modules/mc_nn_control/setup/boards.
cp {files} PX4-Autopilot/src/modules/mc_nn_control/
make -C PX4-Autopilot px4_fmu-v6c_neural
"""
