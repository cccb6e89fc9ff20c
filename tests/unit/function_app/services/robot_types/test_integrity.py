"""A robot type with a modified byte in manifest, files or seal is rejected."""

import asyncio
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

from device_agent.protocol.manifests import robot_type as manifests
from function_app.adapters.local.signing_keys import FileKeys
from function_app.domain.common.problems import Problem
from function_app.domain.robot_types.robot_types import TypeVersion
from function_app.ports.tables import Row
from function_app.services.robot_types.integrity import IntegritySeals, require_intact
from function_app.services.storage import records
from tests.harness.paths import ROBOTS

TYPES = sorted(folder.parent.name for folder in ROBOTS.glob("*/robot.toml"))


async def flip_each(name: str, home: Path, *, stride: int) -> tuple[int, int]:
    """Seal a type and verify that every modified byte is detected; return the number of bytes in files and in rows."""
    files = {file.name: file.read_bytes() for file in sorted((ROBOTS / name).iterdir()) if file.is_file()}
    manifest = msgspec.to_builtins(manifests.parse(files["robot.toml"].decode()))
    seals = IntegritySeals(keys=FileKeys(home / "keys"))
    plain = TypeVersion(1, "ready", manifest, {file: len(content) for file, content in files.items()}, 0)
    good = await seals.sealed("anna", name, plain, files)
    seal = await seals.check("anna", name, good)

    in_files = 0
    for file, content in files.items():
        require_intact(name, seal, file, content)
        changed = bytearray(content)
        for place in range(0, len(content), stride):
            changed[place] ^= 1 << place % 8
            with pytest.raises(Problem, match="was changed in the store"):
                require_intact(name, seal, file, bytes(changed))
            changed[place] ^= 1 << place % 8
            in_files += 1

    # The row as text. Equal numbers in another notation are not a modification.
    row = {"manifest": good.manifest, "seal": records.to_data(good.seal)}
    stored = json.dumps(row).encode()
    rest = {**records.to_data(good), "manifest": {}, "seal": {}}
    in_rows = 0
    for place in range(0, len(stored), stride):
        for bit in (0x01, 0x10):
            read = reading(stored[:place] + bytes([stored[place] ^ bit]) + stored[place + 1 :])
            if read is None or json.dumps(read, sort_keys=True) == json.dumps(row, sort_keys=True):
                continue
            with pytest.raises((Problem, msgspec.ValidationError)):
                await seals.check("anna", name, records.read(Row("p", "k", {**rest, **read}), TypeVersion))
        in_rows += 1
    for account, robot_type, version in (("bert", name, 1), ("anna", "other", 1), ("anna", name, 2)):
        with pytest.raises(Problem, match="differs from the upload"):
            await seals.check(account, robot_type, replace(good, version=version))
    return in_files, in_rows


def reading(text: bytes) -> dict[str, Any] | None:
    """The decoded JSON, or ``None``."""
    try:
        read: dict[str, Any] = msgspec.json.decode(text, type=dict[str, Any])
    except (msgspec.DecodeError, UnicodeDecodeError):
        return None
    return read


@pytest.mark.parametrize("name", TYPES)
@pytest.mark.parametrize("stride", [61, pytest.param(1, marks=[pytest.mark.long, pytest.mark.timeout(1_800)])])
def test_modified_bytes_are_rejected(name: str, tmp_path: Path, stride: int) -> None:
    in_files, in_rows = asyncio.run(flip_each(name, tmp_path, stride=stride))
    assert in_files > 15_000 // stride
    assert in_rows > 0
