"""The client address, for rate limits and the audit log."""

import ipaddress

from fastapi import Request

_IPV6_NETWORK = 64
"""A client controls its whole IPv6 network of 2⁶⁴ addresses: they count as one."""


def client_address(request: Request, proxies: int) -> str:
    """The client's address; empty if unknown.

    Each of the operator's ``proxies`` appends the address of its client to ``X-Forwarded-For``. Earlier entries
    come from the client and are not trusted. A host that does not state the address of the connection is a proxy.
    """
    peer = request.client.host if request.client is not None else ""
    if not peer:
        proxies = max(1, proxies)
    added = [part for line in request.headers.getlist("x-forwarded-for") for part in line.split(",")]
    return _normalize(added[-proxies] if 0 < proxies <= len(added) else peer)


def _normalize(text: str) -> str:
    """The address without a port, in a form that can be compared; empty for an invalid address."""
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
