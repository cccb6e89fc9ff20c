"""Confines the process of one script: limits, another user, no privileges, Landlock, seccomp, in this order.

Each requested layer is applied or raises: a script never runs with fewer layers than the agent expects.
"""

import contextlib
import os
import resource
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from device_agent.sandbox import landlock, privileges, seccomp
from device_agent.sandbox.constants import LANDLOCK, LIMITS, SECCOMP, USER

SCRIPT_USER = 61_000
"""User and group of scripts if the agent runs as root: unused by accounts, below the range of systemd."""
LINK = 3
"""Descriptor of the socket to the agent; 0 to 2 are the null device."""
MAX_DESCRIPTORS = 256
"""The zygote's descriptors are below this number."""
_NICENESS = 10
"""Scripts have a lower priority than the control loop."""


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
        (USER, lambda: privileges.drop(SCRIPT_USER)),
        (LANDLOCK, landlock.restrict),
    )
    for layer, apply in steps:
        if layer in task["layers"]:
            _try(layer, apply)
    # After the change of user, which clears the signal.
    privileges.control(privileges.SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != parent:
        raise Unconfined("the zygote has ended")
    if SECCOMP in task["layers"]:
        _try(SECCOMP, lambda: seccomp.enforce(filter_))


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
