"""Downloads the robot types of the agent's devices that are not on this machine, before the devices start."""

import logging
import time

from device_agent import bootstrap
from device_agent.config import catalogue
from device_agent.config.agent_config import AgentConfig
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore
from device_agent.config.robot_type_store import RobotTypeStore
from device_agent.ports.clock import CloudClock
from device_agent.transports.http.client import CloudClient, CloudError
from device_agent.transports.pairing_monitor import SOFTWARE

_RETRY_S = 5.0
_log = logging.getLogger(__name__)


def update(store: IdentityStore) -> None:
    """Download missing robot types and newer versions of downloaded ones, and add them to the search path.

    Without a connection the stored version is used. A missing type is requested until the cloud responds.

    Raises:
        ConfigError: A type that is not stored cannot be used. The message names the cause.
    """
    config, pairing = AgentConfig.load(store.folder), store.pairing()
    downloaded = store.robot_types.resolve()
    local = {name for name, folder in catalogue.TYPES.folders().items() if folder.parent != downloaded}
    catalogue.add_search_path(store.robot_types)
    types_of_robots = {
        entry.type for entry in config.devices if not (entry.room or catalogue.is_device_type(entry.type))
    }
    missing = sorted(types_of_robots - local)
    if pairing is None or not missing:
        return
    types = RobotTypeStore(store.robot_types, agent=pairing.agent, keys=pairing.public_keys())
    api = bootstrap.cloud_client(store, config, CloudClock())
    for name in missing:
        while not _download(api, config, types, pairing.agent, name):
            time.sleep(_RETRY_S)


def _download(api: CloudClient, config: AgentConfig, types: RobotTypeStore, agent: str, name: str) -> bool:
    """Install the newest version; returns whether a version is stored now."""
    try:
        # The cloud sends only types of registered devices.
        devices = catalogue.enrolled_devices(config)
        api.enroll(name=config.name, software=SOFTWARE, transport=config.transport, devices=devices)
        statement, files = api.robot_type(agent, name)
        if types.install(name, statement, files):
            print(f"downloaded robot type {name}, version {types.version(name)}", flush=True)
    except (OSError, CloudError, ConfigError) as error:
        if types.version(name):
            _log.warning("robot type '%s' is not updated: %s", name, error)
        elif isinstance(error, ConfigError) or (isinstance(error, CloudError) and not error.passing):
            known = ", ".join(catalogue.TYPES.folders())
            raise ConfigError(
                f"robot type '{name}' is not on this machine (known: {known}), and cannot be downloaded: {error}"
            ) from error
        else:
            print(f"waiting for the cloud to download robot type {name}: {error}", flush=True)
    return types.version(name) > 0
