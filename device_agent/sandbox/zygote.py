"""The zygote: a clean process with the modules of scripts, which forks one process per script.

It starts without environment, descriptors or memory of the agent, and has one thread. Requests arrive over one socket
(a JSON object and the script's socket). The response contains the child's process id and a pidfd, by which the agent
can kill it without a race. When the agent ends, the socket closes, and the zygote ends with all its children.
"""

import contextlib
import gc
import json
import os
import resource
import select
import signal
import socket
import sys
import time
from collections.abc import Callable
from typing import Any, NoReturn

from device_agent.sandbox import confinement, importable_modules, landlock, privileges, script_process, seccomp
from device_agent.sandbox.constants import LANDLOCK, MAX_MESSAGE, SECCOMP

_MAX_EXIT_CODES = 1000


def main(control: int) -> NoReturn:
    """Serve requests until the agent ends."""
    os.dup2(control, confinement.LINK)
    os.closerange(confinement.LINK + 1, control + 1)
    resource.setrlimit(resource.RLIMIT_NOFILE, (confinement.MAX_DESCRIPTORS, confinement.MAX_DESCRIPTORS))
    importable_modules.load()
    time.localtime()  # loads the time zone file
    zygote = _Zygote(socket.socket(fileno=confinement.LINK))
    gc.collect()
    gc.freeze()  # children share these pages until they are written
    zygote.serve()
    os._exit(0)


class _Zygote:
    def __init__(self, control: socket.socket) -> None:
        self._control = control
        self._children: dict[int, int] = {}  # descriptor of the process → process id
        self._exit_codes: dict[int, int] = {}
        self._waiting = select.poll()
        self._missing: dict[str, str] = {}
        self._filter: seccomp.Filter | None = None
        try:
            self._filter = seccomp.build()
        except (ImportError, RuntimeError, OSError) as error:
            self._missing[SECCOMP] = str(error)
        self._probe(LANDLOCK, landlock.restrict)
        if self._filter is not None:
            self._probe(SECCOMP, self._filter.load)

    def _probe(self, layer: str, apply: Callable[[], None]) -> None:
        """Apply a layer in a test process. If that succeeds, it succeeds for scripts."""
        pid = os.fork()
        if pid == 0:
            try:
                privileges.renounce()
                apply()
                os._exit(0)
            finally:
                os._exit(1)
        if os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) != 0:
            self._missing[layer] = f"the kernel does not have it; Landlock ABI {landlock.abi()}"

    def serve(self) -> None:
        """Report the available layers, then serve requests."""
        self._report_layers()
        self._waiting.register(self._control, select.POLLIN)
        while True:
            for descriptor, _ in self._waiting.poll():
                if descriptor == self._control.fileno():
                    self._serve_request()
                else:
                    self._reap(descriptor)

    def _report_layers(self) -> None:
        own = os.pidfd_open(os.getpid())
        report = {"missing": self._missing, "landlock": landlock.abi(), "python": sys.version.split()[0]}
        self._reply(report, own)
        os.close(own)

    def _serve_request(self) -> None:
        """Serve one request."""
        try:
            message, descriptors, _, _ = socket.recv_fds(self._control, MAX_MESSAGE, 1)
        except OSError:
            message, descriptors = b"", []
        if not message:
            self._end()
        task: dict[str, Any] = json.loads(message)
        if "ended" in task:
            self._reply_exit_code(task["ended"])
            return
        (link,) = descriptors
        self._fork(link, task)
        os.close(link)

    def _reply_exit_code(self, pid: int) -> None:
        for child in [child for child, child_pid in self._children.items() if child_pid == pid]:
            self._reap(child)  # the agent has seen its end before this process
        self._reply({"status": self._exit_codes.pop(pid, None)})

    def _fork(self, link: int, task: dict[str, Any]) -> None:
        parent = os.getpid()
        try:
            pid = os.fork()
        except OSError as error:
            self._reply({"error": f"no process can be started for the script ({error.strerror})"})
            return
        if pid == 0:
            self._run_script(link, parent, task)
        child = os.pidfd_open(pid)
        self._children[child] = pid
        self._waiting.register(child, select.POLLIN)
        self._reply({"pid": pid}, child)

    def _run_script(self, link: int, parent: int, task: dict[str, Any]) -> NoReturn:
        try:
            script_process.prepare()
            try:
                confinement.enter(link, parent, task, self._filter)
            except confinement.Unconfined as error:
                script_process.report_unfit(str(error))
            else:
                script_process.main()
        except BaseException:  # noqa: BLE001, S110 (a forked child must never return into the parent's loop)
            pass
        finally:
            os._exit(1)

    def _reap(self, child: int) -> None:
        pid = self._children.pop(child, 0)
        if not pid:
            return
        self._waiting.unregister(child)
        os.close(child)
        _, status = os.waitpid(pid, 0)
        self._exit_codes[pid] = os.waitstatus_to_exitcode(status)
        while len(self._exit_codes) > _MAX_EXIT_CODES:
            del self._exit_codes[next(iter(self._exit_codes))]

    def _reply(self, message: dict[str, Any], *descriptors: int) -> None:
        try:
            socket.send_fds(self._control, [json.dumps(message).encode()], descriptors)
        except OSError:
            self._end()

    def _end(self) -> NoReturn:
        """Kill all children and exit, because the agent has ended."""
        for child in self._children:
            with contextlib.suppress(OSError):
                signal.pidfd_send_signal(child, signal.SIGKILL)
        os._exit(0)
