"""Two thousand devices of one owner, long lists of one device, and clients that read all of them."""

import threading
import time
from dataclasses import replace
from typing import Final

import httpx

from benchmarks.faults.processes import ACTION_ARM, ProductProcesses
from function_app.domain.actions.action import Action
from function_app.domain.common.ids import command_id
from function_app.ports.tables import Write
from function_app.services.actions.action_store import new_row, row_location
from function_app.services.storage import records
from tests.harness.processes import show_code

CROWD: Final = "2,000 devices, lists of 10⁴ rows"
_DEVICES: Final = 2_000
_DEVICES_PER_AGENT: Final = 20
_ROWS: Final = 10_000
_EARLIER_MS: Final = 3_600_000
_BATCH: Final = 50
_PAGE: Final = 1_000
_CLIENTS: Final = 2
_TIMEOUT_S: Final = 30.0


class Crowd:
    """Reads all lists with several clients between ``begin`` and ``end``.

    Attributes:
        page_ms: Durations of the requests.
        problems: Responses that were errors, and lists with missing or repeated rows.
    """

    def __init__(self, product: ProductProcesses) -> None:
        self._product = product
        self._stopping = threading.Event()
        self._threads: list[threading.Thread] = []
        self._populated = False
        self.page_ms: list[float] = []
        self.problems: list[str] = []

    def begin(self) -> None:
        """Starts the clients."""
        self._stopping.clear()
        self._threads = [threading.Thread(target=self._read_all) for _ in range(_CLIENTS)]
        for thread in self._threads:
            thread.start()

    def end(self) -> None:
        """Stops the clients."""
        self._stopping.set()
        for thread in self._threads:
            thread.join(_TIMEOUT_S)

    def populate(self) -> None:
        """Creates the devices and rows, once."""
        if self._populated:
            return
        self._populated = True
        functions = self._product.cloud.functions
        names = [f"d{number}" for number in range(_DEVICES_PER_AGENT)]
        for _ in range(_DEVICES // _DEVICES_PER_AGENT):
            _, code = self._product.cloud.run(show_code(functions, names))
            self._product.owner.post("/agents/claim", json={"code": code}).raise_for_status()
        self._product.cloud.run(self._write_rows())

    async def _write_rows(self) -> None:
        """Copies one completed action of the arm with earlier times."""
        tables, device = self._product.cloud.functions.tables, self._product.device(ACTION_ARM).rpartition("/")[2]
        items = self._product.http.get(f"/devices/{device}/actions", params={"limit": _PAGE}).json()["items"]
        partition, key = row_location(next(each["id"] for each in items if each["status"] == "done")) or ("", "")
        row = await tables.get(records.CONTROL, partition, key)
        if row is None:
            raise RuntimeError("the action to copy does not exist")
        action, earlier_ms = records.read(row, Action), round(time.time() * 1000) - _EARLIER_MS
        copies = [replace(action, id=command_id(device, earlier_ms - number)) for number in range(_ROWS)]
        for first in range(0, _ROWS, _BATCH):
            batch = [Write("create", new_row(each)) for each in copies[first : first + _BATCH]]
            await tables.batch(records.CONTROL, batch)

    def _read_all(self) -> None:
        with httpx.Client(
            base_url=self._product.api, headers=dict(self._product.http.headers), timeout=_TIMEOUT_S
        ) as http:
            while not self._stopping.is_set():
                self._read(http, "/devices", _DEVICES)
                self._read(http, f"{self._product.device(ACTION_ARM)}/actions", _ROWS)

    def _read(self, http: httpx.Client, path: str, least: int) -> None:
        """Reads all pages of a list."""
        ids: list[str] = []
        cursor: dict[str, str] = {}
        while not self._stopping.is_set():
            started_s = time.monotonic()
            response = http.get(path, params={"limit": _PAGE, **cursor})
            self.page_ms.append((time.monotonic() - started_s) * 1000)
            if response.is_error:
                self.problems.append(f"{path}: {response.status_code}")
                return
            page = response.json()
            ids += [each["id"] for each in page["items"]]
            if page["cursor"] is None:
                if len(set(ids)) != len(ids) or len(ids) < least:
                    self.problems.append(f"{path}: {len(ids)} rows, {len(set(ids))} different")
                return
            cursor = {"cursor": page["cursor"]}
