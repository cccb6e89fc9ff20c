"""One jail for all tests of a process that run scripts: it is warm after the first."""

import atexit
from functools import cache

from device_agent.jail.warm import WarmJail


@cache
def warm_jail() -> WarmJail:
    """The real one, with every layer."""
    jail = WarmJail()
    jail.start()
    atexit.register(jail.close)
    return jail
