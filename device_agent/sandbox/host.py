"""The agent's side of the jail: keeps a warm parent alive, one more behind bubblewrap, and asks them for processes.

Of each parent one process is kept ready, locked and waiting for its script: to fork and lock one takes 7 ms, which
were a third of the time from an operator's click to the first motion. No process runs a second script.
"""

import contextlib
import importlib.util
import json
import logging
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from device_agent.ports.sandbox import JailError, Limits, SandboxProcess, SandboxStatus
from device_agent.sandbox.constants import LAYERS, LONGEST_MESSAGE

_MAIN = Path(__file__).with_name("__main__.py")
_START_S = 60.0
"""A cold parent imports NumPy: 0.3 s on an idle machine."""
_ANSWER_S = 5.0
_PREPARE_AFTER_S = 0.5
"""A script that begins has the processor first."""
_DEAD_S = 5.0
"""More than any process takes to die, unless the kernel itself is stuck."""
_ENVIRONMENT = {
    "LANG": "C.UTF-8",
    # One thread: a second could not be started in a script's process, and would not survive the fork.
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
}
_WHAT_TO_DO = (
    "Run the agent on Linux 5.13 or newer with Landlock and seccomp (`python -m device_agent doctor` says what is "
    "missing), or, if you trust every script, write `allow_unconfined_scripts = true` into its agent.toml."
)
_ENDINGS = {
    -31: "it tried something that no script may",  # SIGSYS; by number, since Windows has none of these
    -9: "it used up its processor time, or the machine's memory",
    -11: "it crashed",
}
_log = logging.getLogger(__name__)
_Task = dict[str, Any]
"""What a parent is asked: a process with these layers and limits, or how one has ended."""


class SandboxHost:
    """``Jail``: forks from warm parents.

    Args:
        trusted: Run scripts also where the kernel lacks a layer, with those that there are.
        layers: The layers to apply; fewer than all only where tests show what they are for.
    """

    def __init__(self, *, trusted: bool = False, layers: Sequence[str] = LAYERS) -> None:
        self._trusted = trusted
        self._layers = tuple(layers)
        self._own = _WarmParent(tuple)
        self._walled = _WarmParent(_bubblewrap)
        self._lock = threading.Lock()

    def start(self) -> None:
        """See ``Jail``."""
        standing = self.standing()
        if standing.how != "sandboxed":
            _log.warning("movement scripts are %s: %s", standing.how, standing.why)
        if standing.how != "unavailable":
            self._prepare(self._own, self._task(self._own, Limits()))

    def standing(self) -> SandboxStatus:
        """See ``Jail``."""
        refusal = self.refusal(stranger=False)
        if refusal is not None:
            return SandboxStatus("unavailable", refusal)
        return SandboxStatus("unconfined", self._lack(self._own)) if self._own.missing else SandboxStatus("sandboxed")

    def refusal(self, *, stranger: bool) -> str | None:
        """See ``Jail``."""
        if sys.platform != "linux":
            return f"scripts run on Linux only, not on {sys.platform}. Move joints by hand, or move the agent."
        with self._lock:
            try:
                self._own.start()
            except JailError as error:
                return str(error)
        if self._own.missing and not self._trusted:
            return f"{self._lack(self._own)} {_WHAT_TO_DO}"
        if stranger and shutil.which("bwrap") is None:
            return (
                "scripts of other accounts than the robot's own need bubblewrap, which is not installed. Install it "
                "(Debian: apt-get install bubblewrap), or save the movement with the account the robot is paired with."
            )
        return None

    @property
    def missing(self) -> dict[str, str]:
        """Layer → why this machine has it not; known after ``start``."""
        return dict(self._own.missing)

    def open(self, limits: Limits, *, stranger: bool) -> SandboxProcess:
        """See ``Jail``."""
        refusal = self.refusal(stranger=stranger)
        if refusal is not None:
            raise JailError(refusal)
        parent = self._walled if stranger else self._own
        with self._lock:
            parent.start()
            task = self._task(parent, limits)
            inmate = parent.take_ready(task) or self._fork(parent, task)
        later = threading.Timer(_PREPARE_AFTER_S, self._prepare, (parent, task))
        later.daemon = True
        later.start()
        return inmate

    def close(self) -> None:
        """See ``Jail``."""
        with self._lock:
            self._own.close()
            self._walled.close()

    def _prepare(self, parent: "_WarmParent", task: "_Task") -> None:
        """Have a process ready for the next script that is run like this one."""
        with self._lock, contextlib.suppress(JailError):
            if parent.runs and parent.ready is None:
                parent.ready = task, self._fork(parent, task)

    def _fork(self, parent: "_WarmParent", task: "_Task") -> "_Inmate":
        ours, theirs = socket.socketpair()
        try:
            with theirs:
                answer, descriptor = parent.ask(task, theirs)
        except JailError:
            ours.close()
            raise
        return _Inmate(parent, self._lock, ours, answer["pid"], descriptor)

    def _task(self, parent: "_WarmParent", limits: Limits) -> "_Task":
        return {"layers": self._layers_at(parent), "cpu_s": limits.cpu_s, "memory_bytes": limits.memory_bytes}

    def _layers_at(self, parent: "_WarmParent") -> list[str]:
        layers = [layer for layer in self._layers if layer not in parent.missing]
        if len(layers) < len(self._layers) and not self._trusted:
            raise JailError(f"{self._lack(parent)} {_WHAT_TO_DO}")
        return layers

    @staticmethod
    def _lack(parent: "_WarmParent") -> str:
        lacks = ", ".join(f"no {layer} ({why})" for layer, why in parent.missing.items())
        return f"this machine cannot lock scripts in: {lacks}."


class _WarmParent:
    """One warm parent process, started at need. Its owner locks.

    Args:
        wall: The command that it is started behind.

    Attributes:
        missing: Layer → why this machine has it not; known once started.
        ready: A process that waits for its script, and what it was asked for with.
    """

    def __init__(self, wall: Callable[[], tuple[str, ...]]) -> None:
        self._wall = wall
        self._process: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._itself = -1
        self.missing: dict[str, str] = {}
        self.ready: tuple[_Task, _Inmate] | None = None

    @property
    def runs(self) -> bool:
        """Whether it does."""
        return self._process is not None and self._process.poll() is None

    def start(self) -> None:
        """Start it unless it runs.

        Raises:
            JailError: It does not start.
        """
        if self.runs:
            return
        self.close()
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.settimeout(_START_S)
        with theirs:
            try:
                self._process = subprocess.Popen(  # noqa: S603 (our own file, run by our own interpreter)
                    [*self._wall(), sys.executable, "-I", "-B", str(_MAIN), str(theirs.fileno())],
                    pass_fds=(theirs.fileno(),),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    env=_ENVIRONMENT,
                    cwd="/",
                    start_new_session=True,
                )
            except OSError as error:
                ours.close()
                raise JailError(f"the jail of scripts does not start ({error}); is Python still installed?") from error
        self._control = ours
        hello, self._itself = self._receive(ours)
        self.missing = hello["missing"]
        ours.settimeout(_ANSWER_S)

    def take_ready(self, task: "_Task") -> "_Inmate | None":
        """The process that is ready, if it is for such a task and lives."""
        ready, self.ready = self.ready, None
        if ready is None:
            return None
        made_for, inmate = ready
        if made_for == task and not inmate.wait(0):
            return inmate
        inmate.close()
        return None

    def ask(self, task: "_Task", link: socket.socket | None = None) -> tuple[dict[str, Any], int]:
        """One request and its answer.

        Returns:
            The answer, and the descriptor that came with it, or -1.

        Raises:
            JailError: It cannot, or does not answer: then it is ended, and the next request starts another.
        """
        if self._control is None:
            raise JailError("the jail of scripts has ended; try again")
        try:
            socket.send_fds(self._control, [json.dumps(task).encode()], [] if link is None else [link.fileno()])
        except OSError as error:
            self.close()
            raise JailError(f"the jail of scripts has ended ({error}); try again") from error
        answer, descriptor = self._receive(self._control)
        if "error" in answer:
            raise JailError(answer["error"])
        return answer, descriptor

    def close(self) -> None:
        """End it and its children. May be called twice."""
        ready, self.ready = self.ready, None
        if ready is not None:
            ready[1].close()
        if self._control is not None:
            self._control.close()
            self._control = None
        if self._itself >= 0:
            with contextlib.suppress(OSError):
                signal.pidfd_send_signal(self._itself, signal.SIGKILL)
            os.close(self._itself)
            self._itself = -1
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def _receive(self, control: socket.socket) -> tuple[dict[str, Any], int]:
        try:
            message, descriptors, _, _ = socket.recv_fds(control, LONGEST_MESSAGE, 1)
            answer: dict[str, Any] = json.loads(message)
        except (OSError, ValueError) as error:
            self.close()
            raise JailError("the jail of scripts does not answer; try again, and look at the agent's log") from error
        return answer, descriptors[0] if descriptors else -1


class _Inmate:
    """``SandboxProcess``: known by a descriptor of its process, so that no other can be killed in its place."""

    def __init__(
        self, parent: _WarmParent, lock: threading.Lock, link: socket.socket, pid: int, descriptor: int
    ) -> None:
        self.link = link
        self.pid = pid
        self._parent = parent
        self._parent_lock = lock
        self._descriptor = descriptor
        self._lock = threading.Lock()
        self._killed = False

    def kill(self) -> None:
        """See ``SandboxProcess``."""
        with self._lock:
            self._killed = True
            if self._descriptor >= 0:
                with contextlib.suppress(OSError):
                    signal.pidfd_send_signal(self._descriptor, signal.SIGKILL)

    def wait(self, timeout_s: float) -> bool:
        """See ``SandboxProcess``."""
        waiting = select.poll()
        waiting.register(self._descriptor, select.POLLIN)
        return bool(waiting.poll(timeout_s * 1000))

    def ending(self) -> str:
        """See ``SandboxProcess``."""
        if self._killed:
            return ""
        try:
            with self._parent_lock:
                status = self._parent.ask({"ended": self.pid})[0]["status"]
        except JailError:
            return "the jail of scripts has ended"
        return _ENDINGS.get(status, "" if status in {0, 1, None} else f"it ended with {status}")

    def close(self) -> None:
        """See ``SandboxProcess``."""
        self.kill()
        self.link.close()
        if self._descriptor >= 0 and not self.wait(_DEAD_S):
            _log.error("the process of a script does not die")
        with self._lock:
            if self._descriptor >= 0:
                os.close(self._descriptor)
                self._descriptor = -1


def _bubblewrap() -> tuple[str, ...]:
    """A world with this Python in it and nothing else: no home, no /proc, no network, no other process."""
    numpy = importlib.util.find_spec("numpy")
    folders = [sys.prefix, sys.base_prefix, str(_MAIN.parent), str(_MAIN.parent.parent / "__init__.py")]
    if numpy is not None and numpy.origin is not None:
        folders.append(str(Path(numpy.origin).parent.parent))
    own = [part for folder in dict.fromkeys(folders) for part in ("--ro-bind", folder, folder)]
    system = [part for folder in _SYSTEM for part in ("--ro-bind-try", folder, folder)]
    # Root needs no user namespace, and only outside of one can its scripts become another user.
    powers = ("--cap-add", "CAP_SETUID", "--cap-add", "CAP_SETGID", "--cap-add", "CAP_SETPCAP")
    walls = ("--unshare-ipc", "--unshare-pid", "--unshare-net", "--unshare-uts", "--unshare-cgroup-try")
    user = powers if os.geteuid() == 0 else ("--unshare-user",)
    return (
        "bwrap",
        *walls,
        *user,
        "--dev-bind",
        "/dev/null",
        "/dev/null",
        "--new-session",
        "--clearenv",
        *_variables(),
        *system,
        *own,
        "--",
    )


def _variables() -> tuple[str, ...]:
    return tuple(part for name, value in _ENVIRONMENT.items() for part in ("--setenv", name, value))


_SYSTEM = (
    "/usr/lib",
    "/usr/lib64",
    "/usr/bin",
    "/usr/sbin",
    "/sbin",
    "/lib",
    "/lib64",
    "/etc/ld.so.cache",
    "/etc/localtime",
)
