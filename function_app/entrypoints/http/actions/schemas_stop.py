"""``stop``: of a device, of a space, of all."""

from device_agent.protocol import Text
from function_app.entrypoints.http.framework.schemas import Problem, Request, Response


class StopRequest(Request, frozen=True, kw_only=True):
    """Why."""

    reason: Text = ""


class StopConfirmation(Response, frozen=True, kw_only=True):
    """Whether the device has confirmed within a second."""

    confirmed: bool


class StopItem(Response, frozen=True, kw_only=True):
    """What became of it on one device; ``status`` and ``problem`` as for one device."""

    device: str
    status: int
    confirmed: bool
    problem: Problem | None


class StopOut(Response, frozen=True, kw_only=True):
    """One item for each device that the caller may operate."""

    items: tuple[StopItem, ...]
