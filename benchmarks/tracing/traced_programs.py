"""The product as ``make up`` starts it, with functions and agent that send timestamps.

``python -m benchmarks.tracing.traced_programs machine`` replaces ``python -m infra.local`` and starts traced variants
of the functions and the agent. The product contains no tracing: this module wraps public functions. A missing function
ends the program with its name.

Environment: ``TELESCOPE_BENCH_DEVICE`` (``nao``: the only robot, in its own scene), ``TELESCOPE_BENCH_JOINTS``
(``nao:HeadYaw,qbo:head_pan+left_wheel``: joints with traced motion) and ``TELESCOPE_BENCH_PORTS``
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
PORTS: Final = "TELESCOPE_BENCH_PORTS"
STILL_RAD_S: Final = 5e-5
"""Velocity at which a simulated joint starts to move; at rest, all robots stay below 2e-5."""
FAST_RAD_S: Final = 0.002
"""Velocity of visible motion: 0.1 °/s. Motion starts with limited jerk, so this takes time."""
_REST_STATES: Final = 25
"""Simulation states per 0.1 s."""
Mark = Callable[..., object]
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
    setattr(local, "LocalStack", Traced)  # noqa: B010 (the type checker rejects an assignment)
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

    mark = TimestampSender().send

    def to_control(name: str) -> Mark:
        return lambda _self, table, *_: mark(name) if table == records.CONTROL else None

    _wrap(uvicorn, "create_app", lambda create: lambda *args: _RequestMiddleware(create(*args), mark))
    _wrap(RequestAuthenticator, "account", _mark_after(lambda *_: mark("identified")))
    _wrap(SqliteTables, "batch", _mark_before(to_control("writing")))
    _wrap(SqliteTables, "batch", _mark_after(to_control("written")))
    _wrap(Delivery, "send", _mark_before(lambda *_: mark("publishing")))
    _wrap(acks, "report", _mark_before(lambda ack, *_: mark(f"ack-received:{ack.status.value}")))
    return program.main(arguments)


class _RequestMiddleware:
    """Middleware that marks the arrival and the response of requests that start an action."""

    def __init__(self, app: Any, mark: Mark) -> None:
        self._app = app
        self._mark = mark

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "http" or scope["method"] != "POST" or not scope["path"].endswith("/actions"):
            await self._app(scope, receive, send)
            return

        async def sent(message: Any) -> None:
            # Marked before sending: the caller may have the response before `send` returns.
            if message["type"] == "http.response.body" and not message.get("more_body"):
                self._mark("http-out")
            await send(message)

        self._mark("http-in")
        await self._app(scope, receive, sent)


def _wrap(owner: Any, name: str, around: Wrapper) -> None:
    """Wraps a public function.

    Raises:
        AttributeError: The function does not exist.
    """
    setattr(owner, name, around(getattr(owner, name)))


def _mark_before(mark: Mark) -> Wrapper:
    """Marks the start of a call."""

    def around(call: Any) -> Any:
        @wraps(call)
        def run(*args: Any, **kwargs: Any) -> Any:
            mark(*args)
            return call(*args, **kwargs)

        return run

    return around


def _mark_after(mark: Mark) -> Wrapper:
    """Marks the successful end of a coroutine."""

    def around(call: Any) -> Any:
        @wraps(call)
        async def run(*args: Any, **kwargs: Any) -> Any:
            result = await call(*args, **kwargs)
            mark(*args)
            return result

        return run

    return around


# ------------------------------------------------------------ the agent


def agent(arguments: Sequence[str]) -> int:
    """Runs the traced agent."""
    from device_agent import __main__ as program

    mark = TimestampSender().send
    _reroute(_pairs(PORTS, "="))
    _trace_messages(mark)
    _trace_control(mark)
    _trace_motion(mark, _pairs(JOINTS, ":"))
    return program.main(arguments)


def _pairs(variable: str, between: str) -> dict[str, str]:
    pairs = (pair.partition(between) for pair in os.environ.get(variable, "").split(",") if pair)
    return {key: value for key, _, value in pairs}


def _reroute(ports: Mapping[str, str]) -> None:
    """Redirects the agent's connections to other ports."""
    from device_agent.transports.http.client import CloudClient

    def init(original: Any) -> Any:
        def run(self: CloudClient, server: str, *args: Any, **kwargs: Any) -> None:
            address, _, port = server.rstrip("/").rpartition(":")
            original(self, f"{address}:{ports.get(port, port)}", *args, **kwargs)

        return run

    def credentials(request: Any) -> Any:
        def run(self: CloudClient) -> dict[str, Any]:
            result: dict[str, Any] = request(self)
            port = str(result["tcp"]["port"])
            result["tcp"]["port"] = int(ports.get(port, port))
            return result

        return run

    _wrap(CloudClient, "__init__", init)
    _wrap(CloudClient, "credentials", credentials)


def _trace_messages(mark: Mark) -> None:
    """Marks messages to a device and its acknowledgements."""
    from device_agent.protocol import topics
    from device_agent.runtime.device import Device
    from device_agent.transports.mqtt.transport import MqttTransport

    def published(_transport: MqttTransport, topic: str, payload: bytes) -> None:
        kind = topics.parse(topic).kind
        if kind == topics.ACK:
            status = next((each for each in ("started", "accepted") if f'"{each}"'.encode() in payload), "other")
            mark(f"ack-published:{status}")
        elif kind == topics.TELE and topic.endswith(topics.JOINTS):
            mark("telemetry")

    _wrap(Device, "receive", _mark_before(lambda _, topic, __: mark(f"received:{topic.kind}")))
    _wrap(MqttTransport, "publish", _mark_before(published))


def _trace_control(mark: Mark) -> None:
    """Marks the processing in the control loop."""
    from device_agent.drivers.mujoco.driver import MujocoDriver
    from device_agent.runtime.actions.executor import ActionExecutor
    from device_agent.runtime.control.controller import Controller

    newest: dict[int, tuple[Any, ...]] = {}
    decided: set[int] = set()

    def updated(update: Any) -> Any:
        def run(self: Controller, *args: Any, **kwargs: Any) -> Any:
            tick = update(self, *args, **kwargs)
            if (current := (tick.epoch, tick.setpoint_sequence)) != newest.get(id(self)):
                newest[id(self)] = current
                decided.add(threading.get_ident())
                mark("decided")
            return tick

        return run

    def sent(send: Any) -> Any:
        def run(self: MujocoDriver, position_rad: Sequence[float]) -> Any:
            applied = send(self, position_rad)
            if tuple(position_rad) != newest.get(id(self)) or threading.get_ident() in decided:
                mark("driver")
            newest[id(self)] = tuple(position_rad)
            decided.discard(threading.get_ident())
            return applied

        return run

    def accepted(accept: Any) -> Any:
        def run(*args: Any, **kwargs: Any) -> None:
            accept(*args, **kwargs)
            mark("setpoint-accepted")

        return run

    _wrap(ActionExecutor, "start", _mark_before(lambda *_: mark("checked")))
    _wrap(Controller, "accept_setpoint", accepted)
    _wrap(Controller, "update", updated)
    _wrap(MujocoDriver, "send", sent)


class Motion:
    """Marks when a robot starts to move, when its motion is visible, and ten times per second while it is at rest.

    A robot is at rest after 0.1 s without motion, because a joint that reverses also stops for a moment.
    """

    def __init__(self, name: str, mark: Mark) -> None:
        self._name = name
        self._mark = mark
        self._rest_count = 0
        self._pending = ["moves", "fast"]

    def update(self, speed_rad_s: float) -> None:
        """Takes the highest joint velocity, every 4 ms."""
        if speed_rad_s <= STILL_RAD_S:
            self._rest_count += 1
            if self._rest_count % _REST_STATES == 0:
                self._pending = ["moves", "fast"]
                self._mark(f"rests:{self._name}")
            return
        self._rest_count = 0
        if "moves" in self._pending:
            self._pending.remove("moves")
            self._mark(f"moves:{self._name}")
        if "fast" in self._pending and speed_rad_s > FAST_RAD_S:
            self._pending.remove("fast")
            self._mark(f"fast:{self._name}")


def _trace_motion(mark: Mark, joints: Mapping[str, str]) -> None:
    """Marks the motion of some joints from the simulation's trace, every 4 ms."""
    from device_agent.simulation.trace import Trace

    watched: dict[int, tuple[Motion, list[int]]] = {}

    def init(original: Any) -> Any:
        def run(self: Trace, path: Path, model: Any, known: Sequence[str], *, prefix: str = "") -> None:
            original(self, path, model, known, prefix=prefix)
            if path.stem in joints:
                joint_ids = [model.joint(prefix + name).id for name in joints[path.stem].split("+")]
                watched[id(self)] = (Motion(path.stem, mark), [int(model.jnt_dofadr[joint]) for joint in joint_ids])

        return run

    def written(self: Trace, snapshot: Any, _target: Any) -> None:
        if id(self) in watched:
            motion, indices = watched[id(self)]
            motion.update(float(abs(snapshot.qvel[indices]).max()))

    _wrap(Trace, "__init__", init)
    _wrap(Trace, "write", _mark_before(written))


def main(program: str, *arguments: str) -> int:
    """Runs the command line."""
    if program == "machine":
        return machine()
    return functions(arguments) if program == "functions" else agent(arguments)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
