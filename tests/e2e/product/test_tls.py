"""``TELESCOPE_TLS=1 make up``: page, API, broker and agent use TLS; clients must trust the site."""

import contextlib
import os
import socket
import ssl
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from function_app.ports.broker_access import Credentials
from infra.local.__main__ import port_in_use
from infra.mosquitto.configuration import binary
from tests.harness.browser.product import Machine, start_machine
from tests.harness.network.brokers import Client, wait_until
from tests.harness.paths import ROOT


@contextlib.contextmanager
def bridge(machine: Machine, home: Path, key: str, *trusting: str) -> Iterator["subprocess.Popen[str]"]:
    """The bridge to Home Assistant, with a plain Mosquitto in place of its broker."""
    with contextlib.closing(socket.socket()) as taken:
        taken.bind(("127.0.0.1", 0))
        port: int = taken.getsockname()[1]
    (home / "mosquitto.conf").write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n")
    command = [sys.executable, "-m", "infra.home_assistant", "--server", machine.url, "--port", str(port), *trusting]
    with subprocess.Popen([binary(), "-c", str(home / "mosquitto.conf")], stderr=subprocess.DEVNULL) as broker:
        wait_until(lambda: port_in_use("127.0.0.1", port), "Home Assistant's broker")
        with subprocess.Popen(
            command,
            cwd=ROOT,
            env=os.environ | {"TELESCOPE_KEY": key},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        ) as process:
            try:
                yield process
            finally:
                process.terminate()
        broker.terminate()


def test_all_connections_use_tls(tmp_path: Path) -> None:
    with start_machine(tmp_path, TELESCOPE_TLS="1") as machine:
        assert machine.process.poll() is None, "".join(machine.lines)
        assert machine.ready.startswith(f"ready {machine.url}/ ")
        link = subprocess.run(
            [sys.executable, "-m", "infra.local.sign_in_link"],
            cwd=ROOT, env=os.environ | {"TELESCOPE_HOME": str(tmp_path)}, capture_output=True, text=True, check=True,
        ).stdout.strip()  # fmt: skip
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
            bridge(machine, tmp_path, key, "--ca", str(tmp_path / "tls" / "ca.crt")) as trusting,
            bridge(machine, tmp_path / "tls", key) as doubting,
        ):
            assert trusting.stdout is not None
            assert doubting.stdout is not None
            assert "ready\n" in iter(trusting.stdout.readline, ""), "the bridge receives over mqtts"
            assert "certificate verify failed" in doubting.stdout.readline().lower()
        stranger = [sys.executable, "-m", "device_agent", "enroll", "--home", str(tmp_path / "stranger"), "--no-wait"]
        refused = subprocess.run(
            [*stranger, "--server", machine.url, "--device", "arm=ur5"],
            cwd=ROOT, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert refused.returncode == 1
        assert "certificate verify failed" in refused.stderr
        assert "Traceback" not in refused.stderr
