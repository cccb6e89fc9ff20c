"""mosquitto as a site broker: its user, limits, and a bounded number of credentials."""

import contextlib
import json
import os
import pwd
import socket
from pathlib import Path

import pytest

from tests.harness.network.brokers import HOST, RunningBroker, start_broker, wait_until

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


def mosquitto_of(broker: RunningBroker) -> int:
    """Process id of mosquitto itself."""
    pid = broker.process.pid
    (child,) = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return int(child)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can start a process of another user")
def test_started_as_root_it_runs_as_its_own_user_and_keeps_rights_of_an_earlier_version(tmp_path: Path) -> None:
    own = pwd.getpwnam("mosquitto").pw_uid
    with start_broker("mosquitto", tmp_path) as broker:
        credentials = broker.issue(broker.grant("agent"))
        status = Path(f"/proc/{mosquitto_of(broker)}/status").read_text()
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


def test_connections_beyond_the_limit_are_closed_and_leave_room_afterwards(tmp_path: Path) -> None:
    with start_broker("mosquitto", tmp_path, more=("--max-connections", str(LIMIT))) as broker:
        credentials = broker.issue(broker.grant("robot"))
        with contextlib.ExitStack() as stack:
            silent = [stack.enter_context(socket.create_connection((HOST, broker.tcp_port))) for _ in range(2 * LIMIT)]
            # mosquitto 2.0.11 admits one connection more than its limit.
            wait_until(lambda: sum(map(closed, silent)) >= LIMIT - 1, "connections to be closed")
        wait_until(lambda: broker.accepts("robot", credentials), "a free connection")


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
