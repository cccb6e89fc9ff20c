"""The export formats by name."""

from collections.abc import Callable, Mapping
from typing import Final

from device_agent.cli.export.errors import ExportError
from device_agent.ports.plugins import PlugIns

_MODULES: Final[Mapping[str, str]] = {
    "csv": "device_agent.cli.export.csv_files",
    "lerobot": "device_agent.cli.export.lerobot",
    "mcap": "device_agent.cli.export.mcap_file",
    "rerun": "device_agent.cli.export.rerun_file",
}
EXTRA: Final = "export"
"""Extra of the agent's package with the libraries that the export needs."""
FORMATS: Final[PlugIns[Callable[[], object]]] = PlugIns(
    label="format",
    group="telescope.export_formats",
    built_in=_MODULES,
    error=ExportError,
    extras=dict.fromkeys(_MODULES, EXTRA) | {"rerun": "rerun"},
)
"""``create`` of a format returns an ``ExportFormat``."""
