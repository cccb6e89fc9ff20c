# mypy: disable-error-code="misc"
"""Build hooks of the two distributions.

``DependencyGroups`` takes the dependencies from the groups of the root ``pyproject.toml``, the only place that names
them. ``Console`` adds the built console to the server's wheel.
"""

import tomllib
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

_ROOT = Path(__file__).resolve().parents[2]
_CONSOLE = _ROOT / "web" / "dist"


class DependencyGroups(MetadataHookInterface):
    """Sets ``dependencies`` and ``optional-dependencies`` from the groups that the hook's configuration names."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Completes the project metadata in place."""
        groups = tomllib.loads((_ROOT / "pyproject.toml").read_text(encoding="utf-8"))["dependency-groups"]
        metadata["dependencies"] = _packages(groups, self.config["dependencies"])
        metadata["optional-dependencies"] = {name: _packages(groups, [name]) for name in self.config["extras"]}


class Console(BuildHookInterface[Any]):
    """Includes ``web/dist``. Without it the build fails, except an editable installation."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Adds the folder to the files of the wheel."""
        if (_CONSOLE / "index.html").is_file():
            build_data["force_include"][str(_CONSOLE)] = "function_app/console"
        elif version != "editable":
            raise SystemExit("telescope: the console is not built; run `make console` first")


def _packages(groups: dict[str, list[Any]], names: list[str]) -> list[str]:
    packages: list[str] = []
    for name in names:
        for entry in groups[name]:
            packages += _packages(groups, [entry["include-group"]]) if isinstance(entry, dict) else [entry]
    return list(dict.fromkeys(packages))
