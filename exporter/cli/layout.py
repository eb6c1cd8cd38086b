"""The command ``layout``. Imports click only; the rest when it runs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click
from msgspec.structs import replace

from export_model.exporter.cli.group import command
from export_model.exporter.cli.options import reading, understanding
from export_model.exporter.cli.rows import FILE, PATH
from export_model.exporter.cli.terminal import say, say_json, say_lines, say_paragraph
from export_model.signatures.errors import UsageError

if TYPE_CHECKING:
    from export_model.converters.compiler.options import CompileOptions
    from export_model.converters.formats.source import ReadOptions


@command(
    "layout",
    "Tell which number is which, as far as a mirror does.",
    ("export-model layout policy.onnx --robot g1", "what the weights tell"),
    ("export-model layout policy.onnx --check deploy.yaml", "is a file right?"),
    core=("robot", "check", "write", "step", "as_json"),
)
@click.argument("source", type=PATH, metavar="POLICY")
@click.option("--robot", metavar="NAME", help="A known robot (g1, go2 …), a URDF, MJCF or YAML of yours.")
@click.option("--check", type=FILE, metavar="FILE", help="Hold what this file states against the weights.")
@click.option("--write", type=FILE, metavar="FILE", help="Write what is decided, for --interface.")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
@understanding
@reading()
def layout_command(
    source: Path,
    robot: str | None,
    check: Path | None,
    write: Path | None,
    as_json: bool,
    compiling: CompileOptions,
    read: ReadOptions,
) -> None:
    """Tell the order of joints and the stacking of frames of a legged robot's policy from its weights.

    Status 0: decided, or what is stated agrees; 1: another layout fits better by the margin; 3: not decided.
    """
    from export_model.converters.layouts.own_robot import robots_named
    from export_model.exporter.export.sources import read_source
    from export_model.exporter.layout.telling import STATUS, tell_layout
    from export_model.exporter.layout.wording import layout_text, verdict_text
    from export_model.exporter.layout.writing import write_layout
    from export_model.exporter.remote.fetching import nearby

    if check is not None and read.interface is not None:
        raise UsageError("--check and --interface name two files", fix="give one of them")
    if check is not None:
        read = replace(read, interface=str(check))
    robots = robots_named(robot)
    with nearby(source) as here:
        policies = read_source(here, read).policies(compiling)
    if len(policies) != 1:
        names = ", ".join(p.name for p in policies)
        raise UsageError(f"{source} holds {len(policies)} policies", why=names, fix="choose one: --brain NAME")
    told = tell_layout(policies[0], robots)
    if check is not None and told.stated is None:
        raise UsageError(
            f"{check} states no layout that can be tried",
            why="it needs the order of terms that are known, with as many numbers as the policy takes, and the joints",
            fix="name the robot: --robot NAME",
        )
    if write is not None:
        write_layout(told, write)
    if as_json:
        say_json(told.to_dict())
    else:
        say_lines(layout_text(told))
        say_paragraph(verdict_text(told), "layout: ")
        if write is not None:
            say(f"wrote {write}")
    if status := STATUS[told.verdict]:
        sys.exit(status)
