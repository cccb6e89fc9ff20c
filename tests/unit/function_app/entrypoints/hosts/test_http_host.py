"""Names under which the server accepts requests."""

import asyncio

import httpx
import pytest
from starlette.responses import Response

from function_app.entrypoints.hosts.http_host import AllowedHosts
from function_app.entrypoints.hosts.uvicorn import allowed_hosts
from function_app.settings import read

ALL = "0.0.0.0"  # noqa: S104 (a setting)


@pytest.mark.parametrize(
    ("settings", "host", "accepted"),
    [
        ({}, "127.0.0.1:8080", True),
        ({}, "LocalHost", True),
        ({}, "[::1]:8080", True),
        ({}, "attacker.example", False),
        ({}, "192.0.2.1:8080", False),
        ({}, "127.0.0.1.attacker.example", False),
        ({}, "", False),
        ({}, "[", False),
        ({}, "a b", False),
        ({"TELESCOPE_HOST": "192.0.2.1"}, "192.0.2.1:8080", True),
        ({"TELESCOPE_HOST": ALL}, "192.0.2.1:8080", True),
        ({"TELESCOPE_HOST": ALL}, "attacker.example", False),
        ({"TELESCOPE_PUBLIC_URL": "https://robots.example:8443/"}, "robots.example:8443", True),
        ({"TELESCOPE_ALLOWED_HOSTS": "One.example, two.example"}, "one.example", True),
        ({"TELESCOPE_ALLOWED_HOSTS": "one.example"}, "sub.one.example", False),
    ],
)
def test_only_configured_names_are_accepted(settings: dict[str, str], host: str, accepted: bool) -> None:
    app = AllowedHosts(Response("ok"), names=allowed_hosts(read(settings)))

    async def status() -> int:
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://x") as client:
            return (await client.get("/", headers={"Host": host})).status_code

    assert asyncio.run(status()) == (200 if accepted else 400)
