"""The request to start an action, as the HTTP API accepts it."""

import hashlib
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args

import msgspec
from msgspec import Meta, Struct

from device_agent.protocol import MAX_SEED, Id, Task


class AskMovement(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="run_movement"):
    """Run the newest version of a movement of the device's robot type."""

    name: Id
    parameters: dict[str, Any] = {}


class AskTrial(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="run_trial"):
    """Run one trial of a task of the device's robot type: reset the objects, run the movement, observe the condition.

    ``seed``: seed of the reset; null: a random one if the task is observed in a simulation, otherwise no reset. The
    verdict is the entry ``trial`` of the action's result.
    """

    name: Id
    seed: Annotated[int, Meta(ge=0, le=MAX_SEED)] | None = None


def _strict(kind: type[Struct]) -> type[Struct]:  # pragma: no mutate block (runs at import)
    """The kind of task as the API accepts it: agents ignore unknown fields, the API rejects misspelled ones."""
    strict = msgspec.defstruct(
        kind.__name__,
        (),
        bases=(kind,),
        frozen=True,
        kw_only=True,
        forbid_unknown_fields=True,
        tag_field="kind",
        tag=kind.__struct_config__.tag,
    )
    strict.__doc__ = kind.__doc__
    return strict


if TYPE_CHECKING:
    _StrictTask = Task
else:
    _StrictTask = Union[tuple(map(_strict, get_args(Task)))]  # noqa: UP007 (of a computed tuple)


class ActionOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What to run, and how long the action may wait and run.

    While the device is busy, policy ``reject`` rejects the action. Policy ``queue`` queues it for at most ``queue_ms``.
    ``ttl_ms`` and ``timeout_ms`` count from the moment the action leaves the queue.
    """

    request: AskMovement | AskTrial | _StrictTask
    policy: Literal["reject", "queue"] = "reject"
    queue_ms: Annotated[int, Meta(ge=1_000, le=86_400_000)] = 300_000
    ttl_ms: Annotated[int, Meta(ge=1, le=86_400_000)] = 10_000
    timeout_ms: Annotated[int, Meta(ge=1_000, le=86_400_000)] = 300_000
    wait_ms: Annotated[int, Meta(ge=0, le=30_000)] = 0
    wait_for: Literal["started", "done"] = "started"


class ActionRequest(ActionOptions, frozen=True, kw_only=True):
    """A request to start an action on one device.

    With ``epoch``, the caller must hold this lease when the action starts. Without it, the action gets a lease of its
    own, unless another session holds control. ``policy`` ``reject`` rejects the request while the device is busy;
    ``queue`` queues the action for at most ``queue_ms``. ``ttl_ms`` and ``timeout_ms`` count from the moment the action
    leaves the queue. A Stop or a failed action cancels all queued actions.
    """

    epoch: Annotated[int, Meta(ge=1, le=2**53)] | None = None

    def fingerprint(self) -> str:
        """A hash that is equal for equal requests."""
        fields: list[Any] = [self.request, self.epoch, self.ttl_ms, self.timeout_ms, self.wait_ms, self.wait_for]
        if self.policy == "queue":
            fields += [self.policy, self.queue_ms]
        return hashlib.sha256(msgspec.json.encode(fields, order="deterministic")).hexdigest()
