"""The rows that control a device: lease, slot, queue and reported epochs in the device's partition."""

from dataclasses import dataclass, field, replace

from function_app.domain.actions.queue import ActionQueue
from function_app.domain.control.lease import Lease, catch_up, release
from function_app.domain.devices.devices import Device, DeviceEpochs
from function_app.domain.identity.accounts import Identity
from function_app.ports.tables import Row, Tables, Write
from function_app.services.storage import records

LEASE = "now:lease"
SLOT = "now:slot"
QUEUE = "now:queue"
EPOCHS = "now:epochs"


@dataclass(frozen=True, slots=True)
class ControlRows:
    """Lease, slot, queue and reported epochs with the rows that they were read from (missing: not written yet)."""

    lease: Lease | None = None
    action: str = ""
    slot_pairing: str = ""
    queue: ActionQueue = field(default_factory=lambda: ActionQueue(""))
    reported: DeviceEpochs = field(default_factory=DeviceEpochs)
    rows: dict[str, Row] = field(default_factory=dict)

    def write_lease(self, device: str, lease: Lease) -> Write:
        """The write that replaces the lease."""
        return self._write(device, LEASE, records.to_data(lease))

    def write_slot(self, device: str, action: str, pairing: str) -> Write:
        """The write that assigns the slot to ``action`` (empty: free)."""
        return self._write(device, SLOT, {"action": action, "pairing": pairing})

    def write_queue(self, device: str, queue: ActionQueue) -> Write:
        """The write that replaces the queue."""
        return self._write(device, QUEUE, records.to_data(queue))

    def _write(self, device: str, key: str, data: dict[str, object]) -> Write:
        return records.write(self.rows.get(key), device, key, data)


async def read_control(tables: Tables, device: Device) -> ControlRows:
    """Lease, slot, queue and reported epochs in one read, without those of an earlier pairing."""
    rows = await _rows(tables, device.id)
    lease = _lease(rows, device)
    slot = rows.get(SLOT)
    action = slot.data["action"] if slot and slot.data["pairing"] == device.pairing else ""
    queue = _queue(rows)
    return ControlRows(
        lease=lease,
        action=action,
        slot_pairing=device.pairing,
        queue=queue if queue.pairing == device.pairing else ActionQueue(device.pairing),
        reported=_reported(rows, device.pairing),
        rows=rows,
    )


async def read_control_rows(tables: Tables, device: str) -> ControlRows:
    """Lease, slot and queue of any pairing."""
    rows = await _rows(tables, device)
    slot = rows.get(SLOT)
    lease = records.read(rows[LEASE], Lease) if LEASE in rows else None
    return ControlRows(
        lease=lease,
        action=slot.data["action"] if slot else "",
        slot_pairing=slot.data["pairing"] if slot else "",
        queue=_queue(rows),
        reported=_reported(rows, lease.pairing if lease is not None else ""),
        rows=rows,
    )


def apply_device_epochs(control: ControlRows, caller: Identity, now_ms: int, *, rejected: int = 0) -> ControlRows:
    """The rows of ``read_control`` with the epochs of the device: reported ones, and that of a ``rejected`` command.

    A hold, Stop or restart ends leases at the device: the lease of another session is then free. An ended epoch is
    never accepted again, so an old state is still valid. See also ``catch_up``.
    """
    lease = catch_up(control.lease, max(rejected, control.reported.seen), now_ms=now_ms)
    if lease is not None and control.reported.ended >= lease.epoch and lease.held_by_other(caller, now_ms):
        lease = release(lease, now_ms=now_ms)
    return control if lease is control.lease else replace(control, lease=lease)


async def read_lease(tables: Tables, device: Device) -> Lease | None:
    """The lease, live or not, without slot and queue."""
    row = await tables.get(records.CONTROL, device.id, LEASE)
    return _lease({LEASE: row} if row else {}, device)


async def record_device_epochs(tables: Tables, device: str, epochs: DeviceEpochs) -> None:
    """Store the epochs of the newest ``state`` where ``read_control`` finds them."""

    def changed(stored: DeviceEpochs | None) -> DeviceEpochs | None:
        return None if stored == epochs else epochs

    await records.upsert(tables, records.CONTROL, device, EPOCHS, changed, DeviceEpochs)


def _reported(rows: dict[str, Row], pairing: str) -> DeviceEpochs:
    reported = records.read(rows[EPOCHS], DeviceEpochs) if EPOCHS in rows else DeviceEpochs()
    return reported if reported.pairing == pairing else DeviceEpochs()


async def _rows(tables: Tables, device: str) -> dict[str, Row]:
    page = await tables.query(records.CONTROL, device, first="now:", last="now;")
    return {row.key: row for row in page.rows}


def _queue(rows: dict[str, Row]) -> ActionQueue:
    return records.read(rows[QUEUE], ActionQueue) if QUEUE in rows else ActionQueue("")


def _lease(rows: dict[str, Row], device: Device) -> Lease | None:
    if LEASE not in rows:
        return None
    lease = records.read(rows[LEASE], Lease)
    return lease if lease.pairing in ("", device.pairing) else Lease(epoch=lease.epoch)
