"""Queries https://osv.dev for advisories against the pinned packages: ``make audit-packages``.

Exit code 0: no advisories. 1: advisories were found. 2: the database could not be queried.
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
    """Names and versions of all packages in the exported files, without duplicates."""
    files = [root / "requirements.txt", *sorted((root / "requirements").glob("*.txt"))]
    lines = [line for file in files for line in file.read_text(encoding="utf-8").splitlines()]
    return sorted({(match[1].lower(), match[2]) for line in lines if (match := _PINNED.match(line))})


def advisories(packages: list[tuple[str, str]], database: str) -> dict[tuple[str, str], list[str]]:
    """Ids of the advisories by package, for packages with advisories.

    Raises:
        OSError: The database cannot be reached, or responds with an error.
        ValueError: The response is invalid.
    """
    queries = [{"package": {"ecosystem": "PyPI", "name": name}, "version": version} for name, version in packages]
    request = urllib.request.Request(  # noqa: S310 (a constant address, or that of a test)
        database, json.dumps({"queries": queries}).encode(), {"Content-Type": "application/json"}
    )
    with urllib.request.urlopen(request, timeout=TIMEOUT_S) as response:  # noqa: S310
        results = json.load(response)["results"]
    if len(results) != len(packages):
        raise ValueError("the response has another number of results than the query")
    pairs = zip(packages, results, strict=True)
    return {package: [item["id"] for item in result["vulns"]] for package, result in pairs if result.get("vulns")}


def main(database: str = DATABASE) -> int:
    """Print the advisories; returns the exit code."""
    packages = pinned()
    try:
        found = advisories(packages, database)
    except (OSError, ValueError, KeyError, TypeError) as error:
        sys.stderr.write(f"NOT CHECKED: the advisory database at {database} could not be queried ({error}).\n")
        sys.stderr.write(f"The {len(packages)} pinned packages were not checked; retry with a network connection.\n")
        return _UNKNOWN
    for (name, version), ids in found.items():
        sys.stderr.write(f"{name} {version}: {', '.join(ids)}\n")
    sys.stdout.write(f"{len(packages)} pinned packages, advisories against {len(found)} of them\n")
    return _FOUND if found else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:2]))
