"""The functions under each of their hosts, as separate programs with one interface.

with start_host("lambda", {"TELESCOPE_HOME": str(home)}) as host:
    httpx.get(f"{host.url}/api/v1/health")
    host.tick()
    host.deliver("ts/v1/…/ack", payload)
"""

import contextlib
from collections.abc import Callable, Mapping
from typing import Literal

from tests.harness.hosts.aws import start_lambda
from tests.harness.hosts.azure import start_azure
from tests.harness.hosts.host import Host, HostFailed
from tests.harness.hosts.uvicorn import start_uvicorn

HostKind = Literal["uvicorn", "azure", "lambda"]
HOSTS: tuple[HostKind, ...] = ("uvicorn", "azure", "lambda")

__all__ = ["HOSTS", "Host", "HostFailed", "HostKind", "start_host"]

_START: dict[HostKind, Callable[[Mapping[str, str]], contextlib.AbstractContextManager[Host]]] = {
    "uvicorn": start_uvicorn,
    "azure": start_azure,
    "lambda": start_lambda,
}


def start_host(kind: HostKind, environment: Mapping[str, str]) -> contextlib.AbstractContextManager[Host]:
    """Start the functions under this host with these settings (``TELESCOPE_…``, ``AWS_…``)."""
    return _START[kind](environment)
