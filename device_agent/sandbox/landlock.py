"""Landlock: from here on this process opens no file, no TCP port, and reaches no process outside.

A ruleset without a single rule: whatever the kernel's version knows to forbid is forbidden. Numbers are those of
``linux/landlock.h``; its three system calls have the same number on every architecture.
"""

import ctypes
import os

_CREATE_RULESET, _RESTRICT_SELF = 444, 446
_ASK_VERSION = 1
_FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 5: 16}
"""ABI version → how many rights over files it knows; each is a bit, without gaps."""
_TCP_RIGHTS, _TCP_SINCE = 0b11, 4
_SCOPES, _SCOPES_SINCE = 0b11, 6
"""Abstract sockets and signals: none to a process outside."""

_kernel = ctypes.CDLL(None, use_errno=True)
_kernel.syscall.restype = ctypes.c_long


def abi() -> int:
    """The kernel's Landlock version; 0 where it has none."""
    return max(0, int(_kernel.syscall(_CREATE_RULESET, None, 0, _ASK_VERSION)))


def restrict() -> None:
    """Forbid all. Needs ``no_new_privs``.

    Raises:
        OSError: The kernel cannot.
    """
    version = abi()
    rights = [0, 0, 0]
    if version:
        rights[0] = 2 ** max(bits for since, bits in _FILE_RIGHTS.items() if since <= version) - 1
    if version >= _TCP_SINCE:
        rights[1] = _TCP_RIGHTS
    if version >= _SCOPES_SINCE:
        rights[2] = _SCOPES
    # An older kernel refuses a longer structure than its own unless the rest is zero, which it is.
    attribute = (ctypes.c_uint64 * len(rights))(*rights)
    ruleset = _kernel.syscall(_CREATE_RULESET, ctypes.byref(attribute), ctypes.sizeof(attribute), 0)
    if ruleset < 0:
        raise OSError(ctypes.get_errno(), "no Landlock")
    try:
        if _kernel.syscall(_RESTRICT_SELF, ruleset, 0) != 0:
            raise OSError(ctypes.get_errno(), "Landlock cannot be applied")
    finally:
        os.close(ruleset)
