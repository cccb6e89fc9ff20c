"""How an agent that is nobody's asks to be claimed: its code, a link that carries it, and the link for a camera."""

import shutil
import sys
from typing import TextIO

import segno

from device_agent.transports.http.client import Claim

_QUIET = 2
"""Light modules around it. The standard wants four; cameras do with two, and terminals are small."""
_HALVES = (("█", "▀"), ("▄", " "))
"""By upper and lower module, light as ink: on the dark ground of most terminals that is the right way round."""
_INK = "\N{ESC}[97;40m"
_PLAIN = "\N{ESC}[0m"


def link(server: str, code: str) -> str:
    """The page that claims this agent. The code is in the fragment, which no server is sent and no log holds."""
    return f"{server.rstrip('/')}/#pair={code}"


def show(claim: Claim, server: str, *, qr: bool, out: TextIO | None = None) -> None:
    """Print code and link; and, on a terminal that is wide and dark enough for it to be read, the QR code.

    Args:
        claim: With its code.
        server: The address at which this agent knows the server.
        qr: Whether a QR code is wanted.
        out: Where to; the standard output by default.
    """
    out = out or sys.stdout
    code = claim.code or ""
    address = link(server, code)
    print(f"claim code {code}  (valid for {claim.expires_in_s or 0:.0f} s)", file=out)
    print(f"or open    {address}", file=out)
    if qr and out.isatty():
        rows = picture(address)
        if len(rows[0]) <= shutil.get_terminal_size().columns and _speaks(out):
            print(*(f"{_INK}{row}{_PLAIN}" for row in rows), sep="\n", file=out)
    out.flush()


def picture(text: str) -> list[str]:
    """A QR code in lines of equal length, two rows of modules in each."""
    rows = [list(row) for row in segno.make(text, error="m", micro=False).matrix_iter(border=_QUIET)]
    if len(rows) % 2:
        rows.append([0] * len(rows[0]))
    return [
        "".join(_HALVES[upper][lower] for upper, lower in zip(above, below, strict=True))
        for above, below in zip(rows[::2], rows[1::2], strict=True)
    ]


def _speaks(out: TextIO) -> bool:
    """Whether its characters can be written there."""
    try:
        "█▀▄".encode(out.encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True
