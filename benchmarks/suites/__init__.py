"""The suites, each a module with ``run(quick, say) -> Report``. Their order is the page's."""

from typing import Final

NAMES: Final = ("papers", "path", "limit", "peers", "scale", "faults", "soak")
