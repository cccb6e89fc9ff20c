"""Replaces clocks, threads, random numbers and disks in the modules of the product during one simulation."""

import logging
import queue
import random
import secrets
import sqlite3
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FunctionType, ModuleType, SimpleNamespace
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from device_agent.protocol.security import signing
from tests.simulation.engine import disk, threads
from tests.simulation.engine.scheduler import EPOCH_MS, Scheduler, current_process

_PACKAGES = ("device_agent", "function_app", "tests.fakes")


class Clocks:
    """The clocks of all machines.

    Attributes:
        cloud_offset_ms: Error of the cloud's wall clock [ms].
    """

    def __init__(self, scheduler: Scheduler) -> None:
        self._loop = scheduler.loop
        self.cloud_offset_ms = 0

    def now_ms(self) -> int:
        """The cloud's wall clock [ms since 1970]."""
        return EPOCH_MS + round(self._loop.time() * 1000) + self.cloud_offset_ms

    def monotonic_ns(self) -> int:
        process = current_process()
        offset_s = 1000.0 if process is None else process.monotonic_offset_s
        return round((self._loop.time() + offset_s) * 1e9)

    def wall_ns(self) -> int:
        process = current_process()
        offset_ms = self.cloud_offset_ms if process is None else process.wall_offset_ms
        return EPOCH_MS * 1_000_000 + round(self._loop.time() * 1e9) + offset_ms * 1_000_000


@contextmanager
def simulated(scheduler: Scheduler, clocks: Clocks, rng: random.Random) -> Iterator[SimpleNamespace]:
    """Replace the modules within a ``with`` block; yields the simulated ``threading`` and ``queue``."""
    threading_, queue_ = threads.namespaces(scheduler)
    replacements: dict[int, Any] = {
        id(threading): threading_,
        id(queue): queue_,
        id(time): _time_namespace(scheduler, clocks),
        id(secrets): _secrets_namespace(rng),
        id(random): rng,
        id(uuid): SimpleNamespace(uuid4=lambda: uuid.UUID(int=rng.getrandbits(128), version=4), UUID=uuid.UUID),
        id(sqlite3): disk.sqlite_namespace(scheduler.disk_access),
    }
    bound = {
        time.monotonic: replacements[id(time)].monotonic,
        threading.Event: threading_.Event,
        threading.Lock: threading_.Lock,
    }
    undo: list[Callable[[], None]] = []
    for name, module in sorted(sys.modules.items()):
        if name.startswith(_PACKAGES) and isinstance(module, ModuleType):
            for attribute, value in list(vars(module).items()):
                if id(value) in replacements and isinstance(value, ModuleType):
                    _replace(undo, module, attribute, replacements[id(value)])
                elif isinstance(value, type) and value.__module__ == name and name.startswith("device_agent"):
                    _replace_defaults(undo, value, bound)
    _replace(undo, sys.modules["device_agent.runtime.storage.journal"], "os", disk.os_namespace())
    _replace(undo, signing, "generate", lambda: Ed25519PrivateKey.from_private_bytes(rng.randbytes(32)))
    previous = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield SimpleNamespace(threading=threading_, queue=queue_)
    finally:
        logging.disable(previous)
        for restore in reversed(undo):
            restore()


def _replace(undo: list[Callable[[], None]], target: Any, attribute: str, value: Any) -> None:
    before = getattr(target, attribute)
    setattr(target, attribute, value)
    undo.append(lambda: setattr(target, attribute, before))


def _replace_defaults(undo: list[Callable[[], None]], owner: type, bound: dict[Any, Any]) -> None:
    """Replace functions that are defaults of parameters, or factories of the fields of a data class."""
    for method in vars(owner).values():
        if not isinstance(method, FunctionType):
            continue
        defaults = method.__kwdefaults__ or {}
        if any(_found(value, bound) for value in defaults.values()):
            replaced = {key: bound[value] if _found(value, bound) else value for key, value in defaults.items()}
            _replace(undo, method, "__kwdefaults__", replaced)
        for cell in method.__closure__ or ():
            if _found(cell.cell_contents, bound):
                _replace(undo, cell, "cell_contents", bound[cell.cell_contents])


def _found(value: Any, bound: dict[Any, Any]) -> bool:
    return callable(value) and any(value is each for each in bound)


def _time_namespace(scheduler: Scheduler, clocks: Clocks) -> SimpleNamespace:
    return SimpleNamespace(
        monotonic=lambda: clocks.monotonic_ns() / 1e9,
        monotonic_ns=clocks.monotonic_ns,
        perf_counter=lambda: clocks.monotonic_ns() / 1e9,
        perf_counter_ns=clocks.monotonic_ns,
        time=lambda: clocks.wall_ns() / 1e9,
        time_ns=clocks.wall_ns,
        sleep=lambda seconds: scheduler.block(None, seconds),
        gmtime=time.gmtime,
        strftime=time.strftime,
    )


def _secrets_namespace(rng: random.Random) -> SimpleNamespace:
    return SimpleNamespace(
        choice=rng.choice,
        randbelow=rng.randrange,
        randbits=rng.getrandbits,
        token_bytes=lambda count=32: rng.randbytes(count),
        token_hex=lambda count=32: rng.randbytes(count).hex(),
        token_urlsafe=lambda count=32: rng.randbytes(count).hex(),
        compare_digest=secrets.compare_digest,
    )
