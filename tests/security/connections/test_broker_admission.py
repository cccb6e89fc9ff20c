"""Connections without a CONNECT do not keep clients out of the embedded broker."""

from pathlib import Path

from tests.harness.network.brokers import start_broker
from tests.harness.network.half_open import start_half_open_clients

CONNECTIONS = 1_002
"""More than the number of clients that may be connected."""


def test_a_client_connects_while_others_do_not_finish_their_connect(tmp_path: Path) -> None:
    with start_broker("amqtt", tmp_path) as broker, broker.client("before") as before:
        with start_half_open_clients((broker.tcp_port, "tcp", CONNECTIONS)) as attackers:
            attackers.await_open()
            assert broker.accepts("after", broker.issue(broker.grant("after")))
        assert not before.disconnected.is_set()
