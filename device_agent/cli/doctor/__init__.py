"""``python -m device_agent doctor``: looks at everything that an agent needs, and says what to do about what is wrong.

``machine`` looks at this computer, ``robots`` at the devices, ``cloud`` at what is at the other end. Each check is a
function that yields findings; whatever goes wrong inside of one is a finding too.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from device_agent.cli.doctor import cloud, devices, machine
from device_agent.cli.doctor.finding import Finding, problem
from device_agent.config.agent_config import AgentConfig
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore

__all__ = ["Finding", "examine"]


def examine(store: IdentityStore) -> Iterator[Finding]:
    """Everything, each finding as soon as it is known. Disturbs nothing: a robot that runs may be examined."""
    yield from _run("python", machine.python)
    yield from _run("user", machine.user)
    yield from _run("folder", partial(machine.folder, store))
    yield from _run("disk", partial(machine.disk, store))
    yield from _run("voice", machine.voice)
    try:
        configuration = AgentConfig.load(store.folder)
    except ConfigError as error:
        yield problem("agent", str(error), "Run `python -m device_agent enroll --server … --device NAME=TYPE`.")
        yield from _run("scripts", partial(machine.scripts, trusted=False))
        return
    yield from _checks(store, configuration)


def _checks(store: IdentityStore, configuration: AgentConfig) -> Iterator[Finding]:
    yield from _run("scripts", partial(machine.scripts, trusted=configuration.allow_unconfined_scripts))
    yield from _run("renderer", partial(devices.renderer, configuration))
    for entry in configuration.devices:
        yield from _run(f"device {entry.name}", partial(devices.device, entry))
    yield from _run("room", partial(devices.room, configuration))
    yield from _run("server", partial(cloud.look, store, configuration))


def _run(name: str, check: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    try:
        yield from check()
    except Exception as error:  # noqa: BLE001 (what a check did not foresee is what a person must hear of)
        yield problem(name, f"{_kind(error)}: {error}", "This check itself failed; report it with the text above.")


def _kind(error: Any) -> str:
    return type(error).__name__
