"""The command ``serve``. Imports click only; the rest when it runs."""

from __future__ import annotations

from pathlib import Path

import click

from signatures.errors import UsageError

_SCENES = ("auto", "ball3d", "gridworld", "hallway", "tennis", "none")


@click.command("serve")
@click.argument("bundle", type=click.Path(path_type=Path), metavar="BUNDLE")
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option(
    "--port", type=click.IntRange(0, 65535), default=8000, show_default=True, help="Port; 0 takes a free one."
)
@click.option("--open", "opens", is_flag=True, help="Open the page in the browser.")
@click.option(
    "-o", "--out", type=click.Path(path_type=Path), metavar="DIR", help="Write the page for static hosting, and end."
)
@click.option(
    "--scene",
    type=click.Choice(_SCENES),
    default="auto",
    show_default=True,
    help="The environment that is drawn; auto goes by the policy's name, its observations and its actions.",
)
def serve_command(bundle: Path, host: str, port: int, opens: bool, out: Path | None, scene: str) -> None:
    """A page where the policy acts in your browser: its environment if it is a known one, else a panel of sliders."""
    from exporter.serve.site import assemble, write_site

    if out is not None and opens:
        raise UsageError("--out and --open contradict each other", fix="host the folder, and open its address")
    site = assemble(bundle, scene)
    if out is not None:
        write_site(site, out)
        click.echo(f"wrote {out}: {len(site)} files, {sum(map(len, site.values())) / 1e6:.1f} MB")
        click.echo(f"next: host it anywhere, or: python -m http.server --directory {out}")
        return
    from exporter.serve.server import listening, until_interrupted

    with listening(site, host, port) as server, until_interrupted():
        click.echo(f"{server.url}  (Ctrl-C ends)")
        if opens:
            import webbrowser

            webbrowser.open(server.url)
        server.serve_forever()
    click.echo("ended")
