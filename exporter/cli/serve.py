"""The command ``serve``. Imports click only; the rest when it runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import click

from export_model.exporter.cli.group import command
from export_model.exporter.cli.options import one_bundle
from export_model.exporter.cli.rows import PATH
from export_model.exporter.cli.terminal import say, say_next
from export_model.signatures.errors import UsageError

_SCENES = ("auto", "ball3d", "crawler2d", "gridworld", "hallway", "tennis", "none")


@command(
    "serve",
    "Open a page on which the policy acts.",
    ("export-model serve exported/3DBall --open", "in your browser"),
    ("export-model serve 3DBall.onnx", "exported for the page"),
    ("export-model serve exported/3DBall -o page.html", "one file, to open or send"),
    ("export-model serve exported/3DBall -o site", "files for any web server"),
    ("export-model serve exported -o gallery", "a page each, and an index"),
)
@click.argument("bundle", type=PATH, metavar="BUNDLE|SOURCE")
@click.option("--host", default="127.0.0.1", help="Address to listen on.")
@click.option("--port", type=click.IntRange(0, 65535), default=8000, help="Port; 0 takes a free one.")
@click.option("--open", "opens", is_flag=True, help="Open the page in the browser.")
@click.option("-o", "--out", type=PATH, metavar="PAGE", help="Write the page and end; NAME.html: one file.")
@click.option(
    "--scene",
    type=click.Choice(_SCENES),
    default="auto",
    help="The environment; auto chooses by name, sizes and actions.",
)
def serve_command(bundle: Path, host: str, port: int, opens: bool, out: Path | None, scene: str) -> None:
    """A page where the policy acts in your browser: its environment if it is a known one, else a panel of sliders."""
    from export_model.converters.formats.bundle.bundle import bundles_in
    from export_model.exporter.serve.site import assemble, assemble_one_file, write_file, write_site

    if out is not None and opens:
        raise UsageError("--out and --open contradict each other", fix="open what is written, or leave --out out")
    many = bundles_in(bundle)
    if len(many) > 1:
        _gallery(many, out, scene, host, port, opens)
        return
    if out is not None and out.suffix.casefold() in (".html", ".htm"):
        with _bundle_of(bundle) as folder:
            page = assemble_one_file(folder, scene)
        write_file(page, out)
        say(f"wrote {out}: one file, {len(page) / 1e3:.0f} kB, which needs no server and no network")
        say_next(f"open {out} in a browser, or send it to somebody")
        return
    with _bundle_of(bundle) as folder:
        site = assemble(folder, scene)
    if out is not None:
        write_site(site, out)
        say(f"wrote {out}: {len(site)} files, {sum(map(len, site.values())) / 1e6:.1f} MB")
        say_next(f"host it anywhere, or: python -m http.server --directory {out}")
        return
    _serve(site, host, port, opens)


def _serve(site: Mapping[str, bytes], host: str, port: int, opens: bool) -> None:
    """Serve until Ctrl-C."""
    from export_model.exporter.serve.server import interrupts, listening

    with listening(site, host, port) as server, interrupts() as told:
        say(f"{server.url}  (Ctrl-C ends)")
        if opens:
            import webbrowser

            webbrowser.open(server.url)
        server.answer_until(told)
    say("ended")


def _gallery(folders: Sequence[Path], out: Path | None, scene: str, host: str, port: int, opens: bool) -> None:
    """The gallery of a folder of bundles, served or written."""
    from export_model.exporter.serve.gallery import assemble_gallery
    from export_model.exporter.serve.site import write_site
    from export_model.exporter.tables import command_text, count_text

    if scene != "auto":
        raise UsageError(f"--scene {scene} goes with a single bundle", fix=command_text("serve", folders[0]))
    if out is not None and out.suffix.casefold() in (".html", ".htm"):
        raise UsageError(
            f"{len(folders)} bundles do not fit into {out}",
            why="a page of one file shows one policy",
            fix=f"choose one: {command_text('serve', folders[0], '-o', out)}, or give a folder: -o gallery",
        )
    gallery = assemble_gallery(folders, whole=out is None)
    for error in gallery.left_out:
        say(f"left out: {error}", err=True)
    if out is None:
        _serve(gallery.files, host, port, opens)
        return
    write_site(gallery.files, out)
    size = sum(map(len, gallery.files.values()))
    say(f"wrote {out}: {count_text(len(gallery.shown), 'page')} and an index, {size / 1e6:.1f} MB")
    say_next(f"host it anywhere, or: python -m http.server --directory {out}")


@contextmanager
def _bundle_of(place: Path) -> Iterator[Path]:
    """The bundle at ``place``; a source is exported into a folder that lasts as long as the context."""
    from export_model.signatures.contract import POLICY  # it loads numpy

    found = one_bundle(place, "serve")
    if (found / POLICY).is_file() or not place.exists():
        yield found
        return
    from export_model.converters.files.folders import scratch_folder
    from export_model.exporter.export.options import ExportOptions
    from export_model.exporter.export.pipeline import export
    from export_model.exporter.serve.site import NEEDED
    from export_model.exporter.tables import command_text

    with scratch_folder() as folder:
        results = list(export([place], ExportOptions(folder, tuple(NEEDED), verify="none")))
        if len(results) > 1:
            raise UsageError(
                f"{place} holds {len(results)} policies",
                why=", ".join(r.policy.name for r in results),
                fix=f"{command_text(place, '-o', 'exported')}    "
                f"(then: {command_text('serve', Path('exported', results[0].policy.name))})",
            )
        say(f"exported for this page only, not verified. To keep it: {command_text(place, '-o', 'exported')}", err=True)
        yield results[0].folder
