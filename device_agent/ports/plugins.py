"""Loads built-in plug-ins, and plug-ins that other packages provide by entry points, by name.

Built-in plug-ins are imported on demand, so that an agent needs only the libraries that it uses.
"""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import Generic, TypeVar, cast

Factory = TypeVar("Factory")


@dataclass(frozen=True, kw_only=True, slots=True)
class PlugIns(Generic[Factory]):
    """Factories of one kind, by name.

    Attributes:
        label: Created objects, for messages.
        group: Entry point group; an entry point is a factory.
        built_in: Name → module with the factory ``create``.
        error: Exception for unknown names.
        extras: Name → extra of the agent's package that installs the libraries of a built-in plug-in.
    """

    label: str
    group: str
    built_in: Mapping[str, str]
    error: type[Exception]
    extras: Mapping[str, str] = field(default_factory=dict)

    def names(self) -> tuple[str, ...]:
        """All names that ``load`` takes, sorted."""
        return tuple(sorted({*self.built_in, *(point.name for point in entry_points(group=self.group))}))

    def load(self, name: str) -> Factory:
        """The factory of this name. Built-in plug-ins take precedence.

        Raises:
            Exception: ``error``: the name is unknown, or a required library is missing.
        """
        try:
            if name in self.built_in:
                return cast("Factory", importlib.import_module(self.built_in[name]).create)
            for point in entry_points(group=self.group):
                if point.name == name:
                    return cast("Factory", point.load())
        except ModuleNotFoundError as error:
            if name not in self.extras:
                raise self._unloadable(name, error) from error
            raise self.error(
                f"{self.label} '{name}' needs {error.name}, which is not installed; "
                f"run `pip install 'telescope-agent[{self.extras[name]}]'`"
            ) from error
        except (ImportError, AttributeError) as error:
            raise self._unloadable(name, error) from error
        raise self.error(f"no {self.label} '{name}'; there are: {', '.join(self.names())}")

    def _unloadable(self, name: str, error: Exception) -> Exception:
        return self.error(f"{self.label} '{name}' cannot be loaded: {error}; check that its package is installed")
