"""The product as ``make up`` starts it, with functions and agent that send timestamps.

``python -m benchmarks.tracing.traced_programs machine`` replaces ``python -m infra.local`` and starts traced variants
of the functions and the agent. The product contains no tracing: this module wraps public functions. A missing function
ends the program with its name.

Environment: ``TELESCOPE_BENCH_DEVICE`` (``nao``: the only robot, in its own scene), ``TELESCOPE_BENCH_JOINTS``
(``nao:HeadYaw,qbo:head_pan+left_wheel``: joints with traced motion) and ``TELESCOPE_BENCH_WAYS``
(``8080=9000,8081=9001``: ports that the agent reaches through other ports).
"""

import os
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from pathlib import Path
from typing import Any, Final

from benchmarks.tracing.timestamps import TimestampSender

DEVICE: Final = "TELESCOPE_BENCH_DEVICE"
JOINTS: Final = "TELESCOPE_BENCH_JOINTS"
WAYS: Final = "TELESCOPE_BENCH_WAYS"
STILL_RAD_S: Final = 5e-5
"""Velocity at which a simulated joint starts to move; at rest, all robots stay below 2e-5."""
FAST_RAD_S: Final = 0.002
"""Velocity of visible motion: 0.1 °/s. Motion starts with limited jerk, so this takes time."""
_RESTS: Final = 25
"""Simulation states per 0.1 s."""
Tell = Callable[..., object]
Wrapper = Callable[[Any], Any]


def machine() -> int:
    """Runs the product as ``make up`` does."""
    from infra.local import __main__ as local

    class Traced(local.LocalStack):
        """Starts the traced programs instead of the product's."""

        def _run(self, name: str, *arguments: str) -> Any:
            if name in ("functions", "agent"):
                arguments = ("-m", "benchmarks.tracing.traced_programs", name, *arguments[2:])
            return super()._run(name, *arguments)

    if device := os.environ.get(DEVICE):
        setattr(local, "_ARM", ("--device", f"{device}={device}"))  # noqa: B010 (as below)
    setattr(local, "LocalStack", Traced)  # noqa: B010 (a type checker would not have it)
    return local.main()


# ------------------------------------------------------------ the functions


def functions(arguments: Sequence[str]) -> int:
    """Runs the traced functions."""
    from function_app import __main__ as program
    from function_app.adapters.local.tables import SqliteTables
    from function_app.entrypoints.hosts import uvicorn
    from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
    from function_app.services.actions import acks
    from function_app.services.messaging.delivery import Delivery
    from function_app.services.storage import records

    tell = TimestampSender().tell

    def to_control(name: str) -> Tell:
        return lambda _self, table, *_: tell(name) if table == records.CONTROL else None

    _wrap(uvicorn, "create_app", lambda create: lambda *given: _Door(create(*given), tell))
    _wrap(RequestAuthenticator, "account", _told_after(lambda *_: tell("identified")))
    _wrap(SqliteTables, "batch", _told_first(to_control("writing")))
    _wrap(SqliteTables, "batch", _told_after(to_control("written")))
    _wrap(Delivery, "send", _told_first(lambda *_: tell("publishing")))
    _wrap(acks, "report", _told_first(lambda ack, *_: tell(f"ack-heard:{ack.status.value}")))
    return program.main(arguments)


class _Door:
    """Middleware that marks the arrival and the response of requests that start an action."""

    def __init__(self, app: Any, tell: Tell) -> None:
        self._app = app
        self._tell = tell

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "http" or scope["method"] != "POST" or not scope["path"].endswith("/actions"):
            await self._app(scope, receive, send)
            return

        async def sent(message: Any) -> None:
            # Marked before sending: the caller may have the response before `send` returns.
            if message["type"] == "http.response.body" and not message.get("more_body"):
                self._tell("http-out")
            await send(message)

        self._tell("http-in")
        await self._app(scope, receive, sent)


def _wrap(owner: Any, name: str, around: Wrapper) -> None:
    """Wraps a public function.

    Raises:
        AttributeError: The function does not exist any more.
    """
    setattr(owner, name, around(getattr(owner, name)))


def _told_first(tell: Tell) -> Wrapper:
    """Marks the start of a call."""

    def around(call: Any) -> Any:
        @wraps(call)
        def run(*given: Any, **named: Any) -> Any:
            tell(*given)
            return call(*given, **named)

        return run

    return around


def _told_after(tell: Tell) -> Wrapper:
    """Marks the successful end of a coroutine."""

    def around(call: Any) -> Any:
        @wraps(call)
        async def run(*given: Any, **named: Any) -> Any:
            found = await call(*given, **named)
            tell(*given)
            return found

        return run

    return around


# ------------------------------------------------------------ the agent


def agent(arguments: Sequence[str]) -> int:
    """Runs the traced agent."""
    from device_agent import __main__ as program

    tell = TimestampSender().tell
    _reroute(_pairs(WAYS, "="))
    _tell_messages(tell)
    _tell_control(tell)
    _tell_motion(tell, _pairs(JOINTS, ":"))
    return program.main(arguments)


def _pairs(variable: str, between: str) -> dict[str, str]:
    found = (pair.partition(between) for pair in os.environ.get(variable, "").split(",") if pair)
    return {key: value for key, _, value in found}


def _reroute(ways: Mapping[str, str]) -> None:
    """Redirects the agent's connections to other ports."""
    from device_agent.transports.http.client import CloudClient

    def init(begin: Any) -> Any:
        def run(self: CloudClient, server: str, *given: Any, **named: Any) -> None:
            address, _, port = server.rstrip("/").rpartition(":")
            begin(self, f"{address}:{ways.get(port, port)}", *given, **named)

        return run

    def credentials(ask: Any) -> Any:
        def run(self: CloudClient) -> dict[str, Any]:
            found: dict[str, Any] = ask(self)
            port = str(found["tcp"]["port"])
            found["tcp"]["port"] = int(ways.get(port, port))
            return found

        return run

    _wrap(CloudClient, "__init__", init)
    _wrap(CloudClient, "credentials", credentials)


def _tell_messages(tell: Tell) -> None:
    """Marks messages to a device and its acknowledgements."""
    from device_agent.protocol import topics
    from device_agent.runtime.device import Device
    from device_agent.transports.mqtt.transport import MqttTransport

    def said(_transport: MqttTransport, topic: str, payload: bytes) -> None:
        kind = topics.parse(topic).kind
        if kind == topics.ACK:
            status = next((each for each in ("started", "accepted") if f'"{each}"'.encode() in payload), "other")
            tell(f"ack-said:{status}")
        elif kind == topics.TELE and topic.endswith(topics.JOINTS):
            tell("telemetry")

    _wrap(Device, "receive", _told_first(lambda _, topic, __: tell(f"heard:{topic.kind}")))
    _wrap(MqttTransport, "publish", _told_first(said))


def _tell_control(tell: Tell) -> None:
    """Marks the processing in the control loop."""
    from device_agent.drivers.mujoco.driver import MujocoDriver
    from device_agent.runtime.actions.executor import ActionExecutor
    from device_agent.runtime.control.controller import Controller

    newest: dict[int, tuple[Any, ...]] = {}
    decided: set[int] = set()

    def stepped(step: Any) -> Any:
        def run(self: Controller, *given: Any, **named: Any) -> Any:
            tick = step(self, *given, **named)
            if (seen := (tick.epoch, tick.setpoint_sequence)) != newest.get(id(self)):
                newest[id(self)] = seen
                decided.add(threading.get_ident())
                tell("decided")
            return tick

        return run

    def sent(send: Any) -> Any:
        def run(self: MujocoDriver, position_rad: Sequence[float]) -> Any:
            applied = send(self, position_rad)
            if tuple(position_rad) != newest.get(id(self)) or threading.get_ident() in decided:
                tell("driver")
            newest[id(self)] = tuple(position_rad)
            decided.discard(threading.get_ident())
            return applied

        return run

    def offered(offer: Any) -> Any:
        def run(*given: Any, **named: Any) -> None:
            offer(*given, **named)
            tell("taken")

        return run

    _wrap(ActionExecutor, "start", _told_first(lambda *_: tell("checked")))
    _wrap(Controller, "accept_setpoint", offered)
    _wrap(Controller, "update", stepped)
    _wrap(MujocoDriver, "send", sent)


class Motion:
    """Marks when a robot starts to move, when its motion is visible, and ten times per second while it is at rest.

    A robot is at rest after 0.1 s without motion, because a joint that reverses also stops for a moment.
    """

    def __init__(self, name: str, tell: Tell) -> None:
        self._name = name
        self._tell = tell
        self._still = 0
        self._waiting = ["moves", "fast"]

    def see(self, speed_rad_s: float) -> None:
        """Takes the highest joint velocity, every 4 ms."""
        if speed_rad_s <= STILL_RAD_S:
            self._still += 1
            if self._still % _RESTS == 0:
                self._waiting = ["moves", "fast"]
                self._tell(f"rests:{self._name}")
            return
        self._still = 0
        if "moves" in self._waiting:
            self._waiting.remove("moves")
            self._tell(f"moves:{self._name}")
        if "fast" in self._waiting and speed_rad_s > FAST_RAD_S:
            self._waiting.remove("fast")
            self._tell(f"fast:{self._name}")


def _tell_motion(tell: Tell, joints: Mapping[str, str]) -> None:
    """Marks the motion of some joints from the simulation's trace, every 4 ms."""
    from device_agent.simulation.trace import Trace

    watched: dict[int, tuple[Motion, list[int]]] = {}

    def init(begin: Any) -> Any:
        def run(self: Trace, path: Path, model: Any, known: Sequence[str], *, prefix: str = "") -> None:
            begin(self, path, model, known, prefix=prefix)
            if path.stem in joints:
                wanted = [model.joint(prefix + name).id for name in joints[path.stem].split("+")]
                watched[id(self)] = (Motion(path.stem, tell), [int(model.jnt_dofadr[joint]) for joint in wanted])

        return run

    def written(self: Trace, snapshot: Any, _target: Any) -> None:
        if id(self) in watched:
            motion, places = watched[id(self)]
            motion.see(float(abs(snapshot.qvel[places]).max()))

    _wrap(Trace, "__init__", init)
    _wrap(Trace, "write", _told_first(written))


def main(program: str, *arguments: str) -> int:
    """Runs the command line."""
    if program == "machine":
        return machine()
    return functions(arguments) if program == "functions" else agent(arguments)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
