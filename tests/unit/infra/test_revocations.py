import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest

from device_agent.protocol.security.grants import Grant
from device_agent.protocol.security.revocation import Revoke
from infra.embedded_broker import revocations as module
from infra.embedded_broker.limits import Limits
from infra.embedded_broker.revocations import Revocations, RevocationsError

GRANT = Grant(principal="p", client_id="c", publish=(), subscribe=(), token_id="t", expires_at=0)
Opener = Callable[..., Revocations]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "r"


@pytest.fixture
def open_file(path: Path) -> Iterator[Opener]:
    with contextlib.ExitStack() as stack:

        def open_again(keep_s: float = 1_000, account_keep_s: float = 1_000) -> Revocations:
            limits = Limits(token_s=keep_s, account_token_s=account_keep_s)
            revocations = stack.enter_context(contextlib.closing(Revocations(path, lifetime_s=limits.lifetime_s)))
            revocations.open()
            return revocations

        yield open_again


@pytest.mark.parametrize("revoke", [Revoke(client_id="c"), Revoke(principal="p")])
def test_only_earlier_tokens_are_revoked(open_file: Opener, revoke: Revoke) -> None:
    revocations, now = open_file(), time.time()
    revocations.add(msgspec.structs.replace(revoke, before_s=now))
    revocations.add(msgspec.structs.replace(revoke, before_s=now - 100))
    assert revocations.covers(GRANT, now)
    assert revocations.covers(GRANT, 0.0)
    assert not revocations.covers(GRANT, now + 0.001)


def test_a_token_id_is_revoked_at_any_time(open_file: Opener) -> None:
    revocations = open_file()
    revocations.add(Revoke(token_id="t", before_s=1.0))
    assert revocations.covers(GRANT, time.time() + 10)
    assert not revocations.covers(msgspec.structs.replace(GRANT, token_id="other"), 0.0)


def test_a_revocation_by_a_clock_that_was_set_back_later_has_no_effect(open_file: Opener) -> None:
    revocations, now = open_file(keep_s=50), time.time()
    revocations.add(Revoke(client_id="c", before_s=now + 400 * 86_400))
    assert not revocations.covers(GRANT, now)
    revocations.add(Revoke(principal="p", before_s=now + 40))
    assert revocations.covers(GRANT, now + 30), "clocks of two machines differ"


def test_revocations_survive_a_crash_and_a_truncated_line(open_file: Opener, path: Path) -> None:
    open_file().add(Revoke(client_id="c"))
    with path.open("a") as file:
        file.write('{"field": "principal", "val')
    assert open_file().covers(GRANT, time.time() - 1)
    assert len(path.read_text().splitlines()) == 1


def test_expired_revocations_are_removed_from_memory_once_per_sweep(
    open_file: Opener, monkeypatch: pytest.MonkeyPatch
) -> None:
    revocations = open_file(keep_s=50)
    revocations.add(Revoke(client_id="c", before_s=time.time() - 100))
    revocations.add(Revoke(client_id="x"))
    assert len(revocations._before) == 2
    monkeypatch.setattr(module, "_SWEEP_S", 0.0)
    revocations.add(Revoke(client_id="y"))
    assert [value for _, value in revocations._before] == ["x", "y"]
    assert not revocations.covers(GRANT, 0.0)


def test_revocations_of_accounts_are_removed_earlier(open_file: Opener, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_SWEEP_S", 0.0)
    revocations, now = open_file(keep_s=200, account_keep_s=50), time.time()
    for principal, age_s in (("agent:a", 100), ("account:old", 100), ("account:a", 40)):
        revocations.add(Revoke(principal=principal, before_s=now - age_s))
    assert [value for _, value in revocations._before] == ["agent:a", "account:a"]
    revocations.close()
    again = open_file(keep_s=200, account_keep_s=30)
    assert [value for _, value in again._before] == ["agent:a"]
    assert again.covers(msgspec.structs.replace(GRANT, principal="agent:a"), now - 101)


def test_the_file_is_rewritten_when_half_of_it_has_expired(
    open_file: Opener, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_REWRITE_AT", 4)
    monkeypatch.setattr(module, "_SWEEP_S", 0.0)
    revocations = open_file(keep_s=50)
    for name in ("a", "b"):
        revocations.add(Revoke(client_id=name, before_s=time.time() - 100))
    revocations.add(Revoke(client_id="x"))
    assert len(path.read_text().splitlines()) == 3
    revocations.add(Revoke(client_id="y"))
    assert len(path.read_text().splitlines()) == 2
    revocations.add(Revoke(client_id="z"))
    revocations.close()
    again = open_file(keep_s=50)
    assert all(again.covers(msgspec.structs.replace(GRANT, client_id=name), 0.0) for name in ("x", "y", "z"))
    assert len(path.read_text().splitlines()) == 3


def test_a_failed_rewrite_keeps_the_file(open_file: Opener, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_REWRITE_AT", 3)
    revocations = open_file()
    blocker = path.with_name("r.new")
    blocker.mkdir()
    for _ in range(2):
        for name in ("x", "c"):
            revocations.add(Revoke(client_id=name))
    revocations.close()
    assert len(path.read_text().splitlines()) == 4
    blocker.rmdir()
    assert open_file().covers(GRANT, 0.0)


@pytest.mark.parametrize("revoke", [Revoke(), Revoke(client_id=""), Revoke(client_id="a", token_id="b")])
def test_a_revocation_names_exactly_one_field(open_file: Opener, revoke: Revoke) -> None:
    with pytest.raises(ValueError, match="exactly one"):
        open_file().add(revoke)


def test_an_unusable_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RevocationsError, match="cannot store revocations"):
        Revocations(tmp_path / "none" / "r", lifetime_s=lambda _: 1).open()
