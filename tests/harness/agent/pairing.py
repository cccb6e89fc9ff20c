"""Pairs an agent that a test runs as a process."""

from collections.abc import Sequence
from pathlib import Path

from device_agent.config import catalogue
from device_agent.config.agent_config import AgentConfig, DeviceEntry, Recording
from device_agent.config.identity_store import IdentityStore, Pairing
from device_agent.ports.clock import CloudClock
from device_agent.transports.http.client import CloudClient
from device_agent.transports.pairing_monitor import SOFTWARE
from tests.harness.cloud.cloud_processes import CloudProcesses

NOT_RECORDED = Recording(enabled=False)


def paired_arm(processes: CloudProcesses, folder: Path, *, transport: str = "mqtt") -> str:
    """Pair an agent with a simulated arm; returns the id of the arm."""
    arm = DeviceEntry(name="arm", type="ur5")
    return paired_devices(processes, folder, [arm], transport=transport)["arm"]


def paired_devices(
    processes: CloudProcesses,
    folder: Path,
    devices: Sequence[DeviceEntry],
    *,
    transport: str = "mqtt",
    recording: Recording = NOT_RECORDED,
) -> dict[str, str]:
    """Pair an agent with these devices; returns their ids by name."""
    store = IdentityStore(folder)
    key = store.private_key(create=True)
    AgentConfig(
        server=processes.url, name="lab", devices=tuple(devices), transport=transport, recording=recording
    ).save(store.folder)
    config = AgentConfig.load(store.folder)
    api = CloudClient(processes.url, key, CloudClock())
    claim = api.enroll(
        name="lab", software=SOFTWARE, transport=config.transport, devices=catalogue.enrolled_devices(config)
    )
    claimed = processes.anna.post("/agents/claim", {"code": claim.code}).json()["devices"]
    enrollment = api.enrollment()
    keys = {each["id"]: each["public"] for each in enrollment["keys"]}
    pairing = Pairing(
        agent=enrollment["agent"], space=enrollment["space"], account="anna", owner=processes.anna.account, keys=keys
    )
    store.save_pairing(pairing)
    return {device["name"]: device["id"] for device in claimed}
