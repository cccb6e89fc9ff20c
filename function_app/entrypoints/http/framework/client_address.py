"""From where a request comes: what too many wrong tries are counted by."""

import ipaddress

from fastapi import Request

_IPV6_NETWORK = 64
"""Who has an IPv6 address has its whole network, 2⁶⁴ of them: they count as one."""


def client_address(request: Request, proxies: int) -> str:
    """The client's address, or empty where nothing tells it.

    Args:
        request: Whose.
        proxies: How many proxies of one's own stand in front. Each adds to ``X-Forwarded-For`` whom it was asked by, so
            the client is the one that the first of them added; what stands left of that is written by the client.
            A host that tells no address of the connection is a proxy itself.
    """
    peer = request.client.host if request.client is not None else ""
    if not peer:
        proxies = max(1, proxies)
    if proxies:
        added = [part for line in request.headers.getlist("x-forwarded-for") for part in line.split(",")]
        return _read(added[-proxies]) if len(added) >= proxies else _read(peer)
    return _read(peer)


def _read(text: str) -> str:
    """An address with or without a port, as one that can be compared; empty for what is none."""
    text = text.strip()
    if text.startswith("["):
        text = text[1:].partition("]")[0]
    elif text.count(":") == 1:
        text = text.partition(":")[0]
    try:
        address = ipaddress.ip_address(text.partition("%")[0])
    except ValueError:
        return ""
    if isinstance(address, ipaddress.IPv6Address):
        if address.ipv4_mapped is not None:
            return str(address.ipv4_mapped)
        return str(ipaddress.ip_network((address, _IPV6_NETWORK), strict=False))
    return str(address)
