"""How a source is read, a row for each option: commands, help, reports that repeat themselves are made of the rows.

Imports click only. The keyword of the same name is a field of ``ReadOptions`` (exporter/options.py).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import click

#: What options and arguments take that are paths: of any kind, of a file.
PATH, FILE = click.Path(path_type=Path), click.Path(path_type=Path, dir_okay=False)


class Row(NamedTuple):
    """An option: its parameter, its flag, its line of help, and what it takes.

    ``reader``: a format's reader takes it, else the compiler. Those for ``both`` sides of a comparison are given once.
    """

    name: str
    flag: str
    help: str
    metavar: str | None = None
    type: Any = None
    reader: bool = True
    multiple: bool = False
    both: bool = False

    def option(self, prefix: str = "") -> Callable[[Callable[..., Any]], Callable[..., Any]]:
        """Return click's decorator; with ``candidate_`` before its name, for the candidates of a comparison."""
        flag = f"--{prefix.replace('_', '-')}{self.flag.removeprefix('--')}"
        said = f"{self.flag}, for the candidates." if prefix else self.help
        if self.metavar is None:
            return click.option(flag, f"{prefix}{self.name}", is_flag=True, help=said)
        name, kind, many = f"{prefix}{self.name}", self.type, self.multiple
        return click.option(flag, name, type=kind, multiple=many, metavar=self.metavar, help=said)


#: In the order of the help.
READING = (
    Row("step", "--step", "The checkpoint of this step (default: the newest).", "N", int),
    Row("brain", "--brain", "Only this brain of a graph that holds several.", "NAME", reader=False),
    Row("inputs", "--input", "Say what an input is for.", "N=ROLE", reader=False, multiple=True),
    Row("outputs", "--output", "Say what an output is.", "N=ROLE", reader=False, multiple=True),
    Row("values", "--set", "Give a placeholder a fixed value.", "N=VALUE", reader=False, multiple=True),
    Row("sensors", "--sensors", "What the agent of a .pt observes: 8,20x4,3x84x84.", "SHAPE,..."),
    Row("activation", "--activation", "Activation between the layers of a bare .pt: elu, tanh, …", "NAME"),
    Row("script", "--script", "Script that saved a bare .pt: ppo-pytorch-continuous, …", "NAME"),
    Row("repair", "--repair", "Mend an exporter's fault: gru-reset, antialias, …", "NAME"),
    Row("normaliser", "--normaliser", "Statistics of a .zip: vecnormalize.pkl, if not next to it.", "FILE", FILE),
    Row(
        "interface",
        "--interface",
        "YAML with the interface, or none (default: the one beside).",
        "FILE",
        FILE,
    ),
    Row("trust_source", "--trust-source", "Let Keras or PyTorch load a file whole: its code can run.", both=True),
)
#: What stands before an option that is for the candidates of a comparison, not for the reference.
CANDIDATE = "candidate_"
