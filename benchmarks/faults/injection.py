"""Faults that last for some time, by name: how each begins and how it is repaired."""

import contextlib
import os
import resource
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Final

import msgspec

from benchmarks.faults.crowd import CROWD, Crowd
from benchmarks.faults.launcher import ProcessFaults, faults_file
from benchmarks.faults.processes import ProductProcesses
from infra.local.supervisor import SupervisedProcess

DISK_FULL: Final = "agent's disk full"
Fault = tuple[Callable[[], object], Callable[[], object]]
_HOUR_S: Final = 3600.0
_CLOCKS: Final = {"an hour ahead": _HOUR_S, "an hour back": -_HOUR_S, "400 days ahead": 400 * 24 * _HOUR_S}
_RTT_MS: Final = 100.0
_LOSS: Final = 0.02


class Injection:
    """Injects faults into the processes of a product.

    Args:
        product: The product.
        crowd: Devices and clients for the fault ``CROWD``.
    """

    def __init__(self, product: ProductProcesses, crowd: Crowd) -> None:
        self._product = product
        self._limits: list[tuple[int, int, tuple[int, int]]] = []
        self.faults: dict[str, Fault] = {
            f"{_RTT_MS:g} ms round trip": (lambda: self._network(rtt_ms=_RTT_MS), self._network),
            f"{_LOSS:.0%} packet loss, retransmitted after 200 ms": (lambda: self._network(loss=_LOSS), self._network),
            "worker killed": (self._kill_worker, self._restart_exited),
            "server's tables read-only": self._inside("functions", "worker", faults=ProcessFaults(read_only=True)),
            "server's disk full": self._limited(resource.RLIMIT_FSIZE, "functions", "worker"),
        }
        for name, clock_s in _CLOCKS.items():
            faults = ProcessFaults(clock_s=clock_s)
            self.faults[f"server's clock {name}"] = self._inside("functions", "worker", "broker", faults=faults)
            self.faults[f"agent's clock {name}"] = self._inside("agent", faults=faults)
        for program in ("functions", "worker", "agent"):
            self.faults[f"no more memory for the {program}"] = self._limited(resource.RLIMIT_AS, program)
        for program in ("functions", "worker", "broker", "agent"):
            self.faults[f"no more descriptors for the {program}"] = self._limited(resource.RLIMIT_NOFILE, program)
        self.faults[DISK_FULL] = self._limited(resource.RLIMIT_FSIZE, "agent")
        self.faults[CROWD] = crowd.begin, crowd.end

    def _network(self, *, rtt_ms: float = 0.0, loss: float = 0.0) -> None:
        self._product.network.set(rtt_ms=rtt_ms, loss=loss)

    def _kill_worker(self) -> None:
        self._product.signal(self._product.worker, signal.SIGKILL)

    def _restart_exited(self) -> None:
        """Restarts programs that have exited, as the supervisor does."""
        product = self._product
        for child in (product.broker, product.functions, product.worker, product.agent):
            if child.exited:
                product.restart(child)

    # ------------------------------------------------------------ inside a process

    def _inside(self, *programs: str, faults: ProcessFaults) -> Fault:
        return lambda: self._set(programs, faults), lambda: self._set(programs, ProcessFaults())

    def _set(self, programs: tuple[str, ...], faults: ProcessFaults) -> None:
        for program in programs:
            if not self._child(program).exited:
                process = self._pid(program)
                faults_file(self._product.home, process).write_bytes(msgspec.json.encode(faults))
                os.kill(process, signal.SIGUSR1)
        self._restart_exited()

    # ------------------------------------------------------------ resource limits

    def _limited(self, kind: int, *programs: str) -> Fault:
        return lambda: self._limit(kind, programs), self._unlimit

    def _limit(self, kind: int, programs: tuple[str, ...]) -> None:
        """Limits a resource to the present use, so that each further use fails."""
        for program in programs:
            process = self._pid(program)
            before = resource.prlimit(process, kind)
            self._limits.append((process, kind, before))
            resource.prlimit(process, kind, (min(_used(kind, process), before[1]), before[1]))

    def _unlimit(self) -> None:
        while self._limits:
            process, kind, before = self._limits.pop()
            with contextlib.suppress(ProcessLookupError):  # the program has exited
                resource.prlimit(process, kind, before)
        self._restart_exited()

    def _child(self, program: str) -> SupervisedProcess:
        child: SupervisedProcess = getattr(self._product, program)
        return child

    def _pid(self, program: str) -> int:
        return self._product.pid(self._child(program))


def _used(kind: int, process: int) -> int:
    """Returns the present use of a resource by a process: address space [bytes], or the lowest free descriptor."""
    folder = Path(f"/proc/{process}")
    if kind == resource.RLIMIT_AS:
        return int((folder / "statm").read_text().split()[0]) * resource.getpagesize()
    if kind == resource.RLIMIT_NOFILE:
        opened = {int(each.name) for each in (folder / "fd").iterdir()}
        return next(number for number in range(len(opened) + 1) if number not in opened)
    return 0
