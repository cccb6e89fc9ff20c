"""People who use the functions over HTTP, wherever they run."""

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import httpx

from tests.support.brokers import ROOT
from tests.support.cloud import API, Person
from tests.support.hosts import Host
from tests.support.polling import Site


class Visitor(Person):
    """As ``Person``, over real sockets."""

    def __init__(self, site: Site, signed_in: dict[str, Any]) -> None:
        self.site = site
        self.token: str = signed_in["access_token"]
        self.account: str = signed_in["account"]["id"]
        self.name: str = signed_in["account"]["name"]
        self.session: str = signed_in["session"]
        self.page = {"cookie": signed_in.get("cookie", ""), "csrf_token": signed_in["csrf_token"]}

    def ask(self, method: str, path: str, **options: Any) -> httpx.Response:
        headers = {"Authorization": f"Bearer {self.token}", **options.pop("headers", {})}
        return self.site.ask(method, API + path, headers=headers, **options)


def sign_in_link(environment: Mapping[str, str], name: str) -> str:
    """A one-time token, from the program that prints links."""
    done = subprocess.run(
        [sys.executable, "-m", "function_app", "sign-in-link", "--account", name],
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip().partition("#sign-in=")[2]


def sign_in(host: Host, site: Site, home: Path, name: str, environment: Mapping[str, str] | None = None) -> Visitor:
    """Somebody in a new sign-in session at this host."""
    link = sign_in_link({"TELESCOPE_HOME": str(home), **(environment or {})}, name)
    answer = site.ask("POST", f"{API}/auth/sign-in", json={"link": link})
    assert answer.status_code == 200, f"{host.url}: {answer.text}"
    return Visitor(site, {**answer.json(), "cookie": answer.headers["set-cookie"].partition(";")[0]})
