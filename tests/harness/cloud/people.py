"""People who use the functions of any host over HTTP."""

import asyncio
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx

from function_app import bootstrap, settings
from tests.harness.cloud.cloud import API, Person
from tests.harness.cloud.polling import Site
from tests.harness.hosts import Host


class Visitor(Person):
    """``Person`` over real sockets."""

    def __init__(self, site: Site, signed_in: dict[str, Any]) -> None:
        self.site = site
        self.token: str = signed_in["access_token"]
        self.account: str = signed_in["account"]["id"]
        self.name: str = signed_in["account"]["name"]
        self.session: str = signed_in["session"]
        self.page = {"cookie": signed_in.get("cookie", ""), "csrf_token": signed_in["csrf_token"]}

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        headers = {"Authorization": f"Bearer {self.token}", **options.pop("headers", {})}
        return self.site.request(method, API + path, headers=headers, **options)


def sign_in_link(environment: Mapping[str, str], name: str) -> str:
    """Create a one-time sign-in token in the store of these functions."""
    (token,) = sign_in_links(environment, name)
    return token


def sign_in_links(environment: Mapping[str, str], *names: str) -> list[str]:
    """Create one-time sign-in tokens in this process; ``make link`` would start a program for each."""

    async def create() -> list[str]:
        functions = bootstrap.build(settings.read({**os.environ, **environment}))
        try:
            return [await functions.sign_in.link(await functions.sign_in.account(name)) for name in names]
        finally:
            await functions.close()

    with ThreadPoolExecutor(1) as pool:  # Playwright runs an event loop in this thread
        return pool.submit(asyncio.run, create()).result()


def sign_in(host: Host, site: Site, home: Path, name: str, environment: Mapping[str, str] | None = None) -> Visitor:
    """Returns a person in a new sign-in session at this host."""
    link = sign_in_link({"TELESCOPE_HOME": str(home), **(environment or {})}, name)
    answer = site.request("POST", f"{API}/auth/sign-in", json={"link": link})
    assert answer.status_code == 200, f"{host.url}: {answer.text}"
    return Visitor(site, {**answer.json(), "cookie": answer.headers["set-cookie"].partition(";")[0]})
