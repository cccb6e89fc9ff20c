"""Mutants of the safety-critical packages, made and tested by mutmut in the folder ``mutants``.

mutmut does not remove statements and mutates every string. Here statements are removed, and texts for people and
log lines stay.
"""

import gc
import shutil
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import libcst
from libcst import matchers
from mutmut import __main__ as mutmut
from mutmut.configuration import config
from mutmut.mutation.data import SourceFileMutationData
from mutmut.mutation.diff_apply import get_diff_for_mutant
from mutmut.mutation.mutators import mutation_operators, operator_string
from mutmut.runners.harness import PytestRunner
from mutmut.state import state
from mutmut.stats import status_by_exit_code
from mutmut.utils.format_utils import orig_function_and_class_names_from_key
from mutmut.workers.isolation import ForkServerRunner

from tests.harness.mutation.report import DETECTED, Mutant
from tests.harness.paths import ROOT

PACKAGES: Final = {
    "authority": ("device_agent/runtime/authority/*.py",),
    "control": ("function_app/domain/control/*.py", "function_app/services/control/*.py"),
    "actions": ("function_app/domain/actions/*.py", "function_app/services/actions/*.py"),
    "delivery": (
        "device_agent/runtime/storage/*.py",
        "device_agent/runtime/telemetry/outbox.py",
        "device_agent/runtime/telemetry/device_publisher.py",
        "function_app/services/messaging/*.py",
    ),
}
"""Package → files to mutate."""
FOLDER: Final = ROOT / "mutants"
UNTESTED: Final = frozenset({"not checked", "check was interrupted by user"})
"""Results of mutants that an interrupted run left."""
_LOG_CALL: Final = matchers.Call(func=matchers.Attribute(value=matchers.Name("_log")))


def generate(*, resume: bool = False) -> dict[str, list[str]]:
    """Writes the mutated sources next to a copy of all other files; returns the names of the mutants per package.

    ``resume`` keeps the results of unchanged sources.
    """
    mutation_operators[:] = [
        *((node, _code_strings if operator is operator_string else operator) for node, operator in mutation_operators),
        (libcst.Expr, _without_call),
        (libcst.Raise, _without_raise),
    ]
    config().only_mutate = [pattern for patterns in PACKAGES.values() for pattern in patterns]
    config().also_copy = []
    mutmut.get_mutant_runner = lambda workers=1: _Runner(workers, _PytestRunner, {})
    if not resume:
        shutil.rmtree(FOLDER, ignore_errors=True)
    _copy_other_files()
    mutmut.copy_src_dir()
    mutmut.create_mutants(1)
    return {package: [name for file in _data(package) for name in file.exit_code_by_key] for package in PACKAGES}


def run(names: Sequence[str], workers: int) -> None:
    """Tests the mutants with these names."""
    if names:  # mutmut takes none as all
        mutmut._run(tuple(names), workers)


def statuses() -> dict[str, str]:
    """The present result of each mutant by its name."""
    files = (file for package in PACKAGES for file in _data(package))
    return {name: status_by_exit_code[code] for file in files for name, code in file.exit_code_by_key.items()}


def results(package: str, names: Iterable[str]) -> Iterator[Mutant]:
    """The tested mutants of a package."""
    wanted = set(names)
    for file in _data(package):
        for name, code in file.exit_code_by_key.items():
            if name in wanted:
                yield mutant(name, status_by_exit_code[code], file.path)


def mutant(name: str, status: str, path: Path | str) -> Mutant:
    """A mutant with its mutation."""
    function, owner = orig_function_and_class_names_from_key(name)
    module = str(path).removesuffix(".py").replace("/", ".")
    lines = get_diff_for_mutant(name, path=path).splitlines()[2:] if status not in DETECTED else []
    before, after = (" ".join(line[1:].strip() for line in lines if line[0] == sign) for sign in "-+")
    return Mutant(".".join(filter(None, (module, owner, function))), f"{before} → {after}", status)


class _Runner(ForkServerRunner):  # type: ignore[misc]
    """Runs the fastest tests of a mutant first."""

    def submit(self, mutant_name: str, tests: list[str], *limits: Any) -> None:
        super().submit(mutant_name, sorted(tests, key=state().duration_by_test.__getitem__), *limits)


class _PytestRunner(PytestRunner):  # type: ignore[misc]
    def warm_up(self) -> None:
        """Exclude all imported objects from garbage collection: pytest collects ten times per run."""
        super().warm_up()
        gc.collect()
        gc.freeze()


def _data(package: str) -> Iterator[Any]:
    for pattern in PACKAGES[package]:
        for path in sorted(ROOT.glob(pattern)):
            data = SourceFileMutationData(path=path.relative_to(ROOT))
            data.load()
            yield data


def _copy_other_files() -> None:
    sources = tuple(f"{path}/" for path in config().source_paths)
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0"):
        if (ROOT / name).is_file() and not name.startswith(sources):
            (FOLDER / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, FOLDER / name)


def _code_strings(node: libcst.BaseString) -> Iterable[libcst.BaseString]:
    """A text with a space is for people, so its mutants are left out."""
    if isinstance(node, libcst.SimpleString) and " " in node.value:
        return []
    mutated: Iterable[libcst.BaseString] = operator_string(node)
    return mutated


def _without_call(node: libcst.Expr) -> Iterable[libcst.Pass]:
    """Removes a call, unless it writes a log line."""
    if isinstance(node.value, libcst.Call | libcst.Await) and not matchers.matches(node.value, _LOG_CALL):
        yield libcst.Pass()


def _without_raise(_node: libcst.Raise) -> Iterable[libcst.Pass]:
    yield libcst.Pass()
