"""Privileges of this process: user, capabilities, and what its programs can gain. Linux only."""

import contextlib
import ctypes
import os

SET_PARENT_DEATH_SIGNAL = 1
"""Option of ``control``: the signal when the parent process ends. A change of user clears it."""
_SET_DUMPABLE, _DROP_BOUNDING, _SET_NO_NEW_PRIVILEGES, _AMBIENT = 4, 24, 38, 47
_AMBIENT_CLEAR_ALL = 4
_LAST_CAPABILITY = 63

_kernel = ctypes.CDLL(None, use_errno=True)


def drop(user: int) -> None:
    """Drop all capabilities permanently, and change to a user and its group if this process runs as root.

    Raises:
        OSError: The kernel refuses.
    """
    if os.geteuid() == 0:
        # Older kernels know fewer capabilities.
        for capability in range(_LAST_CAPABILITY + 1):
            if _kernel.prctl(_DROP_BOUNDING, capability, 0, 0, 0) != 0:
                break
        os.setgroups([])
        os.setresgid(user, user, user)
        os.setresuid(user, user, user)
    with contextlib.suppress(OSError):
        control(_AMBIENT, _AMBIENT_CLEAR_ALL)
    _clear_capabilities()
    control(_SET_DUMPABLE, 0)
    renounce()


def renounce() -> None:
    """Set ``no_new_privs``, which Landlock and seccomp require."""
    control(_SET_NO_NEW_PRIVILEGES, 1)


def control(option: int, value: int) -> None:
    """Set one option of this process with ``prctl``.

    Raises:
        OSError: The kernel refuses.
    """
    if _kernel.prctl(option, value, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), f"prctl {option}")


def _clear_capabilities() -> None:
    """Clear all effective, permitted and inheritable capabilities, also of users other than root."""
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)
    none = (ctypes.c_uint32 * 6)()
    if _kernel.capset(header, none) != 0:
        raise OSError(ctypes.get_errno(), "capabilities cannot be dropped")
