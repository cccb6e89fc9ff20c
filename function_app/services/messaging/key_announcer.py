"""Announces a new signing key to agents, with a command signed by the previous key."""

import logging

from device_agent.protocol import RotateKey
from function_app.domain.common.problems import Problem
from function_app.domain.devices.devices import Agent
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.signing_keys import SigningKeys
from function_app.services.devices.device_access import devices_of
from function_app.services.messaging.command_sender import CommandSender

_CALLER = "telescope"
_log = logging.getLogger(__name__)


class KeyAnnouncer:
    """Announces keys. Agents also request keys themselves, with every request for credentials."""

    def __init__(self, *, keys: SigningKeys, command_sender: CommandSender) -> None:
        self._keys = keys
        self._command_sender = command_sender
        self._serial = 0
        self._announced: set[str] = set()

    async def on_state(self, agent: Agent, device: str) -> None:
        """Announce a new key to the agent of a device that has sent its state; once per process.

        Raises:
            StoreError: The keys cannot be read.
        """
        announcement = await self._keys.announcement()
        if announcement.signing == announcement.pins[-1].id:
            return
        if announcement.serial != self._serial:
            self._serial = announcement.serial
            self._announced.clear()
        if agent.id in self._announced:
            return
        target = next(each for each in devices_of(agent) if each.name == device)
        try:
            await self._command_sender.send(
                target, RotateKey(statements=announcement.statements), caller=_CALLER, epoch=0
            )
        except (BusUnavailable, Problem) as error:
            _log.warning("the new key was not announced to agent %s: %s", agent.id, error)
            return
        self._announced.add(agent.id)
