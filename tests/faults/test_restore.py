"""An outdated backup is restored while the arm keeps running: the first command of each restore succeeds."""

import signal
from pathlib import Path

import pytest

from tests.faults.stack import Stack, start
from tests.harness.network.brokers import BrokerKind

HOME = {"shoulder_pan": 0.1}


def take_and_release(stack: Stack, device: str) -> int:
    lease = stack.post(f"/devices/{device}/lease", wait_ms=10_000)
    assert lease["confirmed"], lease
    epoch = int(lease["epoch"])
    assert stack.http.delete(f"/devices/{device}/lease?epoch={epoch}").is_success
    return epoch


def move(stack: Stack, device: str) -> str:
    request = {"kind": "move_joints", "position_rad": HOME}
    action = stack.post(f"/devices/{device}/actions", request=request, wait_ms=12_000, wait_for="done")
    return f"{action['status']} {(action['reason'] or {}).get('message', '')}".strip()


def restore(stack: Stack, archive: Path) -> None:
    for program in (stack.functions, stack.worker):
        stack.signal(program, signal.SIGKILL)
    stack._program("function_app", "restore", str(archive), "--force")
    for program in (stack.functions, stack.worker):
        stack.restart(program)
    stack.await_health()


@pytest.mark.parametrize("kind", ["amqtt", "mosquitto"])
def test_the_first_command_after_each_restore_succeeds(kind: BrokerKind, tmp_path: Path) -> None:
    archive = tmp_path / "backup.zip"
    with start(kind, 1) as stack:
        device = stack.devices()[0]["id"]
        assert move(stack, device) == "done"
        stack._program("function_app", "backup", str(archive))
        assert stack._program("function_app", "verify", str(archive)) == "OK"
        before = [take_and_release(stack, device) for _ in range(6)][-1]
        restore(stack, archive)
        assert move(stack, device) == "done"
        assert take_and_release(stack, device) > before
        restore(stack, archive)
        assert take_and_release(stack, device) > before + 1
        restore(stack, archive)
        link = stack._program("function_app", "sign-in-link", "--account", "ann").partition("#sign-in=")[2]
        token = stack.post("/auth/sign-in", link=link)["access_token"]
        stack.http.headers["Authorization"] = f"Bearer {token}"  # API keys may not reset a Stop
        assert stack.post(f"/devices/{device}/stop")["outcome"] == "confirmed"
        assert stack.post(f"/devices/{device}/stop/reset")["confirmed"] is True
        assert move(stack, device) == "done"
        assert stack._program("function_app", "verify") == "OK"
