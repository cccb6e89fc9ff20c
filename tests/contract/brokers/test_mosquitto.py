"""mosquitto as a site broker: its user, limits, and a bounded number of credentials."""

import contextlib
import json
import os
import pwd
import socket
from functools import partial
from pathlib import Path

import pytest

from tests.harness.network.brokers import HOST, PATIENCE_S, RunningBroker, Transport, start_broker, wait_until
from tests.harness.network.child_processes import child_processes
from tests.harness.network.half_open import PARTS

LIMIT = 4


def clients(broker: RunningBroker) -> list[str]:
    """Usernames in the broker, without the functions' own."""
    stored = json.loads((broker.home / "dynamic-security.json").read_text())
    return [client["username"] for client in stored["clients"] if client["username"] != "service"]


def closed(connection: socket.socket) -> bool:
    """Whether the broker has closed a connection."""
    connection.setblocking(False)
    try:
        return connection.recv(1, socket.MSG_PEEK) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


def all_closed(connections: list[socket.socket]) -> bool:
    return all(map(closed, connections))


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can start a process of another user")
def test_started_as_root_it_runs_as_its_own_user_and_keeps_rights_of_an_earlier_version(tmp_path: Path) -> None:
    own = pwd.getpwnam("mosquitto").pw_uid
    with start_broker("mosquitto", tmp_path) as broker:
        credentials = broker.issue(broker.grant("agent"))
        for server in child_processes(broker.process.pid).values():
            status = Path(f"/proc/{server}/status").read_text()
            assert f"Uid:\t{own}\t{own}\t{own}\t{own}\n" in status
            assert "Groups:\t \n" in status
    for path in (tmp_path, *tmp_path.iterdir()):
        os.chown(path, 0, 0)  # as an earlier version, which ran as root
    with start_broker("mosquitto", tmp_path) as broker:
        assert broker.accepts("agent", credentials)
        assert broker.accepts("other", broker.issue(broker.grant("other")))
    assert (tmp_path / "service.password").stat().st_uid == 0


def test_a_message_at_qos_2_is_not_held(tmp_path: Path) -> None:
    with start_broker("mosquitto", tmp_path) as broker, broker.client("robot", publish=("t",)) as robot:
        robot.publish("t", b"x", qos=2)
        assert robot.ended()


def test_clients_beyond_the_limit_are_closed_and_leave_room_afterwards(tmp_path: Path) -> None:
    with start_broker("mosquitto", tmp_path, more=("--max-connections", str(LIMIT))) as broker:
        issued = {name: broker.issue(broker.grant(name)) for name in map(str, range(LIMIT + 2))}
        with contextlib.ExitStack() as stack:
            connected = [
                stack.enter_context(broker.connect(name, credentials)).connected.is_set()
                for name, credentials in issued.items()
            ]
        assert 0 < sum(connected) <= LIMIT
        assert not connected[-1]
        wait_until(lambda: broker.accepts("0", issued["0"]), "a free connection")


def test_one_address_cannot_take_all_websocket_connections(tmp_path: Path) -> None:
    request = PARTS["websockets"][-1]
    with (
        start_broker("mosquitto", tmp_path, more=("--max-connections", str(LIMIT))) as broker,
        contextlib.ExitStack() as stack,
    ):
        for _ in range(4 * LIMIT):
            attacker = stack.enter_context(socket.create_connection((HOST, broker.websocket_port)))
            attacker.sendall(request)
        other = stack.enter_context(
            socket.create_connection((HOST, broker.websocket_port), PATIENCE_S, source_address=("127.0.0.2", 0))
        )
        other.sendall(request)
        assert other.recv(12) == b"HTTP/1.1 101"


def test_at_the_limit_connections_without_a_complete_connect_are_closed_and_a_client_connects(
    tmp_path: Path, transport: Transport
) -> None:
    with start_broker("mosquitto", tmp_path, more=("--max-connections", str(LIMIT))) as broker:
        credentials = broker.issue(broker.grant("robot"))
        with contextlib.ExitStack() as stack:
            for part in PARTS[transport][:2]:
                attackers = [
                    stack.enter_context(socket.create_connection((HOST, broker.port(transport))))
                    for _ in range(4 * LIMIT)
                ]
                for attacker in attackers:
                    attacker.sendall(part)
                if transport == "tcp":
                    assert broker.accepts("robot", credentials)
                wait_until(partial(all_closed, attackers), "them to be closed")
        assert broker.accepts("robot", credentials, transport=transport)


def test_repeated_requests_for_credentials_keep_a_bounded_number_of_clients(tmp_path: Path) -> None:
    with start_broker("mosquitto", tmp_path) as broker:
        for number in range(40):
            last = broker.issue(broker.grant(f"tab-{number}", principal="account:anna:session:watch"))
        assert len(clients(broker)) == 32
        assert broker.accepts("tab-39", last)
        for _ in range(6):
            last = broker.issue(broker.grant("robot", principal="agent:robot"))
        assert len([name for name in clients(broker) if "robot" in name]) == 2
        assert broker.accepts("robot", last)
        roles = json.loads((broker.home / "dynamic-security.json").read_text())["roles"]
        assert len(roles) == 1 + 32 + 2
