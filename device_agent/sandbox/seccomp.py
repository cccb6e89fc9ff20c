"""seccomp: the few system calls that a confined process may use.

The allow-list has no call that creates a socket or a process, or reaches another process. Scripts have no call that
takes a path or creates a descriptor; a parser of files can also open files for reading, and start threads.
``libseccomp`` generates the filter for the machine's architecture; calls of other architectures (32-bit, x32) kill.
"""

import errno
import os
from typing import Any, Protocol


class Filter(Protocol):
    """A built filter; ``load`` applies it permanently."""

    def load(self) -> None:
        """Apply the filter to this process."""


_ALLOWED = (
    # The socket to the agent, and the null device as standard input and output: nothing else is open.
    ("read", "write", "close", "poll", "ppoll", "select", "pselect6"),
    # Memory, within RLIMIT_AS.
    ("brk", "munmap", "mremap", "madvise"),
    # Time and waiting.
    ("clock_gettime", "clock_getres", "gettimeofday", "time", "nanosleep", "clock_nanosleep", "restart_syscall"),
    # Python's locks and signal handling. Handlers are harmless: scripts are ended by SIGKILL.
    ("futex", "rt_sigaction", "rt_sigprocmask", "rt_sigreturn", "sigaltstack", "sched_yield"),
    ("getrandom", "getpid", "gettid", "getuid", "geteuid", "getgid", "getegid", "getrusage", "times"),
    ("sched_getaffinity",),
    ("exit", "exit_group"),
)
_READING = (
    ("fstat", "stat", "lstat", "newfstatat", "statx", "lseek", "pread64", "readv", "getdents64", "getcwd"),
    ("readlink", "readlinkat", "access", "faccessat", "faccessat2", "dup"),
    # Start of threads.
    ("set_robust_list", "rseq", "membarrier"),
)
_DEADLY = (
    ("execve", "execveat", "ptrace", "process_vm_readv", "process_vm_writev", "pidfd_getfd", "kcmp"),
    ("mount", "umount2", "pivot_root", "chroot", "unshare", "setns", "open_tree", "move_mount", "fsopen", "fsmount"),
    ("bpf", "perf_event_open", "userfaultfd", "io_uring_setup", "io_uring_enter", "io_uring_register"),
    ("keyctl", "add_key", "request_key", "personality", "memfd_create", "memfd_secret", "seccomp"),
    ("init_module", "finit_module", "delete_module", "kexec_load", "reboot", "swapon", "iopl", "ioperm"),
    ("modify_ldt", "name_to_handle_at", "open_by_handle_at", "fanotify_init", "quotactl", "acct", "settimeofday"),
)
"""Calls that no program makes by mistake: they kill the process. All other calls fail with EPERM."""
_WRITABLE, _EXECUTABLE = 2, 4
_ACCESS_MODE, _READ_ONLY = 3, 0
_THREAD = 0x10000


def build(*, reading: bool = False) -> Filter:
    """Build the filter for this machine. It takes some milliseconds, so it is built once for all scripts.

    Args:
        reading: Allow opening files for reading, and threads.

    Raises:
        ImportError: ``pyseccomp`` is not installed.
        RuntimeError: libseccomp is not installed.
        OSError: The filter cannot be built.
    """
    import pyseccomp as library  # noqa: PLC0415 (not available on all systems)

    filter_ = library.SyscallFilter(defaction=library.ERRNO(errno.EPERM))
    filter_.set_attr(library.Attr.ACT_BADARCH, library.KILL_PROCESS)
    for names, action in ((_ALLOWED, library.ALLOW), (_DEADLY, library.KILL_PROCESS)):
        for name in (name for group in names for name in group):
            _add(library, filter_, action, name)
    _allow_memory(library, filter_)
    if reading:
        _allow_reading(library, filter_)
    # Reading a limit of this process; never setting one.
    _add(library, filter_, library.ALLOW, "prlimit64", library.Arg(0, library.EQ, 0), library.Arg(2, library.EQ, 0))
    return filter_  # type: ignore[no-any-return]


def _allow_memory(library: Any, filter_: Any) -> None:
    """Allow memory that is writable or executable, never both: scripts cannot run machine code of their own."""
    for name in ("mmap", "mmap2"):
        for forbidden in (_WRITABLE, _EXECUTABLE):
            _add(library, filter_, library.ALLOW, name, library.Arg(2, library.MASKED_EQ, forbidden, 0))
    _add(library, filter_, library.ALLOW, "mprotect", library.Arg(2, library.MASKED_EQ, _EXECUTABLE, 0))


def _allow_reading(library: Any, filter_: Any) -> None:
    for name in (name for group in _READING for name in group):
        _add(library, filter_, library.ALLOW, name)
    for name, flags in (("open", 1), ("openat", 2)):
        _add(library, filter_, library.ALLOW, name, library.Arg(flags, library.MASKED_EQ, _ACCESS_MODE, _READ_ONLY))
    # The filter cannot read the flags of clone3. Without it, the C library uses clone.
    _add(library, filter_, library.ERRNO(errno.ENOSYS), "clone3")
    _add(library, filter_, library.ALLOW, "clone", library.Arg(0, library.MASKED_EQ, _THREAD, _THREAD))


def _add(library: Any, filter_: Any, action: int, name: str, *arguments: Any) -> None:
    """Add a rule, unless this architecture or libseccomp does not know the call."""
    if library.resolve_syscall(library.system_arch(), name) >= 0:
        filter_.add_rule(action, name, *arguments)


def enforce(filter_: Filter | None) -> None:
    """Apply a filter to this process.

    Raises:
        OSError: There is none, or it is not active afterwards.
    """
    if filter_ is None:
        raise OSError("no filter")
    filter_.load()
    if not _in_force():
        raise OSError("the filter is not active")


def _in_force() -> bool:
    """Whether the filter is active, tested with a denied call."""
    try:
        os.getpgid(0)
    except PermissionError:
        return True
    return False
