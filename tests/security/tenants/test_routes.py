"""Access of every role to every route, as listed in ``routes.txt``; an unlisted route fails.

``401``, ``403`` or ``404``: rejected with this status. ``ok``: served. ``read``: served without a change of
Anneliese's data. ``own``: served only from the caller's data. Rejections and ``own`` neither reveal nor change
her data.
"""

import re
from collections import Counter
from pathlib import Path

import httpx

from tests.security.tenants.world import TYPE_TOLD_OF_REFUSALS, Rows, World, texts

TABLE = Path(__file__).with_name("routes.txt")
REFUSED = {"401", "403", "404"}
ORDER = ("GET", "POST", "PUT", "DELETE")
_SERVER_ERROR = 500


def expected() -> dict[str, dict[str, str]]:
    """Operation → caller → cell."""
    lines = [line for line in TABLE.read_text().splitlines() if line and not line.startswith("#")]
    columns = [name.strip() for name in lines[0].split("|")[1:]]
    found = {}
    for line in lines[1:]:
        name, *cells = (part.strip() for part in line.split("|"))
        assert len(cells) == len(columns), f"{name}: {len(cells)} cells for {len(columns)} callers"
        assert name not in found, f"{name} stands there twice"
        found[name] = dict(zip(columns, cells, strict=True))
    return found


def operations(world: World) -> list[tuple[str, str, str]]:
    """Name, method and path of each operation."""
    found = [
        (str(operation["operationId"]), method.upper(), path.removeprefix("/api/v1"))
        for path, methods in world.cloud.app.openapi()["paths"].items()
        for method, operation in methods.items()
    ]
    return sorted(found, key=lambda each: ORDER.index(each[1]))


def ask(world: World, caller: str, name: str, method: str, path: str) -> tuple[str, httpx.Response]:
    ids = {key: world.ids.get(f"{name}.{key}", world.ids.get(key, "")) for key in re.findall(r"{(\w+)}", path)}
    assert all(ids.values()), f"{name}: the world has no {ids}"
    where = path.format(**ids) + ("?epoch=1" if name == "release_lease" else "")
    body = {"json": world.bodies[name]} if name in world.bodies else {}
    answer = world.callers[caller](method, where, **body)
    return f"{method} {where} {body}", answer


def wrong(world: World, cell: str, asked: str, answer: httpx.Response, before: Rows) -> str:
    """The error in a response; empty if it is correct."""
    status = str(answer.status_code)
    if cell in {"ok", "read"} and status in REFUSED:
        return f"is refused: {answer.text}"
    if cell == "ok" and not asked.startswith("GET"):
        return ""
    if cell in REFUSED and status != cell:
        return f"answers {answer.text}"
    told = {mark for mark in world.marks if mark not in asked and mark in texts(answer)}
    if told and cell not in {"ok", "read"}:
        return f"tells {told}"
    after = world.rows()
    changed = {key for key in before.keys() | after.keys() if before.get(key) != after.get(key)}
    for table, partition, key in changed:
        pending = table == "Pending" and key.split(":")[1] in {"audit", "anchor"}
        if table in TYPE_TOLD_OF_REFUSALS or pending:
            continue
        if cell in REFUSED or any(mark in partition + key for mark in world.foreign):
            return f"changes {table} {partition} {key}"
    return ""


def test_every_route_has_a_row_and_every_row_a_route(world: World) -> None:
    assert {name for name, _, _ in operations(world)} == set(expected())
    for name, cells in expected().items():
        assert set(cells) == set(world.callers), name
        assert set(cells.values()) <= REFUSED | {"ok", "own", "read"}, name


def test_no_route_reveals_or_changes_data_without_access(world: World) -> None:
    table = expected()
    leaks, counts = [], Counter[str]()
    for name, method, path in operations(world):
        for caller, cell in table[name].items():
            before = world.rows()
            asked, answer = ask(world, caller, name, method, path)
            if answer.status_code == _SERVER_ERROR:
                leaks.append(f"{name} by {caller}: {answer.text}")
            if fault := wrong(world, cell, asked, answer, before):
                leaks.append(f"{name} by {caller} ({cell}): {answer.status_code} {fault}")
            counts[cell] += 1
            world.put_back()
    print(f"{counts.total()} cells of {len(table)} routes: {dict(counts)}; {len(leaks)} leaks")  # noqa: T201
    assert not leaks, "\n".join(leaks)
