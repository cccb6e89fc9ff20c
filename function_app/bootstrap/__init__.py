"""Composition root: settings -> adapters -> services.

Each module holds the factories of one capability. Its class extends the class of the capability below, in the order
that the import contract of ``services`` fixes.
"""

from function_app.adapters import factory
from function_app.adapters.factory import Adapters
from function_app.adapters.local.clock import SystemClock
from function_app.bootstrap.maintenance import MaintenanceServices
from function_app.ports.clock import Clock
from function_app.settings import Settings


class Functions(MaintenanceServices):
    """Everything the entry points use. A service is created when it is first read."""


def build(settings: Settings, *, clock: Clock | None = None, adapters: Adapters | None = None) -> Functions:
    """The services over the adapters that the settings select. Reads the signing keys, opens no connection.

    Args:
        settings: Of this installation.
        clock: The wall clock; by default the machine's.
        adapters: Used instead of those that the settings select.

    Raises:
        StoreError: The signing keys cannot be used.
    """
    clock = clock or SystemClock()
    return Functions(settings, adapters or factory.adapters(settings, clock), clock)
