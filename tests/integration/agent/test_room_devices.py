"""Real room devices of an agent: a viewer sees a Modbus thermometer, an operator switches a Tasmota relay."""

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import pytest

from device_agent.config.agent_config import DeviceEntry
from device_agent.protocol import Measurements, codec, topics
from function_app.ports.broker_access import Credentials
from tests.harness.agent.pairing import paired_devices
from tests.harness.cloud.cloud import Person
from tests.harness.cloud.cloud_processes import CloudProcesses, start_cloud_processes
from tests.harness.network.brokers import HOST, Client, wait_until
from tests.harness.paths import ROOT
from tests.harness.robots.room_devices.house_broker import PASSWORD, HouseBroker
from tests.harness.robots.room_devices.modbus import ModbusPeer
from tests.harness.robots.room_devices.tasmota import Tasmota


def entries(modbus: ModbusPeer, house: HouseBroker) -> list[DeviceEntry]:
    thermometer = {
        "name": "boiler",
        "type": "thermometer",
        "driver": "modbus",
        "label": "Boiler",
        "streams": [{"name": "water", "rate_hz": 5.0}],
        "options": {
            "host": HOST,
            "port": modbus.port,
            "timeout_s": 0.5,
            "streams": {"water": {"temperature_c": {"address": 0, "table": "input", "scale": 0.1}}},
        },
    }
    plug = {
        "name": "plug",
        "type": "plug",
        "driver": "tasmota",
        "label": "Plug",
        "streams": [{"name": "settings", "rate_hz": 5.0}],
        "controls": [{"name": "relay", "label": "Relay", "lower": 0.0, "upper": 1.0}],
        "options": {"broker": house.options(), "topic": "plug", "controls": {"relay": {"command": "POWER1"}}},
    }
    return msgspec.convert([thermometer, plug], list[DeviceEntry])


@dataclass
class Site:
    """The cloud, an agent with its devices, and the devices' ids."""

    processes: CloudProcesses
    modbus: ModbusPeer
    tasmota: Tasmota
    ids: dict[str, str]
    log: Path

    def state(self, name: str) -> dict[str, Any]:
        device: dict[str, Any] = self.processes.anna.get(f"/devices/{self.ids[name]}").json()
        return device

    def shared(self, person: str, role: str) -> Person:
        """A person with this role on all devices."""
        someone = self.processes.cloud.sign_in(person)
        for device in self.ids.values():
            share = {"account": someone.name, "role": role}
            assert self.processes.anna.post(f"/devices/{device}/shares", share).status_code == 201
        return someone


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with (
        HouseBroker(tmp_path / "house") as house,
        Tasmota(house, "plug") as tasmota,
        ModbusPeer() as modbus,
        start_cloud_processes("amqtt", tmp_path / "cloud") as processes,
        (tmp_path / "log").open("wb") as log,
    ):
        modbus.put("input", 0, [655])
        ids = paired_devices(processes, tmp_path / "agent", entries(modbus, house))
        command = [sys.executable, "-m", "device_agent", "run", "--home", str(tmp_path / "agent")]
        with subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log, env=os.environ) as agent:
            try:
                site = Site(processes, modbus, tasmota, ids, tmp_path / "log")
                wait_until(lambda: all(site.state(name)["online"] for name in ids), "the agent")
                yield site
            finally:
                agent.kill()


def watching(site: Site, person: Person) -> Client:
    """A connection of a person with the permissions of a viewer."""
    issued = person.post("/mqtt/credentials", {"purpose": "view"}).json()
    credentials = Credentials(issued["username"], issued["password"])
    client = site.processes.broker.running.connect(issued["client_id"], credentials)
    assert client.subscribe(*issued["subscribe"])
    return client


@pytest.mark.timeout(300)
def test_a_viewer_sees_the_thermometer_and_an_operator_switches_the_relay(site: Site) -> None:
    viewer, operator = site.shared("victor", "viewer"), site.shared("oscar", "operator")
    plug = f"/devices/{site.ids['plug']}"
    switch: dict[str, Any] = {
        "request": {"kind": "set_control", "control": "relay", "value": 1.0},
        "wait_for": "done",
        "wait_ms": 20_000,
    }

    with watching(site, viewer) as client:
        seen: list[float | bool] = []

        def sees(value: float) -> bool:
            seen.extend(
                codec.decode(message.payload, Measurements).values["temperature_c"]
                for message in client.pending()
                if message.topic.endswith(f"/boiler/{topics.TELE}/water")
            )
            return bool(seen) and seen[-1] == pytest.approx(value)

        wait_until(lambda: sees(65.5), "the value of the thermometer")
        site.modbus.put("input", 0, [701])
        wait_until(lambda: sees(70.1), "the next value of the thermometer")
    assert viewer.post(f"{plug}/actions", switch).status_code == 403
    assert site.tasmota.state["POWER"] == "OFF"

    lease = operator.post(f"{plug}/lease", {"lease_ms": 60_000}).json()
    blocked = site.processes.anna.post(f"{plug}/actions", switch)
    assert blocked.status_code == 409, blocked.text
    done = operator.post(f"{plug}/actions", {**switch, "epoch": lease["epoch"]}).json()
    assert (done["status"], done["result"]) == ("done", {"applied": {"relay": 1.0}}), done
    assert site.tasmota.state["POWER"] == "ON"

    site.tasmota.vanish()
    wait_until(lambda: "is off line" in str(site.state("plug")["state"]), "the fault of the plug")
    off = {**switch, "request": {**switch["request"], "value": 0.0}, "epoch": lease["epoch"]}
    failed = operator.post(f"{plug}/actions", off).json()
    assert (failed["status"], failed["reason"]["code"]) == ("failed", "lease_ended"), "a fault ends control"
    assert site.tasmota.state["POWER"] == "ON"
    assert site.state("boiler")["state"]["faults"] == []
    assert PASSWORD not in site.log.read_text()
