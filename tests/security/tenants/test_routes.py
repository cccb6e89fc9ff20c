"""Access of every role to every route, as listed in ``routes.txt``; an unlisted route fails.

``401``, ``403`` or ``404``: rejected with this status. ``ok``: served. ``read``: served without a change of
Anneliese's data. ``own``: served only from the caller's data. Rejections and ``own`` neither reveal nor change
her data.
"""

import re
from collections import Counter
from pathlib import Path

import httpx

from tests.security.tenants.world import TABLES_OF_REJECTIONS, Rows, World, texts

TABLE = Path(__file__).with_name("routes.txt")
REJECTED = {"401", "403", "404"}
ORDER = ("GET", "POST", "PUT", "DELETE")
_SERVER_ERROR = 500


def expected() -> dict[str, dict[str, str]]:
    """Operation → caller → cell."""
    lines = [line for line in TABLE.read_text().splitlines() if line and not line.startswith("#")]
    columns = [name.strip() for name in lines[0].split("|")[1:]]
    listed = {}
    for line in lines[1:]:
        name, *cells = (part.strip() for part in line.split("|"))
        assert len(cells) == len(columns), f"{name}: {len(cells)} cells for {len(columns)} callers"
        assert name not in listed, f"{name} is listed twice"
        listed[name] = dict(zip(columns, cells, strict=True))
    return listed


def operations(world: World) -> list[tuple[str, str, str]]:
    """Name, method and path of each operation."""
    listed = [
        (str(operation["operationId"]), method.upper(), path.removeprefix("/api/v1"))
        for path, methods in world.cloud.app.openapi()["paths"].items()
        for method, operation in methods.items()
    ]
    return sorted(listed, key=lambda each: ORDER.index(each[1]))


def send_request(world: World, caller: str, name: str, method: str, path: str) -> tuple[str, httpx.Response]:
    ids = {key: world.ids.get(f"{name}.{key}", world.ids.get(key, "")) for key in re.findall(r"{(\w+)}", path)}
    assert all(ids.values()), f"{name}: the world has no {ids}"
    address = path.format(**ids) + ("?epoch=1" if name == "release_lease" else "")
    body = {"json": world.bodies[name]} if name in world.bodies else {}
    answer = world.callers[caller](method, address, **body)
    return f"{method} {address} {body}", answer


def error_in(world: World, cell: str, request: str, answer: httpx.Response, before: Rows) -> str:
    """The error in a response; empty if it is correct."""
    status = str(answer.status_code)
    if cell in {"ok", "read"} and status in REJECTED:
        return f"is rejected: {answer.text}"
    if cell == "ok" and not request.startswith("GET"):
        return ""
    if cell in REJECTED and status != cell:
        return f"responds {answer.text}"
    revealed = {mark for mark in world.marks if mark not in request and mark in texts(answer)}
    if revealed and cell not in {"ok", "read"}:
        return f"reveals {revealed}"
    after = world.rows()
    changed = {key for key in before.keys() | after.keys() if before.get(key) != after.get(key)}
    for table, partition, key in changed:
        pending = table == "Pending" and key.split(":")[1] in {"audit", "anchor"}
        if table in TABLES_OF_REJECTIONS or pending:
            continue
        if cell in REJECTED or any(mark in partition + key for mark in world.foreign):
            return f"changes {table} {partition} {key}"
    return ""


def test_every_route_has_a_row_and_every_row_a_route(world: World) -> None:
    assert {name for name, _, _ in operations(world)} == set(expected())
    for name, cells in expected().items():
        assert set(cells) == set(world.callers), name
        assert set(cells.values()) <= REJECTED | {"ok", "own", "read"}, name


def test_no_route_reveals_or_changes_data_without_access(world: World) -> None:
    table = expected()
    leaks, counts = [], Counter[str]()
    for name, method, path in operations(world):
        for caller, cell in table[name].items():
            before = world.rows()
            request, answer = send_request(world, caller, name, method, path)
            if answer.status_code == _SERVER_ERROR:
                leaks.append(f"{name} by {caller}: {answer.text}")
            if error := error_in(world, cell, request, answer, before):
                leaks.append(f"{name} by {caller} ({cell}): {answer.status_code} {error}")
            counts[cell] += 1
            world.restore()
    print(f"{counts.total()} cells of {len(table)} routes: {dict(counts)}; {len(leaks)} leaks")  # noqa: T201
    assert not leaks, "\n".join(leaks)
