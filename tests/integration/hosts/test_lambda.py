"""Lambda: one request per instance at a time, events in batches, and instances that are frozen between requests."""

import base64
import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest

from tests.harness.cloud.cloud import API
from tests.harness.hosts import HostFailed
from tests.harness.hosts.aws import Lambda, start_lambda
from tests.harness.hosts.host import PATIENCE_S
from tests.harness.network.brokers import wait_until


@pytest.fixture(scope="module")
def host(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lambda]:
    home = tmp_path_factory.mktemp("lambda")
    console = home / "console"
    console.mkdir()
    (console / "index.html").write_text("<p>grüß</p>", encoding="utf-8")
    (console / "picture.png").write_bytes(bytes(range(256)))
    environment = {"TELESCOPE_HOME": str(home), "TELESCOPE_MQTT_PORT": "1", "TELESCOPE_CONSOLE": str(console)}
    with start_lambda(environment) as running:
        yield running


def record(number: int, **body: object) -> dict[str, object]:
    return {"messageId": str(number), "eventSource": "aws:sqs", "body": json.dumps(body)}


def test_only_unstored_messages_of_a_batch_stay_in_the_queue(host: Lambda, tmp_path: Path) -> None:
    presence = base64.b64encode(b'{"online":true,"session":1,"at_ms":1}').decode()
    batch = {"Records": [record(1, topic="ts/v1/s/a/conn", payload=presence), record(2, nonsense=1)]}
    assert host.invoke(batch) == {"batchItemFailures": []}
    (tmp_path / "tables.sqlite").write_bytes(b"no database " * 1000)
    with start_lambda({"TELESCOPE_HOME": str(tmp_path)}) as broken:
        assert broken.invoke(batch) == {"batchItemFailures": [{"itemIdentifier": "1"}]}


def test_an_unknown_event_is_an_error_and_the_instance_continues(host: Lambda) -> None:
    with pytest.raises(HostFailed, match="unknown event"):
        host.invoke({"what": 1})
    host.tick()


def test_instances_serve_concurrent_requests_stay_warm_and_are_frozen_between_requests(host: Lambda) -> None:
    with ThreadPoolExecutor(3) as callers:
        answers = list(callers.map(lambda _: httpx.get(f"{host.url}{API}/health", timeout=PATIENCE_S), range(3)))
    assert [answer.status_code for answer in answers] == [200] * 3
    instances = list(host.instances)
    assert len(instances) <= 3
    for _ in range(20):
        assert httpx.get(f"{host.url}{API}/nothing", timeout=PATIENCE_S).status_code == 404
    host.tick()
    assert host.instances == instances
    for instance in instances:
        assert instance.program is not None
        state = Path(f"/proc/{instance.program.process.pid}/stat")
        wait_until(lambda path=state: path.read_text().rpartition(")")[2].split()[0] == "T", "the freeze")  # type: ignore[misc]


def test_binary_files_are_sent_unchanged(host: Lambda) -> None:
    answer = httpx.get(f"{host.url}/picture.png", timeout=PATIENCE_S)
    assert (answer.content, answer.headers["content-type"]) == (bytes(range(256)), "image/png")
    assert httpx.get(host.url, timeout=PATIENCE_S).content == "<p>grüß</p>".encode()
    unchanged = httpx.get(
        f"{host.url}/picture.png", headers={"If-None-Match": answer.headers["etag"]}, timeout=PATIENCE_S
    )
    assert (unchanged.status_code, unchanged.content) == (304, b"")
