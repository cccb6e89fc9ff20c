"""The claim prompt shows code, link, and QR code if the terminal can display it."""

import io

import pytest
import segno

from device_agent.cli import claim_prompt
from device_agent.transports.http.client import Claim

LINK = "http://10.0.0.7:8080/#pair=BCDF-GHJK"


class Terminal(io.StringIO):
    encoding = "utf-8"

    def isatty(self) -> bool:
        return True


class AsciiTerminal(Terminal):
    encoding = "ascii"


@pytest.mark.parametrize(
    ("terminal", "qr", "columns", "shown"),
    [
        (Terminal, True, 80, True),
        (io.StringIO, True, 80, False),
        (AsciiTerminal, True, 80, False),
        (Terminal, False, 80, False),
        (Terminal, True, 20, False),
    ],
)
def test_the_qr_code_is_shown_if_requested_and_displayable(
    terminal: type[io.StringIO], qr: bool, columns: int, shown: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    out, claim = terminal(), Claim(agent="a1", code="BCDF-GHJK", expires_in_s=299.6)
    claim_prompt.show(claim, "http://10.0.0.7:8080/", qr=qr, out=out)
    code, link, *rows = out.getvalue().splitlines()
    assert (code, link) == ("claim code BCDF-GHJK  (valid for 300 s)", f"or open    {LINK}")
    assert len(rows) == (len(claim_prompt.qr_lines(LINK)) if shown else 0)


@pytest.mark.parametrize(
    ("terminal", "expected"),
    [(Terminal, "{0} 4:59 minutes left\r{0} 0:07 minutes left"), (io.StringIO, "{0} 4:59 minutes left\n")],
)
def test_the_program_states_what_it_waits_for_and_how_long(terminal: type[io.StringIO], expected: str) -> None:
    out = terminal()
    claim_prompt.show_waiting(299.4, again=False, out=out)
    claim_prompt.show_waiting(7.0, again=True, out=out)
    assert out.getvalue() == expected.format("waiting until an account redeems the claim code:")


def test_the_qr_code_is_complete() -> None:
    halves = {"█": (0, 0), "▀": (0, 1), "▄": (1, 0), " ": (1, 1)}
    modules = [[halves[mark][half] for mark in line] for line in claim_prompt.qr_lines(LINK) for half in (0, 1)]
    expected = [list(row) for row in segno.make(LINK, error="m", micro=False).matrix_iter(border=2)]
    assert modules[: len(expected)] == expected
    assert all(not any(row) for row in modules[len(expected) :]), "padding is light"
