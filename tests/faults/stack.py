"""The whole product with several arms, in processes that can be disconnected, frozen or killed one by one."""

import contextlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import msgspec

from infra.local.supervisor import SupervisedProcess
from tests.faults.console import OperatorConfig
from tests.harness.browser.product import PORTS
from tests.harness.network.brokers import MODULES, BrokerKind, wait_until
from tests.harness.network.ports import free_port
from tests.harness.network.proxy import HOST, Proxy
from tests.harness.paths import ROOT

PATIENCE_S = 60.0
_AGENT_NICE = -10
_COMMANDS = re.compile(rb"/(arm[0-9])/(ctl|cmd)\b")
MOVEMENT = "sweep"
SCRIPT = """
while True:
    for pan in (1.4, -1.4):
        robot.move_joints({"shoulder_pan": pan}, speed=0.35)
"""


def now_ms() -> float:
    """Monotonic clock of the trace, shared by all processes of the machine [ms]."""
    return time.monotonic() * 1000


class Console:
    """An operator process and its messages."""

    def __init__(self, process: int, listener: socket.socket, proxy: Proxy) -> None:
        self.process = process
        self.proxy = proxy
        self.messages: list[dict[str, Any]] = []
        self._connection, _ = listener.accept()
        self._connection.settimeout(0.05)
        self._incomplete = b""

    def send(self, request: str) -> None:
        """Raises: OSError: The process has exited."""
        self.messages.clear()
        self._connection.sendall(request.encode() + b"\n")

    def receive(self, *kinds: str, within_s: float) -> dict[str, Any] | None:
        """The first message of one of these kinds after the last request."""
        deadline_s = time.monotonic() + within_s
        while True:
            message = next((each for each in self.messages if set(kinds) & set(each)), None)
            if message is not None or time.monotonic() > deadline_s:
                return message
            with contextlib.suppress(TimeoutError, ConnectionError):
                self._incomplete += self._connection.recv(4096)
            *lines, self._incomplete = self._incomplete.split(b"\n")
            self.messages += [json.loads(line) for line in lines]

    def signal(self, number: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.process, number)

    def end(self) -> None:
        self.signal(signal.SIGKILL)
        self._connection.close()
        self.proxy.end()


class Stack:
    """The started processes; see ``start``.

    Attributes:
        AGENT: Module of the agent program.
    """

    AGENT = "tests.faults.agent"

    def __init__(self, kind: BrokerKind, arms: int, *, watchdog_s: float) -> None:
        self.names = [f"arm{number}" for number in range(arms)]
        self.home = Path(tempfile.mkdtemp(prefix="ts-"))  # the path of a Unix socket has at most 108 bytes
        self.port = free_port(PORTS)
        self.operator_port = self.port + 1
        self.setpoints: dict[str, list[float]] = defaultdict(list)
        self.commands: dict[str, list[float]] = defaultdict(list)
        self._environment = os.environ | {
            "TELESCOPE_HOME": str(self.home), "TELESCOPE_PORT": str(self.port), "TELESCOPE_BROKER": kind
        }  # fmt: skip
        self.agent_home = self.home / "agents" / "arms"
        self.trace = self.home / "trace"
        self._logs = self.home / "logs"
        self._logs.mkdir()
        self._closing = contextlib.ExitStack()
        self._watchdog_s = watchdog_s
        self._kind = kind
        self._killed: list[int] = []

    def begin(self) -> None:
        link = self._program("function_app", "sign-in-link", "--account", "ann").partition("#sign-in=")[2]
        ports = ["--tcp-port", str(self.port + 1), "--websocket-port", str(self.port + 2)]
        keys = ["--keys", str(self.home / "keys" / "public.json")]
        folder = ["--home", str(self.home / "mosquitto")]
        self.broker = self._child("broker", MODULES[self._kind], *ports, *(keys if self._kind == "amqtt" else folder))
        self.broker.wait_for_line("ready", PATIENCE_S)
        self.functions = self._child("functions", "function_app", "serve")
        self.worker = self.start_worker("worker")
        self.api = f"http://{HOST}:{self.port}/api/v1"
        self.http = self._closing.enter_context(httpx.Client(base_url=self.api, timeout=15))
        self.await_health()
        self.token = self.post("/auth/sign-in", link=link)["access_token"]
        self.http.headers["Authorization"] = f"Bearer {self.token}"
        self.http.cookies.clear()
        self.agent_mqtt = self._proxy(self.port + 1, self._on_received)
        self._start_agent()
        saved = self.http.put(f"/robot-types/ur5/movements/{MOVEMENT}", json={"source": SCRIPT})
        assert saved.is_success, saved.text
        self.token = self.post("/api-keys", name="bench", role="operator", days=1)["token"]
        self.http.headers["Authorization"] = f"Bearer {self.token}"
        self._consoles = self._start_parent("tests.faults.console")

    def _start_agent(self) -> None:
        devices = [part for name in self.names for part in ("--device", f"{name}=ur5")]
        home = ["--home", str(self.agent_home)]
        output = self._program(
            "device_agent", "enroll", *home, "--server", f"http://{HOST}:{self.port}", "--name", "bench", *devices,
            "--no-wait",
        ).split()  # fmt: skip
        self.agent_id = self.post("/agents/claim", code=output[output.index("code") + 1])["agent"]
        self.agent = self._child("agent", self.AGENT, *self.agent_arguments(self.agent_mqtt.port))
        self.agent.wait_for_line("running", PATIENCE_S)
        with contextlib.suppress(PermissionError):  # raise the priority of the agent's control loop, if permitted
            os.setpriority(os.PRIO_PGRP, self.pid(self.agent), _AGENT_NICE)
        wait_until(lambda: all(each["online"] for each in self.devices()), "the arms to be online", PATIENCE_S)
        (self.space,) = {each["topic"].split("/")[2] for each in self.devices()}

    def agent_arguments(self, mqtt_port: int) -> list[str]:
        """Command line of the agent with this broker port."""
        return [str(mqtt_port), str(self._watchdog_s), "--home", str(self.agent_home), "--trace", str(self.trace)]

    # ------------------------------------------------------------ operations

    def devices(self) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = self.http.get("/devices").json()["items"]
        return found

    def post(self, path: str, **body: Any) -> dict[str, Any]:
        """Raises: httpx.HTTPError: Rejected or unreachable."""
        answer = self.http.post(path, json=body)
        answer.raise_for_status()
        found: dict[str, Any] = answer.json()
        return found

    def await_health(self) -> None:
        def healthy() -> bool:
            with contextlib.suppress(httpx.HTTPError, ValueError):
                return bool(self.http.get("/health", timeout=1).json()["broker"] == "ok")
            return False

        wait_until(healthy, "healthy functions", PATIENCE_S)

    def console(self, name: str, *, lease_ms: int, stubborn: bool) -> Console:
        """A new operator of this arm."""
        path = self.home / f"{name}.socket"
        path.unlink(missing_ok=True)
        proxy = Proxy(self.operator_port)
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(str(path))
            listener.listen(1)
            listener.settimeout(PATIENCE_S)
            config = OperatorConfig(
                socket=str(path), api=self.api, token=self.token, mqtt_port=proxy.port,
                device=f"{self.agent_id}-{name}", topic=f"ts/v1/{self.space}/{self.agent_id}/{name}",
                joints=["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"], joint=0,
                low_rad=-1.4, high_rad=1.4, lease_ms=lease_ms, stubborn=stubborn,
            )  # fmt: skip
            return Console(int(self._consoles(msgspec.json.encode(config).decode())), listener, proxy)

    def descendants(self, child: SupervisedProcess) -> list[int]:
        """Ids of all descendants of a process."""
        parents = {}
        for folder in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
        found = [self.pid(child)]
        for process in found:
            found += [each for each, parent in parents.items() if parent == process]
        return found[1:]

    @staticmethod
    def pid(child: SupervisedProcess) -> int:
        assert child._process is not None
        return child._process.pid

    def signal(self, child: SupervisedProcess, number: int) -> None:
        """Send a signal to a process and its descendants; mosquitto is a child of the broker program."""
        descendants = self.descendants(child)
        self._killed = descendants if number == signal.SIGKILL else []
        for process in (self.pid(child), *descendants):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, number)

    def start_worker(self, name: str) -> SupervisedProcess:
        """Start another ingest worker."""
        return self._child(name, "function_app", "work")

    def restart(self, child: SupervisedProcess) -> None:
        """Restart a killed program after its child processes have released their ports."""
        assert child._process is not None
        child._process.wait(PATIENCE_S)
        wait_until(lambda: not any(map(_alive, self._killed)), "the end of the killed processes", PATIENCE_S)
        child.start()

    # ------------------------------------------------------------ processes

    def _on_received(self, content: bytes) -> None:
        at_ms = now_ms()
        for name, kind in _COMMANDS.findall(content):
            (self.setpoints if kind == b"ctl" else self.commands)[name.decode()].append(at_ms)

    def _program(self, *arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, "-m", *arguments],
            cwd=ROOT,
            env=self._environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    def _child(self, name: str, module: str, *arguments: str) -> SupervisedProcess:
        child = SupervisedProcess(name, ["-m", module, *arguments], dict(self._environment), self._logs)
        self._closing.callback(self._stop, child)
        child.start()
        return child

    def _stop(self, child: SupervisedProcess) -> None:
        self.signal(child, signal.SIGCONT)
        child.stop()

    def _proxy(self, behind: int, received: Callable[[bytes], None]) -> Proxy:
        proxy = Proxy(behind, received)
        self._closing.callback(proxy.end)
        return proxy

    def _start_parent(self, module: str) -> Callable[[str], str]:
        parent = self._closing.enter_context(
            subprocess.Popen(
                [sys.executable, "-m", module], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
        )

        lock = threading.Lock()

        def request(line: str) -> str:
            assert parent.stdout is not None
            with lock:
                print(line, file=parent.stdin, flush=True)
                return parent.stdout.readline()

        assert parent.stdin is not None
        self._closing.callback(parent.stdin.close)
        return request

    def close(self) -> None:
        self._closing.close()
        shutil.rmtree(self.home, ignore_errors=True)


def _alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@contextlib.contextmanager
def start(kind: BrokerKind, arms: int, *, watchdog_s: float = 0.3) -> Iterator[Stack]:
    """Start the product with this number of arms; the context stops it."""
    stack = Stack(kind, arms, watchdog_s=watchdog_s)
    try:
        stack.begin()
        yield stack
    finally:
        stack.close()
