"""One simulated agent: requests credentials, connects, and reconnects like a real agent."""

import asyncio
import time
from concurrent.futures import Executor

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from device_agent.config.identity_store import Pairing
from device_agent.load_generator.connection import Connection, ProtocolVersion, VersionRejected
from device_agent.load_generator.kinematic_arm import ArmType
from device_agent.load_generator.metrics import Metrics
from device_agent.load_generator.options import LoadOptions
from device_agent.load_generator.robot import SimulatedRobot
from device_agent.ports.clock import CloudClock, wall_ms
from device_agent.protocol import KINDS, PROTOCOL, Presence, codec, topics
from device_agent.runtime.commands.pinned_keys import PinnedKeys
from device_agent.transports.backoff import BackOff
from device_agent.transports.http import responses
from device_agent.transports.http.client import CloudClient
from device_agent.transports.mqtt import BrokerAccess, broker_access

SOFTWARE = "telescope-load-test 0.1.0"
_REFRESH_AT = 0.8


class LoadAgent:
    """One agent of a run. ``pool`` has threads for blocking calls."""

    def __init__(
        self,
        options: LoadOptions,
        client: CloudClient,
        pairing: Pairing,
        arm_type: ArmType,
        *,
        identity: Ed25519PrivateKey,
        clock: CloudClock,
        version: ProtocolVersion,
        metrics: Metrics,
        pool: Executor,
    ) -> None:
        self._options = options
        self._client = client
        self._pairing = pairing
        self._version = version
        self._metrics = metrics
        self._pool = pool
        self._session = 0
        self._connection: Connection | None = None
        self._stopping = asyncio.Event()
        self._robot = SimulatedRobot(
            (pairing.space, pairing.agent),
            arm_type,
            keys=PinnedKeys(pairing, identity=identity, save=lambda _: None, now_ms=clock.now_ms),
            cloud_ms=clock.now_ms,
            publish=self._publish,
            now_s=time.monotonic(),
        )

    @property
    def up(self) -> bool:
        """Whether the agent is connected."""
        return self._connection is not None and self._connection.up and not self._connection.lost

    def tick(self, now_s: float) -> None:
        """Publish telemetry if connected."""
        if self.up:
            self._robot.tick(now_s)

    def poll(self) -> None:
        """Send MQTT keep-alive messages when they are due."""
        if self._connection is not None:
            self._connection.poll()

    def stop(self) -> None:
        """Make ``run`` disconnect and return."""
        self._stopping.set()

    async def run(self, delay_s: float) -> None:
        """Connect after a delay [s], and stay connected until ``stop``."""
        await self._pause(delay_s)
        back_off = BackOff()
        while not self._stopping.is_set():
            back_off.attempt()
            try:
                await self._connect_once()
            except VersionRejected:
                continue
            except (OSError, ValueError) as error:
                self._metrics.record_error(str(error))
            await self._pause(back_off.wait_s())

    async def _connect_once(self) -> None:
        access = await asyncio.get_running_loop().run_in_executor(self._pool, self._access)
        # Without a journal, the wall clock provides session numbers that increase across runs.
        self._session = max(self._session + 1, wall_ms())
        will = (topics.conn(self._pairing.space, self._pairing.agent), self._presence(online=False))
        connection = Connection(access, self._version, will=will, metrics=self._metrics, receive=self._receive)
        try:
            await connection.open(self._pool)
            self._connection = connection
            self._metrics.record_connected()
            try:
                connection.publish(will[0], self._presence(online=True), qos=1, retain=True)
                self._robot.on_connected(time.monotonic())
                await self._wait_for_end(connection, access.lifetime_s * _REFRESH_AT)
            finally:
                self._metrics.connected -= 1
                self._metrics.counts.lost_links += connection.lost
                self._robot.on_disconnected()
        finally:
            self._connection = None
            await connection.close((will[0], self._presence(online=False)))

    async def _wait_for_end(self, connection: Connection, timeout_s: float) -> None:
        stopping = asyncio.ensure_future(self._stopping.wait())
        lost = asyncio.ensure_future(connection.wait_lost(timeout_s))
        await asyncio.wait({stopping, lost}, return_when="FIRST_COMPLETED")
        stopping.cancel()
        lost.cancel()

    def _access(self) -> BrokerAccess:
        credentials = responses.read(self._client.credentials(), responses.MqttCredentials)
        host = credentials.tcp.host
        if not self._options.may_connect_to(host):
            raise ValueError(f"the server's broker is at {host}, which is not permitted; add --broker {host}")
        if credentials.tcp.certificate_after_ms is not None:
            raise ValueError("the server's broker requires client certificates, which simulated agents do not have")
        return broker_access(credentials, self._client)

    def _receive(self, topic: str, payload: bytes) -> None:
        before = self._robot.refused
        self._robot.receive(topic, payload, time.monotonic())
        self._metrics.counts.refused += self._robot.refused - before

    def _publish(self, topic: str, payload: bytes, *, qos: int, retain: bool = False) -> None:
        if self._connection is not None:
            self._connection.publish(topic, payload, qos=qos, retain=retain)

    def _presence(self, *, online: bool) -> bytes:
        return codec.encode(
            Presence(
                online=online,
                session=self._session,
                at_ms=wall_ms(),
                software=SOFTWARE,
                protocol=PROTOCOL,
                capabilities=KINDS,
            )
        )

    async def _pause(self, wait_s: float) -> None:
        try:
            async with asyncio.timeout(wait_s):
                await self._stopping.wait()
        except TimeoutError:
            return
