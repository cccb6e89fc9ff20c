"""What is found by name: built-in parts, and those that other packages offer by an entry point.

Built-in ones stand in a table of import paths and are imported when asked for, so that an agent needs only the
libraries of what it uses.
"""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Generic, TypeVar, cast

Factory = TypeVar("Factory")


@dataclass(frozen=True, kw_only=True, slots=True)
class PlugIns(Generic[Factory]):
    """Factories of one kind, by name.

    Attributes:
        what: What they make, for people.
        group: The entry point group by which others add theirs; an entry point is a factory.
        built_in: Name → module that has ``create``, the factory.
        error: What is raised where there is none.
    """

    what: str
    group: str
    built_in: Mapping[str, str]
    error: type[Exception]

    def names(self) -> tuple[str, ...]:
        """All names that ``load`` takes, sorted."""
        return tuple(sorted({*self.built_in, *(point.name for point in entry_points(group=self.group))}))

    def load(self, name: str) -> Factory:
        """The factory of this name. A built-in one wins over an entry point of the same name.

        Raises:
            Exception: ``error``: there is none, or a library that it needs is not installed.
        """
        try:
            if name in self.built_in:
                return cast("Factory", importlib.import_module(self.built_in[name]).create)
            for point in entry_points(group=self.group):
                if point.name == name:
                    return cast("Factory", point.load())
        except (ImportError, AttributeError) as error:
            raise self.error(
                f"{self.what} '{name}' cannot be loaded: {error}; is the package that it needs installed?"
            ) from error
        raise self.error(f"no {self.what} '{name}'; there are: {', '.join(self.names())}")
