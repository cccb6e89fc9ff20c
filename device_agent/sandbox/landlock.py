"""Landlock: denies this thread all files, TCP ports and signals to other processes, except what is named.

Everything that the kernel's Landlock version can restrict is denied. Numbers are those of ``linux/landlock.h``; the
system calls have the same number on all architectures.
"""

import ctypes
import os
import sys
from collections.abc import Sequence

_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_GET_VERSION = 1
_BENEATH_A_FOLDER, _PORT = 1, 2
_READ_FILE, _READ_FOLDER = 2**2, 2**3
_FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 5: 16}
"""ABI version → number of file rights; each is one bit, without gaps."""
_TCP_RIGHTS, _CONNECT, _TCP_SINCE = 0b11, 0b10, 4
_SCOPES, _SCOPES_SINCE = 0b11, 6
"""Scopes: no abstract sockets of, and no signals to, processes outside."""

_kernel = ctypes.CDLL(None, use_errno=True)
_kernel.syscall.restype = ctypes.c_long


def abi() -> int:
    """The kernel's Landlock version; 0 for none."""
    return max(0, int(_kernel.syscall(_CREATE_RULESET, None, 0, _GET_VERSION)))


def restrict(readable: Sequence[str] = (), *, connect: int | None = None) -> None:
    """Apply the restrictions to this thread and its later threads. Requires ``no_new_privs``.

    Args:
        readable: Folders whose content can be read.
        connect: TCP port to which connections can be opened; ``None`` for no port.

    Raises:
        OSError: The kernel cannot apply them.
    """
    version = abi()
    rights = [0, 0, 0]
    if version:
        rights[0] = 2 ** max(bits for since, bits in _FILE_RIGHTS.items() if since <= version) - 1
    if version >= _TCP_SINCE:
        rights[1] = _TCP_RIGHTS
    if version >= _SCOPES_SINCE:
        rights[2] = _SCOPES
    # Older kernels accept a longer structure if the additional fields are zero.
    attribute = (ctypes.c_uint64 * len(rights))(*rights)
    ruleset = _kernel.syscall(_CREATE_RULESET, ctypes.byref(attribute), ctypes.sizeof(attribute), 0)
    if ruleset < 0:
        raise OSError(ctypes.get_errno(), "no Landlock")
    try:
        for folder in readable:
            _allow_reading(ruleset, folder)
        if connect is not None and version >= _TCP_SINCE:
            _add_rule(ruleset, _PORT, _CONNECT.to_bytes(8, sys.byteorder) + connect.to_bytes(8, sys.byteorder))
        if _kernel.syscall(_RESTRICT_SELF, ruleset, 0) != 0:
            raise OSError(ctypes.get_errno(), "Landlock cannot be applied")
    finally:
        os.close(ruleset)


def _allow_reading(ruleset: int, folder: str) -> None:
    descriptor = os.open(folder, os.O_PATH | os.O_DIRECTORY)
    try:
        rule = (_READ_FILE | _READ_FOLDER).to_bytes(8, sys.byteorder)
        rule += descriptor.to_bytes(4, sys.byteorder, signed=True)
        _add_rule(ruleset, _BENEATH_A_FOLDER, rule)
    finally:
        os.close(descriptor)


def _add_rule(ruleset: int, kind: int, rule: bytes) -> None:
    if _kernel.syscall(_ADD_RULE, ruleset, kind, rule, 0) != 0:
        raise OSError(ctypes.get_errno(), "Landlock cannot be applied")
