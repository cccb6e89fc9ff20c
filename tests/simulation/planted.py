"""Defects to plant in the product: the simulation must find each of them."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from typing import Any

from device_agent.protocol import Ack
from device_agent.runtime.authority.authority import Authority
from device_agent.runtime.commands.command_processor import CommandProcessor
from device_agent.runtime.control import setpoint_stream
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.storage.journal import Journal
from function_app.domain.control import lease as lease_rules
from function_app.domain.control.lease import Lease
from function_app.domain.identity.accounts import Identity
from function_app.ports.tables import Row, Write
from function_app.services.devices.control_rows import SLOT
from tests.simulation.actors.instance import SharedTables


@contextmanager
def _patched(owner: Any, name: str, value: Any) -> Iterator[None]:
    original = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, original)


def _duplicates_run_again() -> AbstractContextManager[None]:
    """The journal is not consulted for duplicates."""
    begin = Journal.begin

    def begin_always(journal: Journal, device: str, ack: Ack, *, issued_ms: int, epoch: int) -> None:
        begin(journal, device, ack, issued_ms=issued_ms, epoch=epoch)

    return _patched(Journal, "begin", begin_always)


def _burned_epoch_accepted() -> AbstractContextManager[None]:
    """``<`` instead of ``<=`` in the comparison with the burned epoch."""
    fence = Authority.fence

    def fence_later(authority: Authority, epoch: int) -> bool:
        gate = authority._gate
        burned, gate.burned = gate.burned, gate.burned - 1
        try:
            return fence(authority, epoch)
        finally:
            gate.burned = max(burned, gate.burned)

    return _patched(Authority, "fence", fence_later)


def _slot_without_etag() -> AbstractContextManager[None]:
    """The slot is written without its ETag."""
    apply = SharedTables._apply

    async def apply_unchecked(tables: SharedTables, table: str, writes: Sequence[Write]) -> tuple[Row, ...]:
        unchecked = []
        for write in writes:
            existing = tables.partition(table, write.row.partition).rows.get(SLOT)
            slot = write.row.key == SLOT and existing is not None
            unchecked.append(Write("replace", replace(write.row, etag=existing[0])) if slot and existing else write)
        return await apply(tables, table, unchecked)

    return _patched(SharedTables, "_apply", apply_unchecked)


def _latch_not_persisted() -> AbstractContextManager[None]:
    """The Stop latch is not journalled."""
    return _patched(Journal, "save_latch", lambda *_: None)


def _epoch_not_persisted() -> AbstractContextManager[None]:
    """A newer epoch is not journalled before it is applied, nor later."""
    return _patched(Journal, "save_epoch", lambda *_, **__: None)


def _ttl_ignored() -> AbstractContextManager[None]:
    """The agent does not check the time to live."""
    return _patched(CommandProcessor, "_check_time", lambda *_: None)


def _no_watchdog() -> AbstractContextManager[None]:
    """Setpoints stay fresh."""
    return _patched(setpoint_stream, "_is_fresh", lambda age_s, *_: age_s < float("inf"))


def _renewed_after_expiry() -> AbstractContextManager[None]:
    """A lease can be renewed after it has expired."""
    require_held = lease_rules.require_held

    def require_holder(lease: Lease | None, caller: Identity, *, epoch: int, now_ms: int) -> Lease:
        return require_held(lease, caller, epoch=epoch, now_ms=min(now_ms, lease.expires_ms - 1) if lease else now_ms)

    return _patched(lease_rules, "require_held", require_holder)


def _lease_taken_while_held() -> AbstractContextManager[None]:
    """A lease can be acquired while another session holds it."""
    return _patched(Lease, "held_by_other", lambda *_: False)


def _stop_confirmed_early() -> AbstractContextManager[None]:
    """Stop is acknowledged before the control loop has applied it."""
    return _patched(Controller, "stop_applied", lambda *_: True)


DEFECTS: dict[str, Callable[[], AbstractContextManager[None]]] = {
    "duplicates-run-again": _duplicates_run_again,
    "burned-epoch-accepted": _burned_epoch_accepted,
    "slot-without-etag": _slot_without_etag,
    "latch-not-persisted": _latch_not_persisted,
    "epoch-not-persisted": _epoch_not_persisted,
    "ttl-ignored": _ttl_ignored,
    "no-watchdog": _no_watchdog,
    "renewed-after-expiry": _renewed_after_expiry,
    "lease-taken-while-held": _lease_taken_while_held,
    "stop-confirmed-early": _stop_confirmed_early,
}
"""Name → context manager that plants the defect."""
