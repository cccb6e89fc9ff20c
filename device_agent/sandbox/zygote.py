"""The warm parent: a clean process that has imported what scripts need, and forks one process for each script.

It is started once, afresh, without environment, descriptors or memory of the agent's, and has one thread. Asked over
one socket (a JSON object and the script's socket in each message) it answers with the child's process id and a
descriptor of the process, by which the agent kills it whatever becomes of the number. When the agent goes, the socket
ends, and with it this process and its children.
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

from device_agent.sandbox import confinement, importable_modules, landlock, script_process, seccomp
from device_agent.sandbox.constants import LANDLOCK, LONGEST_MESSAGE, SECCOMP

_MOST_ENDINGS = 1000


def main(control: int) -> NoReturn:
    """Serve until the agent goes."""
    os.dup2(control, confinement.LINK)
    os.closerange(confinement.LINK + 1, control + 1)
    resource.setrlimit(resource.RLIMIT_NOFILE, (confinement.MOST_DESCRIPTORS, confinement.MOST_DESCRIPTORS))
    importable_modules.load()
    time.localtime()  # reads the time zone's file now
    parent = _Parent(socket.socket(fileno=confinement.LINK))
    gc.collect()
    gc.freeze()  # the children share these pages as long as nobody writes to them
    parent.serve()
    os._exit(0)


class _Parent:
    def __init__(self, control: socket.socket) -> None:
        self._control = control
        self._children: dict[int, int] = {}  # descriptor of the process → process id
        self._endings: dict[int, int] = {}
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
        """Put a layer on a process that is for nothing else: what works once will for scripts."""
        pid = os.fork()
        if pid == 0:
            try:
                confinement.give_up_privileges()
                apply()
                os._exit(0)
            finally:
                os._exit(1)
        if os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) != 0:
            self._missing[layer] = f"the kernel does not have it; Landlock ABI {landlock.abi()}"

    def serve(self) -> None:
        """Introduce, then answer one request after another."""
        self._introduce()
        self._waiting.register(self._control, select.POLLIN)
        while True:
            for descriptor, _ in self._waiting.poll():
                if descriptor == self._control.fileno():
                    self._answer()
                else:
                    self._bury(descriptor)

    def _introduce(self) -> None:
        own = os.pidfd_open(os.getpid())
        hello = {"missing": self._missing, "landlock": landlock.abi(), "python": sys.version.split()[0]}
        self._reply(hello, own)
        os.close(own)

    def _answer(self) -> None:
        """Do what one message asks."""
        try:
            message, descriptors, _, _ = socket.recv_fds(self._control, LONGEST_MESSAGE, 1)
        except OSError:
            message, descriptors = b"", []
        if not message:
            self._end()
        task: dict[str, Any] = json.loads(message)
        if "ended" in task:
            self._tell_ending(task["ended"])
            return
        (link,) = descriptors
        self._fork(link, task)
        os.close(link)

    def _tell_ending(self, pid: int) -> None:
        for child in [child for child, known in self._children.items() if known == pid]:
            self._bury(child)  # the agent knows it dead; this process had not looked yet
        self._reply({"status": self._endings.pop(pid, None)})

    def _fork(self, link: int, task: dict[str, Any]) -> None:
        parent = os.getpid()
        try:
            pid = os.fork()
        except OSError as error:
            self._reply({"error": f"no process can be started for the script ({error.strerror})"})
            return
        if pid == 0:
            self._become_script(link, parent, task)
        child = os.pidfd_open(pid)
        self._children[child] = pid
        self._waiting.register(child, select.POLLIN)
        self._reply({"pid": pid}, child)

    def _become_script(self, link: int, parent: int, task: dict[str, Any]) -> NoReturn:
        try:
            script_process.prepare()
            try:
                confinement.enter(link, parent, task, self._filter)
            except confinement.Unconfined as error:
                script_process.give_up(str(error))
            else:
                script_process.main()
        except BaseException:  # noqa: BLE001, S110 (a forked child must never return into the parent's loop)
            pass
        finally:
            os._exit(1)

    def _bury(self, child: int) -> None:
        pid = self._children.pop(child, 0)
        if not pid:
            return
        self._waiting.unregister(child)
        os.close(child)
        _, status = os.waitpid(pid, 0)
        self._endings[pid] = os.waitstatus_to_exitcode(status)
        while len(self._endings) > _MOST_ENDINGS:
            del self._endings[next(iter(self._endings))]

    def _reply(self, message: dict[str, Any], *descriptors: int) -> None:
        try:
            socket.send_fds(self._control, [json.dumps(message).encode()], descriptors)
        except OSError:
            self._end()

    def _end(self) -> NoReturn:
        """The agent has gone: nothing of it stays."""
        for child in self._children:
            with contextlib.suppress(OSError):
                signal.pidfd_send_signal(child, signal.SIGKILL)
        os._exit(0)
