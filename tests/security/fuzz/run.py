"""``python -m tests.security.fuzz.run FOLDER TARGET,TARGET``: run each target under atheris in a fork of this process.

The folder receives the libFuzzer output: ``TARGET`` from the examples, ``TARGET-empty`` from an empty input
alone. Its own options may follow (``-max_total_time=60``, ``-runs=1000``, ``-seed=1``).
"""

import importlib
import json
import os
import random
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import atheris

_ODD: tuple[Any, ...] = (
    None, True, 0, -1, 2**53, 2**63, 2**64, 10**400, 0.5, -0.0, 1e308, float("nan"), float("inf"), float("-inf"), "",
    "a", "\0", "\ud800", "é", "+", "#", "../..", "a" * 300, "a" * 3000, [], {}, [[[[]]]], {"": {}},
)  # fmt: skip
"""Replacement values of another type, size or meaning."""
_EMPTY = "-empty"
_RESHAPED = 0.5
"""Share of inputs mutated as JSON; the others are mutated as bytes."""
_PREFIX = {"messages": 1, "bodies": 1, "http": 2}
"""Number of bytes before the JSON of a target's input."""


def reshape(data: bytes, prefix: int, chance: random.Random) -> bytes | None:
    """The JSON with one mutation; ``None`` if the input is not JSON."""
    try:
        whole = json.loads(data[prefix:])
    except (ValueError, RecursionError):
        return None
    places = list(_places(whole))
    if places:
        holder, key = chance.choice(places)
        _change(holder, key, chance.choice(places), chance)
    else:
        whole = chance.choice(_ODD)
    return data[:prefix] + json.dumps(whole).encode()


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    if isinstance(value, dict | list):
        for key, item in list(value.items() if isinstance(value, dict) else enumerate(value)):
            yield value, key
            yield from _places(item)


def _change(holder: Any, key: Any, other: tuple[Any, Any], chance: random.Random) -> None:
    match chance.choice(("odd", "odd", "odd", "copy", "drop", "double")):
        case "odd":
            holder[key] = chance.choice(_ODD)
        case "copy":
            holder[key] = json.loads(json.dumps(other[0][other[1]]))
        case "drop":
            del holder[key]
        case "double" if isinstance(holder, dict):
            holder[f"{key}x"] = holder[key]
        case "double":
            holder.extend([holder[key]] * chance.choice((1, 200)))


def main(folder: str, names: str, *options: str) -> int:
    from tests.security.fuzz import instrumented

    modules = {module for name in names.split(",") for module in instrumented.MODULES[name]}
    with atheris.instrument_imports(include=sorted(modules), enable_loader_override=False):
        for module in sorted(modules):
            importlib.import_module(module)
    worst = 0
    for name in names.split(","):
        for start in (_EMPTY, ""):
            child = os.fork()
            if child == 0:
                output = os.open(Path(folder) / f"{name}{start}", os.O_WRONLY | os.O_CREAT)
                os.dup2(output, sys.stdout.fileno())
                os.dup2(output, sys.stderr.fileno())
                _fuzz(Path(folder), name, options, with_examples=not start)
            worst = max(worst, abs(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])))
    return worst


def _fuzz(folder: Path, name: str, options: tuple[str, ...], *, with_examples: bool) -> None:
    """Never returns: libFuzzer ends the process."""
    from tests.security.fuzz.targets import TARGETS

    target = TARGETS[name]
    prefix = _PREFIX.get(name, 0)

    def mutate(data: bytes, most: int, seed: int) -> bytes:
        chance = random.Random(seed)
        found = reshape(data, prefix, chance) if chance.random() < _RESHAPED else None
        return found if found is not None and len(found) <= most else bytes(atheris.Mutate(data, most))

    corpus = folder / f"{name}-corpus{'' if with_examples else _EMPTY}"
    corpus.mkdir()
    for number, seed in enumerate(target.seeds if with_examples else ()):
        (corpus / str(number)).write_bytes(seed)
    longest = max(4096, *(2 * len(seed) for seed in target.seeds))
    arguments = [name, str(corpus), f"-max_len={longest}", "-timeout=20", "-rss_limit_mb=2048"]
    arguments += ["-artifact_prefix=/tmp/", *(options if with_examples else ("-runs=1",))]
    atheris.Setup(arguments, target.run, custom_mutator=mutate)
    atheris.Fuzz()


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
