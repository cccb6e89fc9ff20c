"""Agent side of the sandbox: keeps a zygote running, and a second one in bubblewrap for untrusted scripts.

Each zygote has one confined process ready: forking and confining takes 7 ms, a third of the time from an operator's
click to the first motion. A process runs one script only.
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

from device_agent.ports.sandbox import Limits, SandboxError, SandboxProcess, SandboxStatus
from device_agent.sandbox.constants import LAYERS, MAX_MESSAGE

_MAIN = Path(__file__).with_name("__main__.py")
_START_S = 60.0
"""Timeout of a zygote's start [s]; importing NumPy takes 0.3 s on an idle machine."""
_RESPONSE_S = 5.0
_PREPARE_AFTER_S = 0.5
"""Delay before preparing the next process [s], so that a starting script has the processor."""
_KILL_TIMEOUT_S = 5.0
"""Maximum time for a killed process to end [s]."""
_ENVIRONMENT = {
    "LANG": "C.UTF-8",
    # A script process cannot start threads, and threads do not survive a fork.
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
}
_REMEDY = (
    "Run the agent on Linux 5.13 or newer with Landlock and seccomp (`python -m device_agent doctor` lists what is "
    "missing). If you trust all scripts, set `allow_unconfined_scripts = true` in agent.toml."
)
_ENDINGS = {
    -31: "it made a forbidden system call",  # SIGSYS; as numbers, because Windows has none of these signals
    -9: "it used up its processor time, or the machine's memory",
    -11: "it crashed",
}
_log = logging.getLogger(__name__)
_Task = dict[str, Any]
"""A request to a zygote: start a process with these layers and limits, or return the exit code of one."""


class SandboxHost:
    """Implements ``ports.sandbox.Sandbox`` with forks of zygotes.

    Args:
        allow_unconfined: Run scripts even if the kernel lacks a layer, with the layers that it has.
        layers: Layers to apply; only tests use fewer than all.
    """

    def __init__(self, *, allow_unconfined: bool = False, layers: Sequence[str] = LAYERS) -> None:
        self._allow_unconfined = allow_unconfined
        self._layers = tuple(layers)
        self._own = _Zygote(tuple)
        self._wrapped = _Zygote(_bubblewrap)
        self._lock = threading.Lock()

    def start(self) -> None:
        """Implements ``Sandbox``."""
        status = self.status()
        if status.mode != "sandboxed":
            _log.warning("movement scripts are %s: %s", status.mode, status.reason)
        if status.mode != "unavailable":
            self._prepare(self._own, self._task(self._own, Limits()))

    def status(self) -> SandboxStatus:
        """Implements ``Sandbox``."""
        refusal = self.refusal(untrusted=False)
        if refusal is not None:
            return SandboxStatus("unavailable", refusal)
        return (
            SandboxStatus("unconfined", self._lack_message(self._own))
            if self._own.missing
            else SandboxStatus("sandboxed")
        )

    def refusal(self, *, untrusted: bool) -> str | None:
        """Implements ``Sandbox``."""
        if sys.platform != "linux":
            return f"scripts run on Linux only, not on {sys.platform}. Run the agent on Linux to use scripts."
        with self._lock:
            try:
                self._own.start()
            except SandboxError as error:
                return str(error)
        if self._own.missing and not self._allow_unconfined:
            return f"{self._lack_message(self._own)} {_REMEDY}"
        return self._bubblewrap_refusal() if untrusted else None

    def _bubblewrap_refusal(self) -> str | None:
        need = "scripts of accounts other than the robot's owner need bubblewrap, which"
        otherwise = "or save the movement with the owner's account."
        if shutil.which("bwrap") is None:
            return f"{need} is not installed. Install it (Debian: apt-get install bubblewrap), {otherwise}"
        with self._lock:
            try:
                self._wrapped.start()
            except SandboxError:
                return (
                    f"{need} cannot start on this machine. Run `bwrap --ro-bind / / true` to see the cause (chroots "
                    f"and containers often do not allow namespaces), {otherwise}"
                )
        return None

    @property
    def missing(self) -> dict[str, str]:
        """Layer → why this machine lacks it; known after ``start``."""
        return dict(self._own.missing)

    def open(self, limits: Limits, *, untrusted: bool) -> SandboxProcess:
        """Implements ``Sandbox``."""
        refusal = self.refusal(untrusted=untrusted)
        if refusal is not None:
            raise SandboxError(refusal)
        zygote = self._wrapped if untrusted else self._own
        with self._lock:
            zygote.start()
            task = self._task(zygote, limits)
            process = zygote.take_ready(task) or self._fork(zygote, task)
        timer = threading.Timer(_PREPARE_AFTER_S, self._prepare, (zygote, task))
        timer.daemon = True
        timer.start()
        return process

    def close(self) -> None:
        """Implements ``Sandbox``."""
        with self._lock:
            self._own.close()
            self._wrapped.close()

    def _prepare(self, zygote: "_Zygote", task: "_Task") -> None:
        """Prepare a process for the next script with the same limits."""
        with self._lock, contextlib.suppress(SandboxError):
            if zygote.runs and zygote.ready is None:
                zygote.ready = task, self._fork(zygote, task)

    def _fork(self, zygote: "_Zygote", task: "_Task") -> "_HostedProcess":
        own_end, child_end = socket.socketpair()
        try:
            with child_end:
                response, descriptor = zygote.request(task, child_end)
        except SandboxError:
            own_end.close()
            raise
        return _HostedProcess(zygote, self._lock, own_end, response["pid"], descriptor)

    def _task(self, zygote: "_Zygote", limits: Limits) -> "_Task":
        return {"layers": self._layers_at(zygote), "cpu_s": limits.cpu_s, "memory_bytes": limits.memory_bytes}

    def _layers_at(self, zygote: "_Zygote") -> list[str]:
        layers = [layer for layer in self._layers if layer not in zygote.missing]
        if len(layers) < len(self._layers) and not self._allow_unconfined:
            raise SandboxError(f"{self._lack_message(zygote)} {_REMEDY}")
        return layers

    @staticmethod
    def _lack_message(zygote: "_Zygote") -> str:
        lacks = ", ".join(f"no {layer} ({reason})" for layer, reason in zygote.missing.items())
        return f"this machine cannot confine scripts: {lacks}."


class _Zygote:
    """One zygote process, started on demand, in a process that ``wrapper`` names. The owner synchronizes access.

    Attributes:
        missing: Layer → why this machine lacks it; known once started.
        ready: A prepared process and the task for which it was prepared.
    """

    def __init__(self, wrapper: Callable[[], tuple[str, ...]]) -> None:
        self._wrapper = wrapper
        self._process: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._pidfd = -1
        self.missing: dict[str, str] = {}
        self.ready: tuple[_Task, _HostedProcess] | None = None

    @property
    def runs(self) -> bool:
        """Whether the process is alive."""
        return self._process is not None and self._process.poll() is None

    def start(self) -> None:
        """Start the process unless it is alive.

        Raises:
            SandboxError: It does not start.
        """
        if self.runs:
            return
        self.close()
        own_end, child_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        own_end.settimeout(_START_S)
        with child_end:
            try:
                self._process = subprocess.Popen(  # noqa: S603 (a file of this package, run by this interpreter)
                    [*self._wrapper(), sys.executable, "-I", "-B", str(_MAIN), str(child_end.fileno())],
                    pass_fds=(child_end.fileno(),),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    env=_ENVIRONMENT,
                    cwd="/",
                    start_new_session=True,
                )
            except OSError as error:
                own_end.close()
                raise SandboxError(
                    f"the script sandbox does not start ({error}); check the Python installation"
                ) from error
        self._control = own_end
        report, self._pidfd = self._receive(own_end)
        self.missing = report["missing"]
        own_end.settimeout(_RESPONSE_S)

    def take_ready(self, task: "_Task") -> "_HostedProcess | None":
        """The prepared process, if it matches the task and is alive."""
        ready, self.ready = self.ready, None
        if ready is None:
            return None
        prepared_for, process = ready
        if prepared_for == task and not process.wait(0):
            return process
        process.close()
        return None

    def request(self, task: "_Task", link: socket.socket | None = None) -> tuple[dict[str, Any], int]:
        """Send one request.

        Returns:
            The response, and the descriptor sent with it, or -1.

        Raises:
            SandboxError: The zygote rejects the request or does not respond. It is then killed, and the next request
                starts another.
        """
        if self._control is None:
            raise SandboxError("the script sandbox has ended; try again")
        try:
            socket.send_fds(self._control, [json.dumps(task).encode()], [] if link is None else [link.fileno()])
        except OSError as error:
            self.close()
            raise SandboxError(f"the script sandbox has ended ({error}); try again") from error
        response, descriptor = self._receive(self._control)
        if "error" in response:
            raise SandboxError(response["error"])
        return response, descriptor

    def close(self) -> None:
        """Kill the process and its children. Callable repeatedly."""
        ready, self.ready = self.ready, None
        if ready is not None:
            ready[1].close()
        if self._control is not None:
            self._control.close()
            self._control = None
        if self._pidfd >= 0:
            with contextlib.suppress(OSError):
                signal.pidfd_send_signal(self._pidfd, signal.SIGKILL)
            os.close(self._pidfd)
            self._pidfd = -1
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def _receive(self, control: socket.socket) -> tuple[dict[str, Any], int]:
        try:
            message, descriptors, _, _ = socket.recv_fds(control, MAX_MESSAGE, 1)
            response: dict[str, Any] = json.loads(message)
        except (OSError, ValueError) as error:
            self.close()
            raise SandboxError("the script sandbox does not respond; try again, and check the agent's log") from error
        return response, descriptors[0] if descriptors else -1


class _HostedProcess:
    """Implements ``SandboxProcess``; identified by a pidfd, so that no other process can be killed by mistake."""

    def __init__(self, zygote: _Zygote, lock: threading.Lock, link: socket.socket, pid: int, descriptor: int) -> None:
        self.link = link
        self.pid = pid
        self._zygote = zygote
        self._zygote_lock = lock
        self._descriptor = descriptor
        self._lock = threading.Lock()
        self._killed = False

    def kill(self) -> None:
        """Implements ``SandboxProcess``."""
        with self._lock:
            self._killed = True
            if self._descriptor >= 0:
                with contextlib.suppress(OSError):
                    signal.pidfd_send_signal(self._descriptor, signal.SIGKILL)

    def wait(self, timeout_s: float) -> bool:
        """Implements ``SandboxProcess``."""
        poll = select.poll()
        poll.register(self._descriptor, select.POLLIN)
        return bool(poll.poll(timeout_s * 1000))

    def ending(self) -> str:
        """Implements ``SandboxProcess``."""
        if self._killed:
            return ""
        try:
            with self._zygote_lock:
                status = self._zygote.request({"ended": self.pid})[0]["status"]
        except SandboxError:
            return "the script sandbox has ended"
        return _ENDINGS.get(status, "" if status in {0, 1, None} else f"it ended with {status}")

    def close(self) -> None:
        """Implements ``SandboxProcess``."""
        self.kill()
        self.link.close()
        if self._descriptor >= 0 and not self.wait(_KILL_TIMEOUT_S):
            _log.error("the process of a script does not end after SIGKILL")
        with self._lock:
            if self._descriptor >= 0:
                os.close(self._descriptor)
                self._descriptor = -1


def _bubblewrap() -> tuple[str, ...]:
    """A wrapper that shows only Python and system libraries: no home, /proc, network or other processes."""
    numpy = importlib.util.find_spec("numpy")
    folders = [sys.prefix, sys.base_prefix, str(_MAIN.parent), str(_MAIN.parent.parent / "__init__.py")]
    if numpy is not None and numpy.origin is not None:
        folders.append(str(Path(numpy.origin).parent.parent))
    own = [part for folder in dict.fromkeys(folders) for part in ("--ro-bind", folder, folder)]
    system = [part for folder in _SYSTEM for part in ("--ro-bind-try", folder, folder)]
    # Root needs no user namespace, and its scripts can change the user only outside of one.
    capabilities = ("--cap-add", "CAP_SETUID", "--cap-add", "CAP_SETGID", "--cap-add", "CAP_SETPCAP")
    namespaces = ("--unshare-ipc", "--unshare-pid", "--unshare-net", "--unshare-uts", "--unshare-cgroup-try")
    user = capabilities if os.geteuid() == 0 else ("--unshare-user",)
    null = ("--dev-bind", "/dev/null", "/dev/null")
    variables = [part for name, value in _ENVIRONMENT.items() for part in ("--setenv", name, value)]
    return ("bwrap", *namespaces, *user, *null, "--new-session", "--clearenv", *variables, *system, *own, "--")


_SYSTEM = (
    *("/usr/lib", "/usr/lib64", "/usr/bin", "/usr/sbin", "/sbin", "/lib", "/lib64"),
    *("/etc/ld.so.cache", "/etc/localtime"),
)
