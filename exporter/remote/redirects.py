"""Where a web server may send us on to: nowhere that the address given could not have been meant for.

A public server that answers with ``Location: http://169.254.169.254/…`` (a cloud's own data), or with a name that is
this machine's, would have us read what its owner cannot. So no redirect from an address on the internet is followed to
this machine or its network, and none from https to http. A name whose own address changes between the look and the
request is not seen.
"""

from __future__ import annotations

import ipaddress
from typing import Any

from export_model.signatures.errors import SourceError


async def guarded_client(**settings: Any) -> Any:
    """An aiohttp session for fsspec, whose every redirect is looked at. Runs in fsspec's event loop."""
    import aiohttp

    tracing = aiohttp.TraceConfig()
    tracing.on_request_start.append(_on_request_start)
    tracing.on_request_redirect.append(_sent_on)
    settings.pop("loop", None)
    return aiohttp.ClientSession(trace_configs=[tracing], **settings)


async def _on_request_start(session: Any, context: Any, asked: Any) -> None:
    context.first = asked.url
    context.near = await _is_near(asked.url)


async def _sent_on(session: Any, context: Any, asked: Any) -> None:
    """Raise SourceError where a redirect leads from the internet to here, or out of https."""
    place = asked.response.headers.get("Location") or asked.response.headers.get("URI") or ""
    to = asked.response.url.join(type(asked.response.url)(place))
    if context.first.scheme == "https" and to.scheme != "https":
        raise _redirect_error(to, "what is asked for by https is not taken from elsewhere")
    if not context.near and await _is_near(to):
        raise _redirect_error(to, "it is in this machine's own network, and the address given is not")


def _redirect_error(to: Any, why: str) -> SourceError:
    return SourceError(
        f"the server sends on to {to.scheme}://{to.host}", why=why, fix="give that address itself, if you mean it"
    )


async def _is_near(url: Any) -> bool:
    """Whether a host is this machine, or in a network of its own; one without an address is nowhere."""
    import asyncio
    import socket

    try:
        found = await asyncio.get_running_loop().getaddrinfo(url.host, url.port, type=socket.SOCK_STREAM)
    except OSError:
        return False
    addresses = [str(place[0]).partition("%")[0] for *_, place in found]
    return any(not ipaddress.ip_address(address).is_global for address in addresses)
