"""Child processes of a program, from /proc."""

from pathlib import Path


def child_processes(pid: int) -> dict[str, int]:
    """Process ids of the children, by the name of their program."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return {Path(f"/proc/{child}/comm").read_text().strip(): int(child) for child in children}
