"""Which connection is closed when a process has too many."""

import socket
from collections.abc import Iterator

import pytest

from function_app.entrypoints.hosts.connection_limits import AcceptedSocket, ConnectionLimits, State
from function_app.entrypoints.hosts.uvicorn import listen

HERE = "127.0.0.1"
WAITING_S = 10.0


class Accepting:
    """A listener with limits, and its clients."""

    def __init__(self, *, total: int = 100, per_address: int = 0) -> None:
        self.now_s = 0.0
        self.limits = ConnectionLimits(
            total=total, per_address=per_address, waiting_s=WAITING_S, now_s=lambda: self.now_s
        )
        self._listener = self.limits.listener(listen(HERE, 0))
        self._listener.listen()
        self._listener.setblocking(False)
        self._clients: list[socket.socket] = []
        self._accepted: list[socket.socket] = []

    def connect(self, state: State = State.WAITING, address: str = HERE) -> AcceptedSocket | None:
        """The server's side of a new connection; ``None`` if it was rejected."""
        client = socket.create_connection(self._listener.getsockname()[:2], source_address=(address, 0))
        self._clients.append(client)
        try:
            accepted, _ = self._listener.accept()
        except BlockingIOError:
            return None
        assert isinstance(accepted, AcceptedSocket)
        self._accepted.append(accepted)
        self.limits.mark(accepted, state)
        if state is State.WAITING:
            accepted.deadline_s = self.now_s + WAITING_S
        return accepted

    def ended(self) -> list[int]:
        """Numbers of the accepted connections that have ended, and closes them as the event loop does."""
        numbers = []
        for number, accepted in enumerate(self._accepted):
            try:
                over = accepted.fileno() < 0 or accepted.recv(1, socket.MSG_DONTWAIT) == b""
            except BlockingIOError:
                over = False
            if over:
                accepted.close()
                numbers.append(number)
        return numbers

    def close(self) -> None:
        for each in (self._listener, *self._clients, *self._accepted):
            each.close()


@pytest.fixture
def accepting(request: pytest.FixtureRequest) -> Iterator[Accepting]:
    accepting = Accepting(**getattr(request, "param", {}))
    yield accepting
    accepting.close()
    assert accepting.limits.open == 0


@pytest.mark.parametrize("accepting", [{"total": 4}], indirect=True)
def test_a_new_connection_replaces_the_oldest_that_does_no_work(accepting: Accepting) -> None:
    for state in (State.ACTIVE, State.IDLE, State.WAITING, State.WAITING):
        accepting.connect(state)
    for expected in ([2], [2, 3], [1, 2, 3]):
        assert accepting.connect(State.ACTIVE) is not None
        assert accepting.ended() == expected
    assert accepting.connect() is None, "all connections process a request"
    assert accepting.limits.active == 4


@pytest.mark.parametrize("accepting", [{"total": 10, "per_address": 2}], indirect=True)
def test_an_address_at_its_limit_replaces_its_own_connections_only(accepting: Accepting) -> None:
    accepting.connect(address="127.0.0.2")
    for _ in range(4):
        accepting.connect()
    assert accepting.ended() == [1, 2]


@pytest.mark.parametrize("accepting", [{"total": 3}], indirect=True)
def test_connections_of_an_authenticated_address_are_replaced_last(accepting: Accepting) -> None:
    accepting.limits.trust(HERE)
    accepting.connect()
    for _ in range(5):
        accepting.connect(address="127.0.0.2")
    assert accepting.ended() == [1, 2, 3]


def test_a_connection_ends_at_its_deadline_unless_it_is_released(accepting: Accepting) -> None:
    accepting.connect()
    authenticated = accepting.connect()
    assert authenticated is not None
    accepting.limits.release(authenticated)
    accepting.now_s = WAITING_S - 0.1
    accepting.limits.end_late()
    assert accepting.ended() == []
    accepting.now_s = WAITING_S
    accepting.limits.end_late()
    assert accepting.ended() == [0]
    assert accepting.limits.open == 1


@pytest.mark.parametrize("accepting", [{"total": 2, "per_address": 1}], indirect=True)
def test_released_connections_do_not_count(accepting: Accepting) -> None:
    for _ in range(5):
        connection = accepting.connect()
        assert connection is not None
        accepting.limits.release(connection)
    assert accepting.ended() == []
