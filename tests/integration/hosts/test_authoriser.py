"""AWS IoT Core as the broker: its custom authoriser as it is asked, and what taking rights back does to connections.

The connections' own call of IoT Core (``DELETE /connections/<client id>``), which moto lacks, is answered by a fake.
"""

import base64
import json
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from device_agent.protocol.security import grants, signing
from device_agent.protocol.security.grants import Grant
from function_app.adapters.aws.broker_access import IotBrokerAccess
from function_app.domain.common.ids import new_id
from function_app.entrypoints.broker_auth.iot_core import authorise
from function_app.settings import IotBus
from tests.harness.cloud.cloud import Cloud, settings
from tests.harness.stores.aws import HOST, REGION, use_credentials

ARN = "arn:aws:lambda:eu-west-1:123456789012:function:telescope"
POLICY = "telescope-agents"


class Connections(ThreadingHTTPServer):
    """Who is connected; a fake."""

    def __init__(self) -> None:
        super().__init__((HOST, 0), _Answer)
        self.live: set[str] = set()


class _Answer(BaseHTTPRequestHandler):
    server: Connections

    def do_DELETE(self) -> None:
        client_id = urlsplit(self.path).path.rpartition("/")[2]
        there = client_id in self.server.live
        self.server.live.discard(client_id)
        body = b"{}" if there else json.dumps({"message": "not connected"}).encode()
        self.send_response_only(200 if there else 404)
        if not there:
            self.send_header("x-amzn-ErrorType", "ResourceNotFoundException")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Nothing."""


@pytest.fixture
def connections(monkeypatch: pytest.MonkeyPatch) -> Iterator[Connections]:
    use_credentials(monkeypatch)
    server = Connections()
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def cloud(tmp_path: Path, connections: Connections) -> Iterator[Cloud]:
    bus = IotBus(region=REGION, endpoint=f"http://{HOST}:{connections.server_port}", policy=POLICY)
    with Cloud(replace(settings(tmp_path), broker="iot", bus=bus)) as cloud:
        assert isinstance(cloud.functions.access, IotBrokerAccess)
        yield cloud


def grant(client_id: str = "w-s1-abc", principal: str = "account:a:s1:watch", lifetime_s: float = 900) -> Grant:
    return Grant(
        principal=principal,
        client_id=client_id,
        publish=("ts/v1/space/+/+/stop",),
        subscribe=("ts/v1/space/+/conn",),
        token_id=new_id(),
        expires_at=int(time.time() + lifetime_s),
    )


def ask(cloud: Cloud, *, username: str, password: str, client_id: str) -> dict[str, Any]:
    event = {
        "protocols": ["tls", "mqtt"],
        "protocolData": {
            "mqtt": {
                "username": username,
                "password": base64.b64encode(password.encode()).decode(),
                "clientId": client_id,
            }
        },
    }
    return cloud.run(authorise(cloud.functions, event, ARN))


def admitted(cloud: Cloud, credentials: tuple[str, str], client_id: str) -> bool:
    answer = ask(cloud, username=credentials[0], password=credentials[1], client_id=client_id)
    return bool(answer["isAuthenticated"])


def issue(cloud: Cloud, wanted: Grant) -> tuple[str, str]:
    return cloud.run(cloud.functions.access.issue(wanted))


def test_who_has_credentials_is_let_in_with_exactly_its_topics(cloud: Cloud) -> None:
    username, password = issue(cloud, grant())
    suffixed = f"{username}?x-amz-customauthorizer-name=telescope"
    answer = ask(cloud, username=suffixed, password=password, client_id="w-s1-abc")
    assert answer["isAuthenticated"] is True
    assert 890 <= answer["disconnectAfterInSeconds"] <= 900
    text = "".join(answer["policyDocuments"])
    assert "arn:aws:iot:eu-west-1:123456789012:client/w-s1-abc" in text
    assert "topicfilter/ts/v1/space/*/conn" in text
    assert "ctl" not in text


def test_other_clients_are_rejected(cloud: Cloud) -> None:
    username, password = issue(cloud, grant())
    forged = grants.issue(grant(), signing.generate())
    over = grants.issue(grant(lifetime_s=-1), cloud.run(cloud.functions.keys.current()))
    for tried in (
        {"username": username, "password": password, "client_id": "w-s1-other"},
        {"username": "account:b:s2:watch", "password": password, "client_id": "w-s1-abc"},
        {"username": username, "password": forged, "client_id": "w-s1-abc"},
        {"username": username, "password": over, "client_id": "w-s1-abc"},
        {"username": username, "password": "", "client_id": "w-s1-abc"},
        {"username": "", "password": "x", "client_id": ""},
    ):
        answer = ask(cloud, **tried)
        assert (answer["isAuthenticated"], answer["policyDocuments"]) == (False, []), tried
    assert cloud.run(authorise(cloud.functions, {"protocolData": {}}, ARN))["isAuthenticated"] is False


@pytest.mark.parametrize("principal", ["account:a", "account:a:s1", "account:a:s1:watch", "account:a:+:watch"])
def test_what_is_taken_back_is_cut_and_not_let_in_again(cloud: Cloud, connections: Connections, principal: str) -> None:
    mine, other = issue(cloud, grant()), issue(cloud, grant("w-other", "account:b:s2:watch"))
    connections.live = {"w-s1-abc", "w-other"}
    cloud.run(cloud.functions.access.revoke(principal=principal))
    assert connections.live == {"w-other"}
    assert not admitted(cloud, mine, "w-s1-abc")
    assert admitted(cloud, other, "w-other")
    assert admitted(cloud, issue(cloud, grant()), "w-s1-abc"), "credentials issued afterwards work"
    cloud.run(cloud.functions.access.revoke(principal=principal))  # who is not connected is no error


def test_a_client_id_is_taken_back_alone(cloud: Cloud, connections: Connections) -> None:
    mine, second = issue(cloud, grant()), issue(cloud, grant("w-s1-second"))
    connections.live = {"w-s1-abc", "w-s1-second"}
    cloud.run(cloud.functions.access.revoke(client_id="w-s1-abc"))
    assert connections.live == {"w-s1-second"}
    assert not admitted(cloud, mine, "w-s1-abc")
    assert admitted(cloud, second, "w-s1-second")


def test_what_has_run_out_is_forgotten(cloud: Cloud) -> None:
    issue(cloud, grant())
    access = cloud.functions.access
    assert isinstance(access, IotBrokerAccess)
    cloud.run(access.revoke(client_id="w-gone"))
    cloud.run(access.expire(time.time() + 1000))
    assert len(cloud.run(access._rights._rows("issued"))) == 0
    assert len(cloud.run(access._rights._rows("revoked"))) == 1
    cloud.run(access.expire(time.time() + 100_000))
    assert len(cloud.run(access._rights._rows("revoked"))) == 0


def test_another_broker_has_nothing_to_ask(tmp_path: Path) -> None:
    with Cloud(settings(tmp_path)) as cloud, pytest.raises(ValueError, match="nothing to ask"):
        cloud.run(authorise(cloud.functions, {"protocolData": {}}, ARN))
