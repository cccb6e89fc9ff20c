"""Confines the process of one script: limits, another user, no privileges, Landlock, seccomp, in this order.

Each requested layer is applied or raises: a script never runs with fewer layers than the agent expects.
"""

import contextlib
import ctypes
import os
import resource
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from device_agent.sandbox import landlock, seccomp
from device_agent.sandbox.constants import LANDLOCK, LIMITS, SECCOMP, USER

SCRIPT_USER = 61_000
"""User and group of scripts if the agent runs as root: unused by accounts, below the range of systemd."""
LINK = 3
"""Descriptor of the socket to the agent; 0 to 2 are the null device."""
MAX_DESCRIPTORS = 256
"""The zygote's descriptors are below this number."""
_NICENESS = 10
"""Scripts have a lower priority than the control loop."""
_SET_PARENT_DEATH_SIGNAL, _SET_DUMPABLE, _DROP_BOUNDING, _SET_NO_NEW_PRIVILEGES, _AMBIENT = 1, 4, 24, 38, 47
_AMBIENT_CLEAR_ALL = 4
_LAST_CAPABILITY = 63

_kernel = ctypes.CDLL(None, use_errno=True)


class Unconfined(Exception):  # noqa: N818 (named after the state of the process)
    """A layer could not be applied; the text names it."""


def enter(link: int, parent: int, task: Mapping[str, Any], filter_: seccomp.Filter | None) -> None:
    """Confine this process, which was just forked.

    Args:
        link: Socket to the agent; becomes descriptor ``LINK``. All others but the null device are closed.
        parent: Process id of the zygote; this process ends with it.
        task: ``layers`` to apply, ``cpu_s`` [s], ``memory_bytes``.
        filter_: The seccomp filter.

    Raises:
        Unconfined: A layer could not be applied.
    """
    os.setsid()
    _close_other_descriptors(link)
    steps: tuple[tuple[str, Callable[[], None]], ...] = (
        (LIMITS, lambda: _limit(task["cpu_s"], task["memory_bytes"])),
        (USER, _drop_privileges),
        (LANDLOCK, landlock.restrict),
    )
    for layer, apply in steps:
        if layer in task["layers"]:
            _try(layer, apply)
    # After the change of user, which clears the signal.
    _control(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != parent:
        raise Unconfined("the zygote has ended")
    if SECCOMP in task["layers"]:
        _try(SECCOMP, lambda: _lock(filter_))


def _try(layer: str, apply: Callable[[], None]) -> None:
    try:
        apply()
    except (OSError, ValueError) as error:
        raise Unconfined(f"{layer}: {error}") from error


def _close_other_descriptors(link: int) -> None:
    os.chdir("/")
    os.umask(0o077)
    if link != LINK:
        os.dup2(link, LINK)
    os.closerange(LINK + 1, MAX_DESCRIPTORS)


def _limit(cpu_s: int, memory_bytes: int) -> None:
    os.nice(_NICENESS)
    # If memory runs out, the kernel kills the script, not the agent.
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")
    for kind, limit in (
        (resource.RLIMIT_CPU, cpu_s),
        (resource.RLIMIT_AS, memory_bytes),
        (resource.RLIMIT_FSIZE, 0),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_NPROC, 0),
        (resource.RLIMIT_MEMLOCK, 0),
        (resource.RLIMIT_MSGQUEUE, 0),
        (resource.RLIMIT_NOFILE, LINK + 2),  # one more, for Landlock's ruleset
    ):
        resource.setrlimit(kind, (limit, limit))


def _drop_privileges() -> None:
    if os.geteuid() == 0:
        # Older kernels know fewer capabilities.
        for capability in range(_LAST_CAPABILITY + 1):
            if _kernel.prctl(_DROP_BOUNDING, capability, 0, 0, 0) != 0:
                break
        os.setgroups([])
        os.setresgid(SCRIPT_USER, SCRIPT_USER, SCRIPT_USER)
        os.setresuid(SCRIPT_USER, SCRIPT_USER, SCRIPT_USER)
    with contextlib.suppress(OSError):
        _control(_AMBIENT, _AMBIENT_CLEAR_ALL)
    _clear_capabilities()
    _control(_SET_DUMPABLE, 0)
    give_up_privileges()


def _clear_capabilities() -> None:
    """Clear all effective, permitted and inheritable capabilities, also of users other than root."""
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)
    none = (ctypes.c_uint32 * 6)()
    if _kernel.capset(header, none) != 0:
        raise OSError(ctypes.get_errno(), "capabilities cannot be dropped")


def _lock(filter_: seccomp.Filter | None) -> None:
    if filter_ is None:
        raise OSError("no filter")
    filter_.load()
    if not seccomp.in_force():
        raise OSError("the filter is not active")


def give_up_privileges() -> None:
    """Set ``no_new_privs``, which Landlock and seccomp require."""
    _control(_SET_NO_NEW_PRIVILEGES, 1)


def _control(option: int, value: int) -> None:
    if _kernel.prctl(option, value, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), f"prctl {option}")
