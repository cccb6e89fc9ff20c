"""The owner's decision which cameras of a device may be recorded."""

from dataclasses import dataclass

from function_app.domain.devices.devices import Device


@dataclass(frozen=True, slots=True)
class CameraDecision:
    """A decision. The agent enforces it; this copy is delivered until the agent has stored it.

    Attributes:
        cameras: Names of the cameras that may be recorded; empty: none.
        account: Account of the owner.
        by: Name of the owner at that time.
        at_ms: Time of the decision [ms since 1970].
        number: Rises with each decision for the device.
        pairing: Pairing of the agent. A decision of another pairing or space has no effect.
        space: Space of the agent.
    """

    cameras: tuple[str, ...]
    account: str
    by: str
    at_ms: int
    number: int
    pairing: str
    space: str

    def applies_to(self, device: Device) -> bool:
        """Whether the decision is one of the present owner for the present room."""
        return (self.pairing, self.space, self.account) == (device.pairing, device.space, device.owner)
