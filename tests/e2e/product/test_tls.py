"""``TELESCOPE_TLS=1 make up``: page, API, broker and agent use TLS; clients must trust the site."""

import ssl
from pathlib import Path

import httpx
import pytest

from function_app.ports.broker_access import Credentials
from tests.harness.browser.product import home_assistant, run_module, start_machine
from tests.harness.network.brokers import Client


def test_all_connections_use_tls(tmp_path: Path) -> None:
    with start_machine(tmp_path, TELESCOPE_TLS="1") as machine:
        assert machine.process.poll() is None, "".join(machine.lines)
        assert machine.ready.startswith(f"ready {machine.url}/ ")
        link = run_module("infra.local.sign_in_link", TELESCOPE_HOME=str(tmp_path)).stdout.strip()
        assert link.startswith(f"{machine.url}/#sign-in="), "make link receives only the folder"
        with machine.api() as api:
            key = api.post("/api-keys", {"name": "Home Assistant", "role": "viewer"})["token"]
            device = api.device()
            taken = api.post(f"/devices/{device['id']}/lease", {"wait_ms": 10_000})
            assert taken["confirmed"], "the agent grants the lease over mqtts"
            issued = api.post("/mqtt/credentials", {"purpose": "view"})
            page = api.http.get(machine.url)
            assert page.headers["strict-transport-security"].startswith("max-age=")
            signed_in = api.http.post("/auth/sign-in", json={"link": link.partition("#sign-in=")[2]})
            assert all("Secure" in cookie for cookie in signed_in.headers.get_list("set-cookie"))
            assert signed_in.headers.get_list("set-cookie")
        assert issued["tcp"]["tls"] is True
        assert issued["websocket_url"].startswith("wss://")
        credentials = Credentials(issued["username"], issued["password"])
        for transport, port in (("tcp", machine.port + 1), ("websockets", machine.port + 2)):
            client = Client(issued["client_id"], credentials, port=port, transport=transport, tls=machine.trusted)  # type: ignore[arg-type]
            with client.open():
                assert client.connected.is_set(), (transport, client.answer)
        with pytest.raises(httpx.ConnectError, match="CERTIFICATE_VERIFY_FAILED"):
            httpx.get(machine.url, verify=ssl.create_default_context())
        with pytest.raises(httpx.HTTPError):
            httpx.get(machine.url.replace("https:", "http:"))
        with (
            home_assistant(machine, tmp_path, key, "--ca", str(tmp_path / "tls" / "ca.crt")) as (trusting, _),
            home_assistant(machine, tmp_path / "tls", key) as (doubting, _),
        ):
            assert trusting.stdout is not None
            assert doubting.stdout is not None
            assert "ready\n" in iter(trusting.stdout.readline, ""), "the bridge receives over mqtts"
            assert "certificate verify failed" in doubting.stdout.readline().lower()
        where = ("--home", str(tmp_path / "stranger"), "--server", machine.url)
        refused = run_module("device_agent", "enroll", *where, "--device", "arm=ur5", "--no-wait")
        assert refused.returncode == 1
        assert "certificate verify failed" in refused.stderr
        assert "Traceback" not in refused.stderr
