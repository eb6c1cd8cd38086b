"""Other machines for C: WebAssembly in Node, and a Cortex-M4 in qemu, which has no clock."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

from msgspec import Struct

from export_model.converters.runtimes.javascript.node import node_executable

HERE = Path(__file__).resolve().parent
WARNINGS = ("-Wall", "-Wextra", "-Wconversion", "-Werror")
CORTEX = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")


class Machine(Struct, frozen=True):
    """``build`` makes of ``main.c`` in a folder what the command runs; ``missing`` says what is not installed."""

    name: str
    missing: Callable[[], str]
    build: Callable[[Path], list[str]]


def _lacks_wasm() -> str:
    here = shutil.which("clang") and shutil.which("wasm-ld") and Path("/usr/lib/wasm32-wasi/libc.a").is_file()
    need = "apt-get install clang lld wasi-libc libclang-rt-14-dev-wasm32"
    return "" if here and node_executable() else f"clang for wasm32, or Node, is not installed: {need}"


def _build_wasm(folder: Path) -> list[str]:
    flags = ("--target=wasm32-wasi", "--sysroot=/usr", "-std=c99", "-O2", *WARNINGS)
    subprocess.run(["clang", *flags, "-o", "main.wasm", "main.c", "-lm"], check=True, cwd=folder)
    return [str(node_executable()), "--no-warnings", str(HERE / "wasi.mjs"), str(folder / "main.wasm")]


def _lacks_cortex() -> str:
    here = shutil.which("arm-none-eabi-gcc") and shutil.which("qemu-system-arm")
    need = "apt-get install gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm"
    return "" if here else f"a compiler for, or an emulator of, a Cortex-M4 is not installed: {need}"


def _build_cortex(folder: Path) -> list[str]:
    flags = ("-std=c99", "-O2", *WARNINGS, "-ffunction-sections", "-fdata-sections", "-Wl,--gc-sections")
    link = ("-nostartfiles", "-T", str(HERE / "cortex_m4.ld"), "--specs=rdimon.specs", str(HERE / "start.c"))
    subprocess.run(
        ["arm-none-eabi-gcc", *CORTEX, *flags, *link, "-o", "main.elf", "main.c", "-lm"], check=True, cwd=folder
    )
    board = ("-M", "mps2-an386", "-nographic", "-monitor", "none", "-serial", "none")
    return [
        "qemu-system-arm",
        *board,
        "-semihosting-config",
        "enable=on,target=native",
        "-kernel",
        str(folder / "main.elf"),
    ]


MACHINES = (Machine("wasm32", _lacks_wasm, _build_wasm), Machine("Cortex-M4", _lacks_cortex, _build_cortex))


def flash_and_ram(folder: Path, source: str) -> tuple[int, int]:
    """Bytes of code and constants, and of variables, of a program on a Cortex-M4, without newlib's own of an empty one.

    No start-up code, no stack.
    """

    def size(text: str) -> tuple[int, int]:
        (folder / "arm.c").write_text(text)
        flags = ("-std=c99", "-O2", "-ffunction-sections", "-fdata-sections", "-Wl,--gc-sections")
        specs = ("--specs=nosys.specs", "--specs=nano.specs")
        command = ["arm-none-eabi-gcc", *CORTEX, *flags, *specs, "-o", "arm.elf", "arm.c", "-lm"]
        subprocess.run(command, check=True, cwd=folder, capture_output=True)
        done = subprocess.run(["arm-none-eabi-size", "arm.elf"], check=True, capture_output=True, text=True, cwd=folder)
        code, data, zeros = map(int, done.stdout.splitlines()[1].split()[:3])
        return code + data, data + zeros

    whole, empty = size(source), size("int main(void) { return 0; }")
    return whole[0] - empty[0], whole[1] - empty[1]
