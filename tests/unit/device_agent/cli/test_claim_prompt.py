"""What an agent that is nobody's shows: its code, a link, and the link as a picture for a phone's camera."""

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


def test_the_code_stands_in_its_line_and_in_a_link() -> None:
    assert shown(io.StringIO()) == ["claim code BCDF-GHJK  (valid for 300 s)", f"or open    {LINK}"]


def test_a_terminal_is_shown_a_picture_too() -> None:
    assert len(shown(Terminal())) == 2 + len(claim_prompt.qr_lines(LINK))


@pytest.mark.parametrize("out", [io.StringIO, Ascii])
def test_what_cannot_show_it_is_spared_it(out: type[io.StringIO]) -> None:
    assert len(shown(out())) == 2


def test_who_does_not_want_it_is_spared_it() -> None:
    assert len(shown(Terminal(), qr=False)) == 2


def test_a_narrow_terminal_has_the_link_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    assert len(shown(Terminal())) == 2


def test_the_picture_has_every_module_of_the_code() -> None:
    upper, lower = {"█": (0, 0), "▀": (0, 1), "▄": (1, 0), " ": (1, 1)}, claim_prompt.qr_lines(LINK)
    drawn = [[upper[mark][half] for mark in line] for line in lower for half in (0, 1)]
    wanted = [list(row) for row in segno.make(LINK, error="m", micro=False).matrix_iter(border=2)]
    assert drawn[: len(wanted)] == wanted
    assert all(not any(row) for row in drawn[len(wanted) :]), "what is over is light"
