"""Asks a public database of advisories (https://osv.dev) about every pinned package: ``make audit-packages``.

Exit code 0: it knows of nothing against any of them. 1: it does. 2: it could not be asked, so nothing is known.
"""

import json
import re
import sys
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DATABASE = "https://api.osv.dev/v1/querybatch"
TIMEOUT_S = 30
_PINNED = re.compile(r"^([A-Za-z0-9._-]+)(?:\[[^]]*\])?==([^\s;]+)")
_FOUND, _UNKNOWN = 1, 2


def pinned(root: Path = ROOT) -> list[tuple[str, str]]:
    """Every package of every exported file, with its version, each once."""
    files = [root / "requirements.txt", *sorted((root / "requirements").glob("*.txt"))]
    lines = [line for file in files for line in file.read_text(encoding="utf-8").splitlines()]
    return sorted({(match[1].lower(), match[2]) for line in lines if (match := _PINNED.match(line))})


def advisories(packages: list[tuple[str, str]], database: str) -> dict[tuple[str, str], list[str]]:
    """What the database knows against them.

    Raises:
        OSError: It cannot be reached, or answers with an error.
        ValueError: It answers something else.
    """
    queries = [{"package": {"ecosystem": "PyPI", "name": name}, "version": version} for name, version in packages]
    request = urllib.request.Request(  # noqa: S310 (the address is written above, or given by a test)
        database, json.dumps({"queries": queries}).encode(), {"Content-Type": "application/json"}
    )
    with urllib.request.urlopen(request, timeout=TIMEOUT_S) as answer:  # noqa: S310
        results = json.load(answer)["results"]
    if len(results) != len(packages):
        raise ValueError("it answers about another number of packages than it was asked about")
    found = zip(packages, results, strict=True)
    return {package: [each["id"] for each in result["vulns"]] for package, result in found if result.get("vulns")}


def main(database: str = DATABASE) -> int:
    """Ask, and tell."""
    packages = pinned()
    try:
        found = advisories(packages, database)
    except (OSError, ValueError, KeyError, TypeError) as error:
        sys.stderr.write(f"NOT CHECKED: the database of advisories at {database} could not be asked ({error}).\n")
        sys.stderr.write(f"Nothing is known about the {len(packages)} pinned packages; try again with a network.\n")
        return _UNKNOWN
    for (name, version), ids in found.items():
        sys.stderr.write(f"{name} {version}: {', '.join(ids)}\n")
    sys.stdout.write(f"{len(packages)} pinned packages, advisories against {len(found)} of them\n")
    return _FOUND if found else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:2]))
