"""Agent side of an attack: a process with secrets, victims and open ports, which runs hostile scripts.

``python -m tests.security.sandbox.attack_host LAYERS`` reads lines of JSON, ``[name, source, untrusted]``, and writes a
``Result`` for each. LAYERS are those of the sandbox, separated by commas; none: no sandbox at all.
"""

import contextlib
import json
import os
import platform
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from ctypes import addressof, create_string_buffer
from pathlib import Path
from typing import Any

import msgspec

from device_agent.ports import script_calls
from device_agent.ports.sandbox import Limits, SandboxProcess
from device_agent.protocol import RunMovement
from device_agent.runtime.actions.script_action import ScriptAction, ScriptFailed, ScriptSandbox
from device_agent.runtime.errors import Refused
from device_agent.sandbox.host import SandboxHost
from tests.security.sandbox.attacks import ATTACKS

SECRET = "the-agents-secret-7e1e5c09e"
TIME_LIMIT_S = 0.2
"""Scripts are killed after this time [s], as by Stop."""
LIMITS = Limits(cpu_s=2)
_NAMES = {word.split("'")[1] for source in ATTACKS.values() for word in source.split("call(")[1:] if word[0] == "'"}


class Result(msgspec.Struct):
    """Result of one attack.

    Attributes:
        tried: Whether the attack was executed.
        breaches: Successes that the attack reports or that are observed from outside.
        message: The error of the script, as the operator reads it.
        moves: Calls that reached the robot.
        killed: Whether the process was killed, so that it did not end without a kill.
        messages: Number of processed messages.
        cpu_s: Processor time of the host during the attack [s].
        wall_s: Duration [s].
    """

    tried: bool
    breaches: list[str]
    message: str
    moves: list[Any]
    killed: bool
    messages: int
    cpu_s: float
    wall_s: float


class RecordingRobot:
    """A robot that records its calls."""

    joints = ("shoulder", "elbow")
    frames = ("tool",)
    calls = ("move_joints", "home", "state")

    def __init__(self) -> None:
        self.moves: list[Any] = []
        self.messages = 0

    def execute(self, call: script_calls.Call) -> Any:
        self.messages += 1
        if isinstance(call, script_calls.GetState):
            return {"position_rad": dict.fromkeys(self.joints, 0.0)}
        self.moves.append(msgspec.to_builtins(call))
        raise Refused("busy", "it does not move")


class Surroundings:
    """Targets of attacks, and observation of their effects."""

    def __init__(self) -> None:
        self.home = Path(tempfile.mkdtemp(prefix="telescope-attack-host-"))
        self.outside = Path(tempfile.gettempdir()) / f"telescope-attack-{os.getpid()}"
        self.key = self.home / "identity.pem"
        self.key.write_text(f"PRIVATE KEY {SECRET}", encoding="ascii")
        self.key.chmod(0o600)
        self.memory = create_string_buffer(SECRET.encode())
        self.victim = subprocess.Popen(["sleep", "1000"], stdin=subprocess.DEVNULL)
        self.contacts: list[str] = []
        self.port = self._listen(socket.AF_INET, ("127.0.0.1", 0)).getsockname()[1]
        self.abstract = f"telescope-attack-host-{os.getpid()}"
        self._listen(socket.AF_UNIX, b"\0" + self.abstract.encode())
        self._listen(socket.AF_UNIX, str(self.home / "socket"))
        self._udp = socket.socket(type=socket.SOCK_DGRAM)
        self._udp.bind(("127.0.0.1", self.port))
        self._udp.setblocking(False)
        self._before = self._observe()

    def _listen(self, family: int, address: Any) -> socket.socket:
        listener = socket.socket(family)
        listener.bind(address)
        listener.listen()

        def welcome() -> None:
            while True:
                link, _ = listener.accept()
                self.contacts.append(str(address))
                link.close()

        threading.Thread(target=welcome, daemon=True).start()
        return listener

    def parameters(self, parents: list[int]) -> dict[str, Any]:
        import pyseccomp

        numbers = {name: pyseccomp.resolve_syscall(pyseccomp.system_arch(), name) for name in _NAMES}
        return {
            "numbers": {name: number if number >= 0 else 9999 for name, number in numbers.items()},
            "key": str(self.key),
            "home": str(self.home),
            "outside": str(self.outside),
            "agent": os.getpid(),
            "victim": self.victim.pid,
            "parents": parents,
            "port": self.port,
            "abstract": self.abstract,
            "secret_address": addressof(self.memory),
            "secret_reversed": list(reversed(SECRET)),
            "machine": platform.machine(),
        }

    def breaches(self) -> Iterator[str]:
        """Effects outside the sandbox since the last call; repairs them."""
        now = self._observe()
        for name, before in self._before.items():
            if now[name] != before:
                yield f"{name}: {before} became {now[name]}"
        self._repair()

    def _observe(self) -> dict[str, Any]:
        with contextlib.suppress(BlockingIOError):
            self._udp.recv(10)
            self.contacts.append("udp")
        stat = Path(f"/proc/{self.victim.pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
        return {
            "the agent's folder": sorted(path.name for path in self.home.iterdir()),
            "the agent's key": self.key.read_text(encoding="ascii") if self.key.exists() else None,
            "its rights": self.key.stat().st_mode if self.key.exists() else None,
            "outside": os.path.lexists(self.outside),
            "shared memory": Path("/dev/shm/telescope-attack").exists(),
            "contacts": len(self.contacts),
            "the victim": stat[0] in "SR",
            "the agent's memory": self.memory.value.decode(),
            "the agent's priority": os.getpriority(os.PRIO_PROCESS, os.getpid()),
            "the machine's name": platform.node(),
        }

    def _repair(self) -> None:
        for path in (self.outside, Path("/dev/shm/telescope-attack"), self.home / "new"):
            if path.is_dir() and not path.is_symlink():
                path.rmdir()
            path.unlink(missing_ok=True)
        self.key.unlink(missing_ok=True)
        self.key.write_text(f"PRIVATE KEY {SECRET}", encoding="ascii")
        self.key.chmod(0o600)
        with contextlib.suppress(ProcessLookupError):
            self.victim.send_signal(signal.SIGCONT)
        if self.victim.poll() is not None:
            self.victim = subprocess.Popen(["sleep", "1000"], stdin=subprocess.DEVNULL)
        self.memory.value = SECRET.encode()
        self._before = self._observe()

    def clear(self) -> None:
        self.victim.kill()
        self.victim.wait()
        shutil.rmtree(self.home, ignore_errors=True)


def strays(sandbox: SandboxHost, session: int) -> int:
    """Live processes of a script: of its session, or children of a zygote except prepared ones."""
    count = 0
    with sandbox._lock:  # no process is prepared meanwhile
        parents = zygotes()
        waiting = {process_of(parent.ready[1]) for parent in (sandbox._own, sandbox._wrapped) if parent.ready}
        for stat in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):
                state, parent, _, its_session, *_ = stat.read_text(encoding="utf-8").rsplit(")", 1)[1].split()
                child = int(parent) in parents and int(stat.parent.name) not in waiting
                count += state not in "ZX" and (int(its_session) == session or child)
    return count


def process_of(process: SandboxProcess) -> int:
    """Process id outside of bubblewrap."""
    known = Path(f"/proc/self/fdinfo/{process._descriptor}").read_text(encoding="ascii")  # type: ignore[attr-defined]
    return next(int(line.split()[1]) for line in known.splitlines() if line.startswith("Pid:"))


def zygotes() -> list[int]:
    """Ids of the zygote processes of this process, including those in bubblewrap."""
    found: list[int] = []
    seen = [os.getpid()]
    while seen:
        with contextlib.suppress(OSError):
            children = Path(f"/proc/{seen[0]}/task/{seen[0]}/children").read_text(encoding="ascii").split()
            for child in map(int, children):
                command = Path(f"/proc/{child}/cmdline").read_bytes()
                if b"device_agent/sandbox/__main__.py" in command:
                    (seen if command.startswith(b"bwrap") else found).append(child)
                    if command.startswith(b"bwrap"):
                        continue
        seen.pop(0)
    return found


def attack(sandbox: SandboxHost, around: Surroundings, name: str, source: str, *, untrusted: bool) -> Result:
    """Run one script, kill it after a time limit, and collect its effects."""
    robot, printed = RecordingRobot(), [""]

    def report(text: str, share: float | None) -> None:
        del share
        if not printed[0]:
            alarm.start()
        printed[0] = (printed[0] + text)[:20_000]

    order = RunMovement(
        robot_type="toy", name=name, version=1, sha256="0" * 64, source=source,
        parameters=around.parameters(zygotes()),
    )  # fmt: skip
    script = ScriptAction(order, robot, report, sandbox=ScriptSandbox(sandbox, untrusted, LIMITS), on_exit=lambda: None)
    killed = threading.Event()

    def kill() -> None:
        killed.set()
        script.kill()

    alarm = threading.Timer(TIME_LIMIT_S, kill)  # starts with its first output
    message = ""
    cpu_s, wall_s = time.process_time(), time.perf_counter()
    try:
        script.run()
    except ScriptFailed as failed:
        message = str(failed)
    wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
    alarm.cancel()
    breaches = [line for line in printed[0].splitlines() if line.startswith("BREACH")]
    breaches += around.breaches()
    process = script._process
    if process is not None and strays(sandbox, process.pid):  # type: ignore[attr-defined]
        breaches.append("a process of the script is still alive")
    return Result(
        tried=printed[0].startswith("TRIED\n"),
        breaches=breaches,
        message=message,
        moves=robot.moves,
        killed=killed.is_set(),
        messages=robot.messages,
        cpu_s=cpu_s,
        wall_s=wall_s,
    )


def main(layers: str) -> None:
    os.environ["TELESCOPE_SECRET"] = SECRET
    sandbox = SandboxHost(layers=[layer for layer in layers.split(",") if layer])
    sandbox.start()
    around = Surroundings()
    try:
        for line in sys.stdin:
            name, source, untrusted = json.loads(line)
            result = attack(sandbox, around, name, source, untrusted=untrusted)
            sys.stdout.buffer.write(msgspec.json.encode(result) + b"\n")
            sys.stdout.buffer.flush()
    finally:
        sandbox.close()
        around.clear()


if __name__ == "__main__":
    main(*sys.argv[1:])
