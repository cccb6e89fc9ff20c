"""One simulated agent: requests credentials, connects, and reconnects like a real agent."""

import asyncio
import time
from concurrent.futures import Executor

from device_agent.config.identity_store import Pairing
from device_agent.load_generator.connection import Dialect, Link, OlderDialect
from device_agent.load_generator.kinematic_arm import Shape
from device_agent.load_generator.metrics import Metrics
from device_agent.load_generator.options import LoadOptions
from device_agent.load_generator.robot import SwarmRobot
from device_agent.ports.clock import CloudClock, wall_ms
from device_agent.protocol import Presence, codec, topics
from device_agent.runtime.commands.pinned_keys import PinnedKeys
from device_agent.transports.backoff import BackOff
from device_agent.transports.http import responses
from device_agent.transports.http.client import CloudClient
from device_agent.transports.mqtt import BrokerAccess, broker_access

SOFTWARE = "telescope-swarm 0.1.0"
_REFRESH_AT = 0.8


class LoadAgent:
    """One agent of a run. ``pool`` has threads for blocking calls."""

    def __init__(
        self,
        plan: LoadOptions,
        api: CloudClient,
        pairing: Pairing,
        shape: Shape,
        *,
        clock: CloudClock,
        dialect: Dialect,
        figures: Metrics,
        pool: Executor,
    ) -> None:
        self._plan = plan
        self._api = api
        self._pairing = pairing
        self._dialect = dialect
        self._figures = figures
        self._pool = pool
        self._session = 0
        self._link: Link | None = None
        self._stopping = asyncio.Event()
        self._robot = SwarmRobot(
            (pairing.space, pairing.agent),
            shape,
            pins=PinnedKeys(pairing, save=lambda _: None, now_ms=clock.now_ms),
            cloud_ms=clock.now_ms,
            say=self._say,
            now_s=time.monotonic(),
        )

    @property
    def up(self) -> bool:
        """Whether the agent is connected."""
        return self._link is not None and self._link.up and not self._link.gone

    def tick(self, now_s: float) -> None:
        """Publish telemetry if there is a link."""
        if self.up:
            self._robot.tick(now_s)

    def look(self) -> None:
        """Keep the link alive."""
        if self._link is not None:
            self._link.look()

    def stop(self) -> None:
        """Make ``run`` disconnect and return."""
        self._stopping.set()

    async def run(self, after_s: float) -> None:
        """Connect after a delay [s], and stay connected until ``stop``."""
        await self._pause(after_s)
        back_off = BackOff()
        while not self._stopping.is_set():
            back_off.attempt()
            try:
                await self._connect_once()
            except OlderDialect:
                continue
            except (OSError, ValueError) as error:
                self._figures.trouble(str(error))
            await self._pause(back_off.wait_s())

    async def _connect_once(self) -> None:
        access = await asyncio.get_running_loop().run_in_executor(self._pool, self._access)
        # The wall clock rises across runs; there is no journal to count sessions.
        self._session = max(self._session + 1, wall_ms())
        will = (topics.conn(self._pairing.space, self._pairing.agent), self._presence(online=False))
        link = Link(access, self._dialect, will=will, figures=self._figures, receive=self._receive)
        try:
            await link.open(self._pool)
            self._link = link
            self._figures.up()
            try:
                link.publish(will[0], self._presence(online=True), qos=1, retain=True)
                self._robot.introduce(time.monotonic())
                await self._stay(link, access.lifetime_s * _REFRESH_AT)
            finally:
                self._figures.connected -= 1
                self._figures.counts.lost_links += link.gone
                self._robot.lost()
        finally:
            self._link = None
            await link.close((will[0], self._presence(online=False)))

    async def _stay(self, link: Link, within_s: float) -> None:
        stopping = asyncio.ensure_future(self._stopping.wait())
        staying = asyncio.ensure_future(link.stay(within_s))
        await asyncio.wait({stopping, staying}, return_when="FIRST_COMPLETED")
        stopping.cancel()
        staying.cancel()

    def _access(self) -> BrokerAccess:
        credentials = responses.read(self._api.credentials(), responses.MqttCredentials)
        host = credentials.tcp.host
        if not self._plan.may_connect_to(host):
            raise ValueError(f"the server's broker is at {host}, which was not named; say --broker {host}")
        if credentials.tcp.certificate_after_ms is not None:
            raise ValueError("the server's broker wants a certificate of each agent; a swarm has none")
        return broker_access(credentials, self._api)

    def _receive(self, topic: str, payload: bytes) -> None:
        before = self._robot.refused
        self._robot.receive(topic, payload, time.monotonic())
        self._figures.counts.refused += self._robot.refused - before

    def _say(self, topic: str, payload: bytes, *, qos: int, retain: bool = False) -> None:
        if self._link is not None:
            self._link.publish(topic, payload, qos=qos, retain=retain)

    def _presence(self, *, online: bool) -> bytes:
        return codec.encode(Presence(online=online, session=self._session, at_ms=wall_ms(), software=SOFTWARE))

    async def _pause(self, wait_s: float) -> None:
        try:
            async with asyncio.timeout(wait_s):
                await self._stopping.wait()
        except TimeoutError:
            return
