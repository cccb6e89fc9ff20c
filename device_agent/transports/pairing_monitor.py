"""Whether the agent still belongs to its space; credentials and key changes from the cloud."""

import logging
import threading
from collections.abc import Callable
from typing import Any

from device_agent.config.agent_config import AgentConfig
from device_agent.config.identity_store import Pairing
from device_agent.config.release import VERSION
from device_agent.protocol import topics
from device_agent.runtime.commands.pinned_keys import PinnedKeys
from device_agent.runtime.errors import Refused
from device_agent.transports.http import responses
from device_agent.transports.http.client import CloudClient, CloudError

_log = logging.getLogger(__name__)
SOFTWARE = f"telescope-agent {VERSION}"


def pairing_of(claimed: responses.Claimed) -> Pairing:
    """The pairing that a claimed agent saves."""
    return Pairing(
        agent=claimed.agent,
        space=claimed.space,
        account=claimed.account.name,
        owner=claimed.account.id,
        keys={key.id: key.public for key in claimed.keys},
        serial=claimed.serial,
        until_ms={key.id: key.until_ms for key in claimed.keys if key.until_ms},
    )


class PairingMonitor:
    """Detects that the agent was unpaired or moved to another space, and follows key rotations.

    Requests raise ``CloudError`` if the cloud rejects them or the pairing is not valid, and ``OSError`` if the cloud
    cannot be reached.

    Args:
        pairing: The pairing with which the agent was built.
        config: Sent to the cloud at the first connection, so that changes of ``agent.toml`` need no new enrollment.
        devices: The devices as the cloud receives them.
        keys: Pinned keys, updated from the cloud's responses.
    """

    def __init__(self, pairing: Pairing, config: AgentConfig, devices: list[dict[str, str]], keys: PinnedKeys) -> None:
        self._pairing = pairing
        self._keys = keys
        self._config = config
        self._devices = devices
        self._announced = False
        self.outdated = threading.Event()

    def credentials(self, api: CloudClient) -> dict[str, Any]:
        """Broker credentials for the space."""
        credentials = self._request(api, api.credentials)
        own = f"{topics.ROOT}/{self._pairing.space}/{self._pairing.agent}/"
        if not all(str(pattern).startswith(own) for pattern in credentials.get("subscribe", ())):
            raise self._mark_outdated("this agent belongs to another space now")
        return credentials

    def xmpp_credentials(self, api: CloudClient) -> dict[str, Any]:
        """Credentials for the XMPP server."""
        credentials = self._request(api, api.xmpp_credentials)
        self._check_space(credentials)
        return credentials

    def check(self, api: CloudClient, *, within_s: float = 10.0) -> None:
        """Check within ``within_s`` [s] that the pairing is still valid."""
        enrollment = self._request(api, lambda: api.enrollment(within_s=within_s))
        if enrollment.get("state") != "claimed":
            raise self._mark_outdated("this agent was unpaired")
        self._check_space(enrollment)

    def _check_space(self, response: dict[str, Any]) -> None:
        if response.get("space") != self._pairing.space:
            raise self._mark_outdated("this agent belongs to another space now")

    def _request(self, api: CloudClient, call: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        try:
            self._announce(api)
            response = call()
            self._update_keys(responses.read(response, responses.KeyUpdate))
        except CloudError as error:
            if error.code == "agent-unclaimed":
                raise self._mark_outdated("this agent was unpaired") from error
            # The cloud no longer knows the agent: announce it again with the next request.
            self._announced = self._announced and error.code != "unauthorized"
            raise
        return response

    def _update_keys(self, update: responses.KeyUpdate) -> None:
        """Follow key rotations. On failure the link stays useful for Stop and telemetry."""
        try:
            self._keys.follow(update.key_statements)
        except Refused as refused:
            _log.error("the cloud's new key is not trusted: %s", refused.message)
        self._keys.check(update.signing_key)

    def _announce(self, api: CloudClient) -> None:
        if self._announced:
            return
        config = self._config
        claim = api.enroll(name=config.name, software=SOFTWARE, transport=config.transport, devices=self._devices)
        if claim.code is not None:
            raise self._mark_outdated("this agent was unpaired")
        self._announced = True

    def _mark_outdated(self, message: str) -> CloudError:
        self.outdated.set()
        return CloudError(message)
