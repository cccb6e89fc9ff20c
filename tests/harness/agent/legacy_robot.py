"""The wrapper for legacy robots, ``examples/legacy/telescope_legacy.py``, as a process with any Python.

with LegacyRobot(processes, python, folder) as robot:
    robot.pair()
    robot.run()
"""

import contextlib
import json
import os
import signal
import subprocess
from pathlib import Path
from typing import Any, Self

from device_agent.protocol import Command, Request, codec
from device_agent.protocol.security import signing
from function_app.adapters.local.signing_keys import FileKeys
from function_app.domain.common.ids import command_id
from function_app.domain.devices.devices import Agent
from function_app.services.messaging.delivery import SignedCommand
from function_app.services.storage import records
from tests.harness.cloud.cloud_processes import COMMAND_TTL_MS, CloudProcesses
from tests.harness.hosts.host import Program, environment_of, start_program
from tests.harness.network.brokers import wait_until
from tests.harness.paths import ROOT

WRAPPER = ROOT / "examples" / "legacy" / "telescope_legacy.py"
FILES = {
    "wave.py": "import json, sys\nprint('waves', json.loads(sys.argv[1]), sys.version_info[:2])\n",
    "say.py": "import json, sys\nprint(json.loads(sys.argv[1])['text'])\n",
    "trip.py": "import sys\nprint('falls')\nsys.exit(3)\n",
    "walk.py": "import os, time\nopen('walks', 'a').write('%d\\n' % os.getpid())\nwhile True:\n    time.sleep(0.01)\n",
    "stubborn.py": (
        "import os, signal, subprocess, time\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "child = subprocess.Popen(['sleep', '1000'])\n"
        "open('walks', 'a').write('%d\\n%d\\n' % (os.getpid(), child.pid))\n"
        "while True:\n    time.sleep(0.01)\n"
    ),
    "_helper.py": "",
}

CLOCK = "import time\nread = time.time\ntime.time = lambda: read() + {}\n"
"""Module that Python imports at its start: a wrong clock of the robot."""


class LegacyRobot:
    """A robot of Anna.

    Attributes:
        movements: Folder of its movements.
        device: Id of its device, after ``pair``.
        clock_offset_s: Error of its clock [s], for programs that start afterwards.
    """

    def __init__(self, processes: CloudProcesses, python: str, folder: Path) -> None:
        self.processes = processes
        self.anna = processes.anna
        self.home, self.movements = folder / "home", folder / "movements"
        self.movements.mkdir(parents=True)
        for name, text in FILES.items():
            (self.movements / name).write_text(text)
        self.device = self.agent = ""
        self.url = processes.url
        self.clock_offset_s = 0
        self._clock = folder / "clock"
        self._python = python
        self._programs = contextlib.ExitStack()
        self._program: Program | None = None

    def start(self, *arguments: str, program: Path = WRAPPER) -> Program:
        """Start the wrapper, or a program that uses it."""
        command = [str(program), *arguments]
        self._clock.mkdir(exist_ok=True)
        (self._clock / "sitecustomize.py").write_text(CLOCK.format(self.clock_offset_s))
        environment = {**environment_of({}), "PYTHONPATH": f"{self._clock}{os.pathsep}{WRAPPER.parent}"}
        self._program = self._programs.enter_context(start_program(command, environment, python=self._python))
        return self._program

    def pair(self) -> Self:
        enrolling = self.start("enroll", "--url", self.url, "--name", "qbo", "--home", str(self.home))
        code = enrolling.read_line().removeprefix("claim code: ").split()[0]
        claimed = self.anna.post("/agents/claim", {"code": code})
        assert claimed.status_code == 200, claimed.text
        assert enrolling.read_line().startswith("paired with the account anna")
        assert enrolling.process.wait(30) == 0
        self.agent, self.device = claimed.json()["agent"], claimed.json()["devices"][0]["id"]
        return self

    def run(self, *options: str) -> Self:
        """Start the wrapper, and wait until it is connected."""
        folders = ["--movements", str(self.movements), "--home", str(self.home)]
        self.start("run", *folders, *options)
        wait_until(lambda: "connected to" in self.log() or self.exit_code() is not None, "the connection")
        assert self.exit_code() is None, self.log()
        return self

    def last_ack(self, command: str) -> tuple[str, str]:
        """Status and code of the last ack in the journal; empty without one."""
        known = self._journal().get(f"command:{command}")
        return (known["ack"]["status"], known["ack"].get("reason", {}).get("code", "")) if known else ("", "")

    def log(self) -> str:
        return "" if self._program is None else self._program.stderr()

    def _journal(self) -> dict[str, Any]:
        values: dict[str, Any] = {}
        for line in (self.home / "journal.jsonl").read_text().splitlines():
            with contextlib.suppress(ValueError):
                values |= json.loads(line)
        return values

    def call(self, *arguments: str) -> tuple[int, str]:
        """Exit code and standard error of the wrapper with other arguments."""
        done = subprocess.run(
            [self._python, str(WRAPPER), *arguments],
            capture_output=True,
            text=True,
            check=False,
            env=environment_of({}),
        )
        return done.returncode, done.stderr

    def redirect(self, url: str) -> None:
        """Change the address of the server in the robot's folder."""
        file = self.home / "agent.json"
        file.write_text(json.dumps({**json.loads(file.read_text()), "url": url}))

    def exit_code(self) -> int | None:
        return None if self._program is None else self._program.process.poll()

    def kill(self) -> None:
        assert self._program is not None
        self._program.process.kill()
        self._program.process.wait()

    def terminate(self) -> int:
        """End the wrapper in an orderly way; returns its exit code."""
        assert self._program is not None
        self._program.process.send_signal(signal.SIGTERM)
        return self._program.process.wait(30)

    # ------------------------------------------------------------ the account

    def begin(self, name: str, **options: Any) -> dict[str, Any]:
        """Start a behaviour; returns the action."""
        answer = self.anna.start(self.device, request={"kind": "run_behaviour", "name": name}, **options)
        assert answer.status_code in {200, 202}, answer.text
        action: dict[str, Any] = answer.json()
        return action

    def begin_walk(self, name: str = "walk", **options: Any) -> str:
        """Start a movement without end, and wait until it runs; returns the id of the action."""
        before = self.walks()
        action = self.begin(name, **options)["id"]
        wait_until(lambda: len(self.walks()) > len(before) and self.status(action) == "started", "the movement")
        return str(action)

    def status(self, action: str) -> str:
        return str(self.anna.action(action)["status"])

    def end(self, action: str) -> dict[str, Any]:
        """The action, when it has ended."""
        ended = {"done", "failed", "expired", "cancelled"}
        wait_until(lambda: self.status(action) in ended, f"the end of the action: {self.log()}")
        return self.anna.action(action)

    def events(self, kind: str) -> list[dict[str, Any]]:
        items = self.anna.get(f"/devices/{self.device}/events").json()["items"]
        return [each for each in items if each["kind"] == kind]

    def state(self) -> dict[str, Any]:
        state: dict[str, Any] = self.anna.get(f"/devices/{self.device}").json()["state"]
        return state

    def walks(self) -> list[int]:
        """Processes of the movement without end, in the order in which they were started."""
        file = self.movements / "walks"
        return [int(line) for line in file.read_text().split()] if file.exists() else []

    def walking(self) -> list[int]:
        """Those of them that exist."""
        return [process for process in self.walks() if _runs(process)]

    # ------------------------------------------------------------ commands that the API would not send

    def command(self, request: Request, **changes: Any) -> bytes:
        """A signed command; ``key``: the private key, otherwise fields of the command."""
        key = changes.pop("key", None) or FileKeys(self.processes.home / "keys").load()
        (device,) = self.processes.devices(self.agent)
        now_ms = self.processes.cloud.clock.now_ms()
        fields: dict[str, Any] = {
            "id": self.new_id(),
            "space": device.space,
            "agent": self.agent,
            "device": device.name,
            "issued_at_ms": now_ms,
            "ttl_ms": COMMAND_TTL_MS,
            "caller": "anna",
            "epoch": 1000,
            "request": request,
        }
        return signing.sign(codec.encode(Command(**{**fields, **changes})), key)

    def new_id(self) -> str:
        return command_id(self.device, self.processes.cloud.clock.now_ms())

    def deliver(self, payload: bytes, command: str = "") -> None:
        """Put a message into the mailbox, under the id of its command or a new one."""
        (device,) = self.processes.devices(self.agent)
        expires_ms = self.processes.cloud.clock.now_ms() + COMMAND_TTL_MS
        signed = SignedCommand(command or self.new_id(), payload, expires_ms)
        self.processes.cloud.run(self.processes.delivery.send(device, signed))

    def is_waiting(self, command: str) -> bool:
        """Whether a command is in the mailbox, because the wrapper has not acknowledged it."""
        functions = self.processes.cloud.functions
        row = self.processes.cloud.run(functions.tables.get(records.AGENTS, self.agent, "agent"))
        assert row is not None
        pending = functions.polling._mailbox.pending(records.read(row, Agent), limit=32)
        return command in {each.command for each in self.processes.cloud.run(pending)}

    def rejected(self, code: str) -> list[dict[str, Any]]:
        """Events about commands that were rejected with this code."""
        return [each for each in self.events("command-rejected") if each["data"]["code"] == code]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._programs.close()


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False
