"""Shows the claim code, a link that contains it, and the QR code of the link."""

import shutil
import sys
from typing import TextIO

import segno

from device_agent.transports.http.client import Claim

_QUIET_ZONE = 2
"""Quiet zone [modules]. The standard requires four; cameras read two, and terminals are small."""
_HALVES = (("█", "▀"), ("▄", " "))
"""Characters by upper and lower module. Light modules are printed, for terminals with dark background."""
_INK = "\N{ESC}[97;40m"
_PLAIN = "\N{ESC}[0m"


def link(server: str, code: str) -> str:
    """URL that claims this agent. The code is in the fragment, which is never sent to a server or logged."""
    return f"{server.rstrip('/')}/#pair={code}"


def show(claim: Claim, server: str, *, qr: bool, out: TextIO | None = None) -> None:
    """Print code and link to ``out`` (default: standard output), and with ``qr`` the QR code if it can be displayed."""
    out = out or sys.stdout
    code = claim.code or ""
    address = link(server, code)
    print(f"claim code {code}  (valid for {claim.expires_in_s or 0:.0f} s)", file=out)
    print(f"or open    {address}", file=out)
    if qr and out.isatty():
        rows = qr_lines(address)
        if len(rows[0]) <= shutil.get_terminal_size().columns and _can_encode_blocks(out):
            print(*(f"{_INK}{row}{_PLAIN}" for row in rows), sep="\n", file=out)
    out.flush()


def show_waiting(remaining_s: float, *, again: bool, out: TextIO | None = None) -> None:
    """Print what the program waits for, and the remaining time of the claim code.

    With ``again``, a terminal shows the new time in the same line; other outputs stay unchanged.
    """
    out = out or sys.stdout
    if again and not out.isatty():
        return
    minutes, seconds = divmod(max(0, round(remaining_s)), 60)
    text = f"waiting until an account redeems the claim code: {minutes}:{seconds:02d} minutes left"
    print(f"\r{text}" if again else text, end="" if out.isatty() else "\n", file=out, flush=True)


def qr_lines(text: str) -> list[str]:
    """A QR code as lines of equal length, with two rows of modules per line."""
    rows = [list(row) for row in segno.make(text, error="m", micro=False).matrix_iter(border=_QUIET_ZONE)]
    if len(rows) % 2:
        rows.append([0] * len(rows[0]))
    return [
        "".join(_HALVES[upper][lower] for upper, lower in zip(above, below, strict=True))
        for above, below in zip(rows[::2], rows[1::2], strict=True)
    ]


def _can_encode_blocks(out: TextIO) -> bool:
    """Whether the output's encoding includes the block characters."""
    try:
        "█▀▄".encode(out.encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True
