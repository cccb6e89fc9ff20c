"""The number of Python calls that one request to start an action costs."""

import sys
from collections import Counter
from pathlib import Path
from types import FrameType

from device_agent.protocol import AckStatus
from function_app.adapters.local.signing_keys import FileKeys
from tests.harness.cloud.cloud import API, MOVE, Cloud, settings
from tests.harness.network.brokers import start_broker

MAX_CALLS = 300
"""Calls and coroutine resumptions in ``function_app`` and ``device_agent`` until the action has started."""
MAX_MATCHES = 3
PACKAGES = ("/function_app/", "/device_agent/")


def test_a_warm_start_makes_few_calls(tmp_path: Path) -> None:
    FileKeys(tmp_path / "keys").load()
    calls: Counter[str] = Counter()

    def count(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and any(package in frame.f_code.co_filename for package in PACKAGES):
            calls[f"{Path(frame.f_code.co_filename).name}:{frame.f_code.co_name}"] += 1

    with (
        start_broker("amqtt", tmp_path / "broker", keys=tmp_path / "keys" / "public.json") as broker,
        Cloud(settings(tmp_path, broker)) as cloud,
        cloud.robot() as robot,
    ):
        anna = cloud.sign_in("anna")
        robot.pair(anna)
        robot.connect()
        path = f"{API}/devices/{robot.device}/actions"
        body = {"request": MOVE, "wait_ms": 10_000}
        robot.reports = lambda _: (AckStatus.RECEIVED, AckStatus.ACCEPTED, AckStatus.STARTED, AckStatus.DONE)
        for _ in range(2):
            assert anna.post(path.removeprefix(API), {**body, "wait_for": "done"}).json()["status"] == "done"
        robot.reports = lambda _: (AckStatus.RECEIVED, AckStatus.ACCEPTED, AckStatus.STARTED)

        async def start() -> str:
            sys.setprofile(count)  # counts this thread only: the loop of the functions
            try:
                answer = await anna._client.request("POST", path, json=body)
            finally:
                sys.setprofile(None)
            return str(answer.json()["status"])

        assert cloud.run(start()) == "started"

    assert calls.total() <= MAX_CALLS, calls.most_common(20)
    assert sum(number for name, number in calls.items() if "match" in name) <= MAX_MATCHES
