"""The rows that decide who controls a device: lease, slot and queue, side by side in the device's partition."""

from collections.abc import Callable
from dataclasses import dataclass, field

from function_app.domain.devices import Device
from function_app.domain.lease import Lease, release
from function_app.domain.queue import Queue
from function_app.ports.tables import Row, Tables, Write
from function_app.services import store

LEASE = "now:lease"
SLOT = "now:slot"
QUEUE = "now:queue"


@dataclass(frozen=True, slots=True)
class Control:
    """Lease, slot and queue as they were read, with their rows (none: not written yet)."""

    lease: Lease | None = None
    action: str = ""
    slot_pairing: str = ""
    queue: Queue = field(default_factory=lambda: Queue(""))
    rows: dict[str, Row] = field(default_factory=dict)

    def write_lease(self, device: str, lease: Lease) -> Write:
        """The change that puts ``lease`` in place of what was read."""
        return self._write(device, LEASE, store.fields(lease))

    def write_slot(self, device: str, action: str, pairing: str) -> Write:
        """The change that gives the slot to ``action`` (empty: to nobody)."""
        return self._write(device, SLOT, {"action": action, "pairing": pairing})

    def write_queue(self, device: str, queue: Queue) -> Write:
        """The change that puts ``queue`` in place of what was read."""
        return self._write(device, QUEUE, store.fields(queue))

    def _write(self, device: str, key: str, data: dict[str, object]) -> Write:
        row = self.rows.get(key)
        return Write("replace" if row else "create", Row(device, key, data, row.etag if row else ""))


async def read_control(tables: Tables, device: Device) -> Control:
    """Lease, slot and queue in one read.

    What an earlier owner's pairing left behind is nobody's: an un-pairing that stopped half way blocks nobody.
    """
    rows = await _rows(tables, device.id)
    lease = _lease(rows, device)
    slot = rows.get(SLOT)
    action = slot.data["action"] if slot and slot.data["pairing"] == device.pairing else ""
    queue = _queue(rows)
    return Control(
        lease=lease,
        action=action,
        slot_pairing=device.pairing,
        queue=queue if queue.pairing == device.pairing else Queue(device.pairing),
        rows=rows,
    )


async def read_control_rows(tables: Tables, device: str) -> Control:
    """Lease, slot and queue, of whatever pairing."""
    rows = await _rows(tables, device)
    slot = rows.get(SLOT)
    return Control(
        lease=store.read(rows[LEASE], Lease) if LEASE in rows else None,
        action=slot.data["action"] if slot else "",
        slot_pairing=slot.data["pairing"] if slot else "",
        queue=_queue(rows),
        rows=rows,
    )


async def change_lease(
    tables: Tables, device: Device, change: Callable[[Lease | None], Lease]
) -> tuple[Lease | None, Lease]:
    """Put what ``change`` makes of the lease in its place, by ETag; the lease before and after.

    Args:
        tables: The store.
        device: Whose lease.
        change: Decides; may be called several times.

    Raises:
        Problem: ``busy``, and whatever ``change`` raises.
    """

    async def once() -> tuple[Lease | None, Lease]:
        control = await read_control(tables, device)
        lease = change(control.lease)
        await tables.batch(store.CONTROL, [control.write_lease(device.id, lease)])
        return control.lease, lease

    return await store.retry(once)


async def read_lease(tables: Tables, device: Device) -> Lease | None:
    """The lease row alone, live or not."""
    row = await tables.get(store.CONTROL, device.id, LEASE)
    return _lease({LEASE: row} if row else {}, device)


async def _rows(tables: Tables, device: str) -> dict[str, Row]:
    page = await tables.query(store.CONTROL, device, first="now:", last="now;")
    return {row.key: row for row in page.rows}


def _queue(rows: dict[str, Row]) -> Queue:
    return store.read(rows[QUEUE], Queue) if QUEUE in rows else Queue("")


def _lease(rows: dict[str, Row], device: Device) -> Lease | None:
    if LEASE not in rows:
        return None
    lease = store.read(rows[LEASE], Lease)
    return lease if lease.pairing in ("", device.pairing) else release(lease)
