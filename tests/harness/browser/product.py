"""The whole product as ``make up`` starts it, for black-box tests."""

import contextlib
import json
import os
import re
import signal
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import httpx

from function_app.ports.broker_access import Credentials
from infra.local.__main__ import port_in_use
from infra.mosquitto.configuration import binary
from tests.harness.cloud.people import sign_in_link
from tests.harness.network.brokers import Client, wait_until
from tests.harness.network.ports import free_port
from tests.harness.paths import ROOT

START_WITHIN_S = 300.0
_ROW_BYTES = 500
_COLUMNS = (("qpos", "joints"), ("qvel", "joints"), ("target", "actuators"), ("ctrl", "actuators"))


PORTS = 5
"""Consecutive ports of the product: the server and its brokers."""


@dataclass
class Machine:
    """A started product."""

    process: "subprocess.Popen[str]"
    home: Path
    port: int
    lines: list[str]
    tls: bool = False

    @property
    def url(self) -> str:
        return f"http{'s' if self.tls else ''}://127.0.0.1:{self.port}"

    @property
    def trusted(self) -> ssl.SSLContext:
        """SSL context that trusts the product's own certificate authority if it uses TLS."""
        return ssl.create_default_context(cafile=str(self.home / "tls" / "ca.crt") if self.tls else None)

    @property
    def ready(self) -> str:
        return next(line for line in self.lines if line.startswith("ready"))

    def sign_in_link(self, account: str = "demo") -> str:
        """A new one-time sign-in link of ``make link``."""
        return f"{self.url}/#sign-in={sign_in_link({'TELESCOPE_HOME': str(self.home)}, account)}"

    def api(self, account: str = "demo") -> "Api":
        """The HTTP API with a session."""
        return Api(self, account)

    def trace(self, device: str = "ur5") -> "Trace":
        """The simulation trace of a device."""
        return Trace(self.home / "trace" / f"{device}.ndjson")

    def pid(self, words: str) -> int:
        """Id of the product's process whose command line contains these words."""
        listed = subprocess.run(["ps", "-wweo", "pid,ppid,args"], capture_output=True, text=True, check=True).stdout
        found = [line for line in listed.splitlines() if words in line and int(line.split()[1]) == self.process.pid]
        assert len(found) == 1, f"{words}: {found}"
        return int(found[0].split()[0])

    def kill(self, words: str) -> None:
        os.kill(self.pid(words), signal.SIGKILL)

    def interrupt(self) -> int:
        """Send SIGINT. Returns the exit code."""
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(60)

    def log(self, name: str) -> str:
        return (self.home / "logs" / f"{name}.log").read_text()


class Api:
    """The HTTP API with the session of one account. The context manager closes it."""

    def __init__(self, machine: Machine, account: str = "demo") -> None:
        self.http = httpx.Client(base_url=f"{machine.url}/api/v1", timeout=30, verify=machine.trusted)
        link = machine.sign_in_link(account).partition("#sign-in=")[2]
        signed_in = self.http.post("/auth/sign-in", json={"link": link})
        assert signed_in.status_code == httpx.codes.OK, signed_in.text
        self.http.headers["X-CSRF-Token"] = signed_in.json()["csrf_token"]  # the client keeps the cookie

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.http.close()

    def get(self, path: str, **query: Any) -> Any:
        return self._ok(self.http.get(path, params=query))

    def post(self, path: str, body: Any = None) -> Any:
        return self._ok(self.http.post(path, json={} if body is None else body))

    def device(self, name: str = "ur5") -> dict[str, Any]:
        """The device with this name at its agent, once it is online."""
        found: list[dict[str, Any]] = []

        def online() -> bool:
            found[:] = [each for each in self.get("/devices")["items"] if each["name"] == name and each["online"]]
            return bool(found)

        wait_until(online, f"{name} to be online")
        return found[0]

    def free_device(self, name: str = "ur5") -> dict[str, Any]:
        """The device with this name, once it is online and free. A closed page may keep its lease for a while."""
        device = self.device(name)
        wait_until(lambda: self.get(f"/devices/{device['id']}/lease")["lease"] is None, f"{name} to be free")
        return device

    @staticmethod
    def _ok(answer: httpx.Response) -> Any:
        assert answer.is_success, f"{answer.request.method} {answer.request.url}: {answer.status_code} {answer.text}"
        return answer.json() if answer.content else None


def moves(api: Api, device: str) -> bool:
    """Return True if a small wrist motion succeeds."""
    move = {"kind": "move_joints", "position_rad": {"wrist_3": 0.2}}
    try:
        answer = api.http.post(
            f"/devices/{device}/actions", json={"request": move, "wait_ms": 20_000, "wait_for": "done"}
        )
        return bool(answer.json().get("status") == "done")
    except httpx.HTTPError:
        return False


@contextlib.contextmanager
def mqtt_client(api: Api, **request: Any) -> Iterator[tuple[Client, dict[str, Any]]]:
    """A connected MQTT client with credentials of the API, and the response that granted them."""
    given = api.post("/mqtt/credentials", request)
    credentials = Credentials(given["username"], given["password"])
    with Client(given["client_id"], credentials, port=given["tcp"]["port"]).open() as client:
        yield client, given


class Trace:
    """Reader of a simulation trace."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def rows(self, newest: int = 800) -> list[dict[str, Any]]:
        """The newest rows, with joint values by name."""
        rows = []
        with self._path.open("rb") as file:
            names: dict[str, list[str]] = json.loads(file.readline())
            file.seek(max(file.tell(), self._path.stat().st_size - newest * _ROW_BYTES))
            for line in file.read().splitlines():
                with contextlib.suppress(ValueError):  # the first and the last line may be incomplete
                    row = json.loads(line)
                    if "qpos" in row:
                        rows.append(row | {key: dict(zip(names[of], row[key], strict=True)) for key, of in _COLUMNS})
        return rows

    def now(self) -> dict[str, Any]:
        return self.rows(20)[-1]  # rows of robots with many joints are longer


@contextlib.contextmanager
def start_machine(home: Path, *, port: int = 0, **settings: str) -> Iterator[Machine]:
    """Start the program of ``make up``; ``settings`` are environment variables. The context stops it.

    Waits for the ready line or the end of the process.
    """
    with start_program("infra.local", home, port or free_port(PORTS), settings) as machine:
        yield machine


@contextlib.contextmanager
def start_program(program: str, home: Path, port: int, settings: Mapping[str, str]) -> Iterator[Machine]:
    """Like ``start_machine``, with another module in place of the one of ``make up``."""
    environment = os.environ | {
        "TELESCOPE_HOME": str(home),
        "TELESCOPE_PORT": str(port),
        "TELESCOPE_TRACE": str(home / "trace"),
        "TELESCOPE_ROOM": "none",  # most tests need one arm
        **settings,
    }
    process = subprocess.Popen(
        [sys.executable, "-m", *program.split()],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,  # Ctrl-C only reaches the caller, which stops the product after its own work
    )
    lines: list[str] = []
    assert process.stdout is not None
    output = process.stdout

    def read() -> None:
        for line in output:
            lines.append(line)  # noqa: PERF402 (as they come)

    reader = threading.Thread(target=read)
    reader.start()
    try:
        deadline_s = time.monotonic() + START_WITHIN_S
        while process.poll() is None and not any(line.startswith("ready") for line in lines):
            assert time.monotonic() < deadline_s, "".join(lines)
            time.sleep(0.05)
        yield Machine(process, home, port, lines, settings.get("TELESCOPE_TLS") == "1")
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(40)
            except subprocess.TimeoutExpired:
                process.kill()
        reader.join(10)
        process.wait()
        output.close()


@contextlib.contextmanager
def home_assistant(
    machine: Machine, folder: Path, key: str, *arguments: str
) -> Iterator[tuple["subprocess.Popen[str]", int]]:
    """The bridge to Home Assistant with an external mosquitto, and the port of that broker."""
    port = free_port()
    (folder / "mosquitto.conf").write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n")
    command = [sys.executable, "-m", "infra.home_assistant", "--server", machine.url, "--port", str(port), *arguments]
    output = {"cwd": ROOT, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen([binary(), "-c", str(folder / "mosquitto.conf")], stderr=subprocess.DEVNULL) as broker:
        wait_until(lambda: port_in_use("127.0.0.1", port), "Home Assistant's broker")
        with subprocess.Popen(command, env=os.environ | {"TELESCOPE_KEY": key}, **output) as process:  # type: ignore[call-overload]
            try:
                yield process, port
            finally:
                process.terminate()
        broker.terminate()


def run_module(*arguments: str, **environment: str) -> "subprocess.CompletedProcess[str]":
    """Run a program of the product to its end."""
    return subprocess.run(
        [sys.executable, "-m", *arguments],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
    )


def enroll(machine: Machine, api: Api, home: Path, device: str, *more: str) -> str:
    """Enroll and claim an agent with one device ``NAME=TYPE``. Returns the agent's id."""
    where = ("--home", str(home), "--server", machine.url, "--device", device, "--no-wait")
    output = run_module("device_agent", "enroll", *where, *more).stdout.split()
    agent: str = api.post("/agents/claim", {"code": output[output.index("code") + 1]})["agent"]
    return agent


def ready_link(line: str) -> str:
    """Return the sign-in link of a ready line."""
    found = re.search(r"http\S+#sign-in=\S+", line)
    assert found, line
    return found[0]
