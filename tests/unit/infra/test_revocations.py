import time
from pathlib import Path

import msgspec
import pytest

from device_agent.protocol.security.grants import Grant
from device_agent.protocol.security.revocation import Revoke
from infra.embedded_broker import revocations as module
from infra.embedded_broker.revocations import Revocations, RevocationsError

GRANT = Grant(principal="p", client_id="c", publish=(), subscribe=(), token_id="t", expires_at=0)


def opened(path: Path, keep_s: float = 1_000) -> Revocations:
    revocations = Revocations(path, keep_s=keep_s)
    revocations.open()
    return revocations


@pytest.mark.parametrize("revoke", [Revoke(client_id="c"), Revoke(principal="p")])
def test_tokens_made_before_are_covered_and_later_ones_are_not(tmp_path: Path, revoke: Revoke) -> None:
    revocations = opened(tmp_path / "r")
    now = time.time()
    revocations.add(msgspec.structs.replace(revoke, before_s=now))
    assert revocations.covers(GRANT, now)
    assert revocations.covers(GRANT, 0.0)
    assert not revocations.covers(GRANT, now + 0.001)
    revocations.close()


def test_a_later_revocation_wins_over_an_earlier_one_whatever_their_order(tmp_path: Path) -> None:
    revocations = opened(tmp_path / "r")
    now = time.time()
    revocations.add(Revoke(client_id="c", before_s=now))
    revocations.add(Revoke(client_id="c", before_s=now - 100))
    assert revocations.covers(GRANT, now)
    revocations.close()


def test_a_token_id_is_covered_whenever_it_was_made(tmp_path: Path) -> None:
    revocations = opened(tmp_path / "r")
    revocations.add(Revoke(token_id="t", before_s=1.0))
    assert revocations.covers(GRANT, time.time() + 10)
    assert not revocations.covers(msgspec.structs.replace(GRANT, token_id="other"), 0.0)
    revocations.close()


def test_they_survive_the_end_of_the_process_and_a_line_cut_short(tmp_path: Path) -> None:
    path = tmp_path / "r"
    first = opened(path)
    first.add(Revoke(client_id="c"))
    with path.open("a") as file:  # never closed in order: a crash
        file.write('{"field": "principal", "val')
    second = opened(path)
    assert second.covers(GRANT, time.time() - 1)
    second.close()
    first.close()
    assert len(path.read_text().splitlines()) == 1


def test_what_has_run_out_is_forgotten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_TIDY_AT", 3)
    path = tmp_path / "r"
    revocations = opened(path, keep_s=50)
    revocations.add(Revoke(client_id="c", before_s=time.time() - 100))
    for name in ("x", "y"):
        revocations.add(Revoke(client_id=name))
    assert not revocations.covers(GRANT, 0.0)
    assert len(path.read_text().splitlines()) == 2, "neither is the file to grow for ever"
    revocations.add(Revoke(client_id="z"))
    revocations.close()
    again = opened(path, keep_s=50)
    assert all(again.covers(msgspec.structs.replace(GRANT, client_id=name), 0.0) for name in ("x", "y", "z"))
    again.close()
    assert len(path.read_text().splitlines()) == 3


def test_where_the_file_cannot_be_written_anew_the_one_before_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_TIDY_AT", 3)
    path = tmp_path / "r"
    revocations = opened(path)
    (tmp_path / "r.new").mkdir()
    for name in ("x", "y", "z", "c"):
        revocations.add(Revoke(client_id=name))
    revocations.close()
    assert len(path.read_text().splitlines()) == 4
    (tmp_path / "r.new").rmdir()
    again = opened(path)
    assert again.covers(GRANT, 0.0)
    again.close()


@pytest.mark.parametrize("revoke", [Revoke(), Revoke(client_id=""), Revoke(client_id="a", token_id="b")])
def test_exactly_one_thing_is_named(tmp_path: Path, revoke: Revoke) -> None:
    revocations = opened(tmp_path / "r")
    with pytest.raises(ValueError, match="exactly one"):
        revocations.add(revoke)
    revocations.close()


def test_a_file_that_cannot_be_kept_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(RevocationsError, match="cannot keep revocations"):
        Revocations(tmp_path / "none" / "r", keep_s=1).open()
