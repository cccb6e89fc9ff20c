"""People who operate devices through the API and the broker."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from device_agent.protocol import JointTarget, JointTelemetry, MoveJoints, Setpoint, codec, topics
from device_agent.protocol.security import setpoints
from function_app.domain.common.problems import Problem
from function_app.domain.identity.accounts import Account, Identity, Role
from function_app.services.actions.requests import ActionRequest
from function_app.services.identity.sessions import SignInOrigin
from tests.simulation.actors.driver import JOINT
from tests.simulation.checks.history import Operation
from tests.simulation.network.broker import Link, Packet
from tests.simulation.plan import PEOPLE

if TYPE_CHECKING:
    from function_app.bootstrap import Functions
    from tests.simulation.plan import Step
    from tests.simulation.world import World

TELEMETRY_S = 1.5


class Person:
    """One person with one sign-in session, and what the person knows.

    Attributes:
        epochs: Device → epoch of the newest lease of this person.
        setpoint_keys: Device → key of that lease.
        actions: Device → ids of the actions that the person started.
        requests: Device → the person's open request for control.
    """

    def __init__(self, world: "World", name: str) -> None:
        self.world = world
        self.name = name
        self.account: Account
        self.identity: Identity
        self.epochs: dict[str, int] = {}
        self.setpoint_keys: dict[str, bytes] = {}
        self.actions: dict[str, list[str]] = {}
        self.sequence = 0

    async def sign_in(self, functions: "Functions") -> None:
        """Begin a new session."""
        self.account = await functions.sign_in.account(self.name)
        signed_in = await functions.sessions.begin(self.account, "link", SignInOrigin())
        self.identity = Identity(self.account.id, self.account.name, signed_in.session)

    async def perform(self, step: "Step") -> None:
        """Perform one step of the plan."""
        arguments = dict(step.arguments)
        device = self.world.devices[arguments.pop("device")]
        await getattr(self, step.kind)(device, **arguments)

    async def request(
        self,
        operation: Operation,
        send: Callable[["Functions"], Awaitable[Any]],
        result: Callable[[Any], dict[str, Any]] = lambda _: {},
    ) -> Any:
        """Send a request; ``None`` if it was rejected or its response was lost."""
        history = self.world.history
        try:
            response = await self.world.call(self.name, send)
        except Problem as problem:
            history.complete(operation, problem.code)
            return None
        except OSError:
            history.complete(operation, "lost")
            return None
        history.complete(operation, "ok", **result(response))
        return response

    # ------------------------------------------------------------ leases

    async def acquire(self, device: str, *, lease_ms: int, over: str = "", epoch: int | None = None) -> None:
        kind = "take_over" if over else "acquire" if epoch is None else "renew"
        operation = self.world.history.invoke(
            self.name, kind, device, lease_ms=lease_ms, **({"epoch": epoch} if epoch else {})
        )
        acquired = await self.request(
            operation,
            lambda functions: functions.leases.acquire(
                self.identity, device, epoch=epoch, lease_ms=lease_ms, wait_ms=500, over=over
            ),
            lambda each: {
                "granted": each.lease.epoch,
                "confirmed": each.confirmed,
                "expires_ms": each.lease.expires_ms,
            },
        )
        if acquired is not None:
            self.epochs[device] = acquired.lease.epoch
            self.setpoint_keys[device] = acquired.setpoint_key

    async def take_over(self, device: str, *, lease_ms: int) -> None:
        await self.acquire(device, lease_ms=lease_ms, over="needed")

    async def renew(self, device: str, *, lease_ms: int) -> None:
        if device in self.epochs:
            await self.acquire(device, lease_ms=lease_ms, epoch=self.epochs[device])

    async def release(self, device: str) -> None:
        epoch = self.epochs.get(device)
        if epoch is not None:
            operation = self.world.history.invoke(self.name, "release", device, epoch=epoch)
            await self.request(
                operation, lambda functions: functions.leases.release(self.identity, device, epoch=epoch)
            )

    async def hand_over(self, device: str) -> None:
        """Request control; the holder accepts after a while."""
        operation = self.world.history.invoke(self.name, "request", device)
        created = await self.request(
            operation,
            lambda functions: functions.control_requests.create(
                self.identity, device, within_ms=5000, lease_ms=4000, wait_ms=0
            ),
        )
        if created is None:
            return
        lease, control_request = created[0], created[1]
        holder = next((each for each in self.world.people.values() if each.identity.session == lease.session), None)
        if holder is None:
            return
        await asyncio.sleep(self.world.rng("people").uniform(0.1, 1.0))
        operation = self.world.history.invoke(holder.name, "accept", device, epoch=lease.epoch, to=self.name)
        accepted = await holder.request(
            operation,
            lambda functions: functions.control_requests.accept(
                holder.identity, device, control_request.id, wait_ms=500
            ),
            lambda each: {"granted": each[0].epoch, "expires_ms": each[0].expires_ms},
        )
        if accepted is not None:
            await self.acquire(device, lease_ms=4000, epoch=accepted[0].epoch)

    # ------------------------------------------------------------ setpoints

    async def stream(self, device: str, *, for_s: float, gap_ms: int, stubborn: bool) -> None:
        """Stream setpoints. A stubborn person continues after losing control."""
        epoch, key = self.epochs.get(device), self.setpoint_keys.get(device)
        if epoch is None or key is None:
            return
        operation = self.world.history.invoke(self.name, "stream", device, epoch=epoch)
        issued = await self.request(
            operation,
            lambda functions: _both(
                functions.mqtt_credentials.watch(self.identity),
                functions.mqtt_credentials.control(self.identity, device, epoch),
            ),
        )
        if issued is None:
            return
        watch, control = issued
        telemetry = await self._connect(watch.client_id, watch.credentials, self.world.telemetry_topic(device))
        steering = await self._connect(control.client_id, control.credentials)
        loop = self.world.loop
        end_s = loop.time() + for_s
        first_s = loop.time() + TELEMETRY_S
        target = self.world.rng("setpoints").uniform(-2.5, 2.5)
        while loop.time() < end_s and (telemetry.tick_ms or loop.time() < first_s):
            if telemetry.tick_ms and (stubborn or self.epochs.get(device) == epoch):
                self._send(device, epoch, key, steering, telemetry.tick_ms, target)
            await asyncio.sleep(gap_ms / 1000)
        telemetry.close()
        steering.close()

    def _send(  # noqa: PLR0917 (the parts of one message)
        self, device: str, epoch: int, key: bytes, steering: "Viewer", tick_ms: int, target_rad: float
    ) -> None:
        self.sequence += 1
        topic = self.world.topic(device, topics.CTL, str(epoch))
        setpoint = Setpoint(
            epoch=epoch,
            sequence=self.sequence,
            echo_tick_ms=tick_ms,
            sent_ms=float(PEOPLE.index(self.name)),  # names the sender to the checks
            target=JointTarget(position_rad={JOINT: target_rad}),
        )
        steering.link.publish(Packet(topic, setpoints.seal(codec.encode(setpoint), key, topic)))

    async def _connect(self, client_id: str, credentials: Any, *filters: str) -> "Viewer":
        viewer = Viewer(self, filters)
        viewer.link = self.world.broker.connect(self.name, client_id, credentials, viewer)
        self.world.open_links.append(viewer.link)
        await asyncio.sleep(0.03)
        return viewer

    # ------------------------------------------------------------ actions and Stop

    async def start(
        self,
        device: str,
        *,
        policy: str,
        to_rad: float,
        ttl_ms: int,
        timeout_ms: int,
        wait_ms: int,
        with_lease: bool,
        retries: int,
    ) -> None:
        epoch = self.epochs.get(device) if with_lease else None
        request = ActionRequest(
            request=MoveJoints(position_rad={JOINT: to_rad}, speed=1.0),
            policy=policy,  # type: ignore[arg-type]
            queue_ms=8000,
            ttl_ms=ttl_ms,
            timeout_ms=timeout_ms,
            wait_ms=wait_ms,
            wait_for="done",
            epoch=epoch,
        )
        key = f"key{self.world.next_number()}" if retries else ""
        first = None
        for attempt in range(retries + 1):
            operation = self.world.history.invoke(
                self.name, "start", device, key=key, epoch=epoch or 0, attempt=attempt
            )
            started = await self.request(
                operation,
                lambda functions: functions.start_action.start(self.identity, device, request, idempotency_key=key),
                lambda each: {"action": each[0].id, "status": each[0].status.value, "rank": each[0].status.rank},
            )
            if started is not None:
                action = started[0].id
                if first not in {None, action} and not self.world.faults.keys_may_end:
                    self.world.history.violate("idempotency", f"key {key} started {first} and {action}")
                first = action
                self.actions.setdefault(device, []).append(action)
            if operation.outcome != "lost" and self.world.rng("people").random() < 0.7:
                return

    async def burst(self, device: str, **options: Any) -> None:
        """Send the same request twice at the same time, as two programs of one person do."""
        await asyncio.gather(self.start(device, **options), self.start(device, **options))

    async def cancel(self, device: str) -> None:
        await self._on_last_action(
            "cancel", device, lambda functions, action: functions.actions.cancel(self.identity, action)
        )

    async def read(self, device: str) -> None:
        await self._on_last_action(
            "read",
            device,
            lambda functions, action: functions.actions.get(self.identity, action, wait_ms=500, wait_for="done"),
        )

    async def _on_last_action(
        self, kind: str, device: str, request: Callable[["Functions", str], Awaitable[Any]]
    ) -> None:
        actions = self.actions.get(device)
        if not actions:
            return
        action = actions[-1]
        operation = self.world.history.invoke(self.name, kind, device, action=action)
        await self.request(
            operation,
            lambda functions: request(functions, action),
            lambda each: {"status": each.status.value, "rank": each.status.rank},
        )

    async def stop(self, device: str) -> None:
        operation = self.world.history.invoke(self.name, "stop", device)
        result = await self.request(
            operation,
            lambda functions: functions.stop.stop(self.identity, device, "look"),
            lambda each: {"stop": each.outcome.value},
        )
        if result is not None and result.outcome.value == "confirmed":
            self.world.monitors.stop_confirmed(operation)

    async def reset(self, device: str) -> None:
        operation = self.world.history.invoke(self.name, "reset", device)
        await self.request(
            operation, lambda functions: functions.stop.reset(self.identity, device), lambda each: {"confirmed": each}
        )

    # ------------------------------------------------------------ sharing and pairing

    async def share(self, device: str, *, role: str) -> None:
        """The owner changes Carl's role; ``""`` ends the share."""
        owner, carl = self.world.owner_of(device), self.world.people["carl"]
        if owner.name != "anna":
            return
        operation = self.world.history.invoke(owner.name, "share", device, role=role)

        async def change(functions: "Functions") -> bool:
            sharing = functions.sharing
            target = await sharing.of(owner.identity, "device", device)
            if role:
                await sharing.put(owner.identity, target, carl.account, Role(role), None)
            else:
                await sharing.end(owner.identity, target, carl.account.id)
            return True

        await owner.request(operation, change)

    async def snoop(self, device: str) -> None:
        """Another tenant tries to read and control the device."""
        if self.world.owner_of(device).name in {self.name, "anna"} and self.name != "bert":
            return
        if self.world.owner_of(device) is self:
            return
        for kind, request in (
            ("get", lambda functions: functions.devices.get(self.identity, device)),
            (
                "acquire",
                lambda functions: functions.leases.acquire(self.identity, device, epoch=None, lease_ms=4000, wait_ms=0),
            ),
            ("stop", lambda functions: functions.stop.stop(self.identity, device, "")),
        ):
            operation = self.world.history.invoke(self.name, f"snoop-{kind}", device)
            await self.request(operation, request)
            if operation.outcome == "ok":
                self.world.history.violate("tenant", f"{self.name} may {kind} {device}")
        issued = await self.request(
            self.world.history.invoke(self.name, "watch", device),
            lambda functions: functions.mqtt_credentials.watch(self.identity),
        )
        if issued is not None:
            viewer = await self._connect(issued.client_id, issued.credentials, self.world.telemetry_topic(device))
            await asyncio.sleep(0.2)
            viewer.close()

    async def unpair(self, device: str) -> None:
        """The owner unpairs the agent, and pairs it again."""
        owner, machine = self.world.owner_of(device), self.world.machine_of(device)
        operation = self.world.history.invoke(owner.name, "unpair", device)
        await owner.request(operation, lambda functions: functions.unpair.unpair(owner.identity, machine.id))
        await asyncio.sleep(3.0)
        await self.world.pair(machine, owner)


class Viewer:
    """A broker connection of a person; remembers the newest telemetry."""

    link: Link

    def __init__(self, person: Person, filters: tuple[str, ...]) -> None:
        self._person = person
        self._filters = filters
        self.tick_ms = 0

    def close(self) -> None:
        self.link.disconnect()

    def on_connected(self, accepted: bool) -> None:
        if accepted and self._filters:
            self.link.subscribe(dict.fromkeys(self._filters, 0))

    def on_subscribed(self, accepted: bool) -> None:
        """Nothing to do."""

    def on_packet(self, packet: Packet) -> None:
        self.tick_ms = codec.decode(packet.payload, JointTelemetry).tick_ms

    def on_published(self, number: int) -> None:
        """Setpoints are not acknowledged."""

    def on_traffic(self) -> None:
        """Nothing to do."""

    def on_closed(self) -> None:
        """Setpoints are lost from now on."""


async def _both(first: Awaitable[Any], second: Awaitable[Any]) -> tuple[Any, Any]:
    return await first, await second
