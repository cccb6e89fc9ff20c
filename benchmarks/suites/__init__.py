"""Benchmark suites, each a module with ``run(quick, log) -> Report``, in the order of the results page."""

from typing import Final

NAMES: Final = ("papers", "operator", "path", "limit", "peers", "recording", "scale", "faults", "kills", "soak")
