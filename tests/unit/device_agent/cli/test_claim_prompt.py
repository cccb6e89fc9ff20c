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


class Ascii(Terminal):
    encoding = "ascii"


def shown(out: io.StringIO, *, qr: bool = True) -> list[str]:
    claim_prompt.show(Claim(agent="a1", code="BCDF-GHJK", expires_in_s=299.6), "http://10.0.0.7:8080/", qr=qr, out=out)
    return out.getvalue().splitlines()


@pytest.fixture(autouse=True)
def columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")


def test_code_and_link_are_printed() -> None:
    assert shown(io.StringIO()) == ["claim code BCDF-GHJK  (valid for 300 s)", f"or open    {LINK}"]


def test_a_terminal_also_shows_the_qr_code() -> None:
    assert len(shown(Terminal())) == 2 + len(claim_prompt.qr_lines(LINK))


@pytest.mark.parametrize(
    ("out", "qr", "columns"), [(io.StringIO, True, 80), (Ascii, True, 80), (Terminal, False, 80), (Terminal, True, 20)]
)
def test_the_qr_code_is_omitted_if_unwanted_or_not_displayable(
    out: type[io.StringIO], qr: bool, columns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    assert len(shown(out(), qr=qr)) == 2


def test_the_qr_code_is_complete() -> None:
    upper, lower = {"█": (0, 0), "▀": (0, 1), "▄": (1, 0), " ": (1, 1)}, claim_prompt.qr_lines(LINK)
    modules = [[upper[mark][half] for mark in line] for line in lower for half in (0, 1)]
    expected = [list(row) for row in segno.make(LINK, error="m", micro=False).matrix_iter(border=2)]
    assert modules[: len(expected)] == expected
    assert all(not any(row) for row in modules[len(expected) :]), "padding is light"
