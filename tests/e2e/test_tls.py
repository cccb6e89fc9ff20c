"""``TELESCOPE_TLS=1 make up``: page, API, broker and agent speak TLS, and only with who trusts the site."""

import ssl
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from function_app.ports.broker_access import Credentials
from tests.support.brokers import ROOT, Client
from tests.support.machine import start_machine


def test_all_of_it_speaks_tls(tmp_path: Path) -> None:
    with start_machine(tmp_path, TELESCOPE_TLS="1") as machine:
        assert machine.process.poll() is None, "".join(machine.lines)
        assert machine.ready.startswith(f"ready {machine.url}/ ")
        with machine.api() as api:
            device = api.device()
            taken = api.post(f"/devices/{device['id']}/lease", {"wait_ms": 10_000})
            assert taken["confirmed"], "the agent obeys over mqtts"
            issued = api.post("/mqtt/credentials", {"purpose": "watch"})
            page = api.http.get(machine.url)
            assert page.headers["strict-transport-security"].startswith("max-age=")
            signed_in = api.http.post("/auth/sign-in", json={"link": machine.sign_in_link().partition("#sign-in=")[2]})
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
        stranger = [sys.executable, "-m", "device_agent", "enroll", "--home", str(tmp_path / "stranger"), "--no-wait"]
        refused = subprocess.run(
            [*stranger, "--server", machine.url, "--device", "arm=ur5"],
            cwd=ROOT, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert refused.returncode == 1
        assert "certificate verify failed" in refused.stderr
        assert "Traceback" not in refused.stderr
