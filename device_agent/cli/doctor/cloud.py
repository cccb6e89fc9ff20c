"""What is at the other end: the server, whose the agent is, the clocks, and the link itself."""

import logging
import socket
import ssl
import threading
import time
from collections.abc import Generator, Iterator
from typing import Any, Self
from urllib.parse import urlsplit

from device_agent import bootstrap
from device_agent.cli.doctor.finding import Finding, ok, problem, warning
from device_agent.config import catalogue
from device_agent.config.agent_config import AgentConfig
from device_agent.config.client_certificate import OwnCertificate
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore, Pairing
from device_agent.ports.clock import CloudClock, tick_ms, wall_ms
from device_agent.runtime.commands.pinned_keys import ADVICE, PinnedKeys
from device_agent.runtime.errors import Refused
from device_agent.runtime.storage.journal import Journal
from device_agent.transports import factory, tls
from device_agent.transports.http import responses
from device_agent.transports.http.client import CloudClient, CloudError

_OFF_MS = 2000
_LINK_S = 20.0
_TLS_S = 5.0
_SOON_DAYS = 30


def look(store: IdentityStore, configuration: AgentConfig) -> Iterator[Finding]:
    """Everything, as far as it can be reached."""
    clock = CloudClock()
    try:
        pairing = store.pairing()
        api = bootstrap.api_of(store, configuration, clock)
    except ConfigError as error:
        yield problem("server", str(error), "Run `python -m device_agent enroll`.")
        return
    if api.server.startswith("https:"):
        yield _certificate(api)
    found = yield from _server(api, configuration, clock)
    if found is None:
        return
    yield from _clocks(clock)
    if pairing is None or found.get("state") != "claimed":
        yield problem(
            "pairing",
            "nobody has claimed this agent",
            "Run `python -m device_agent enroll`, and enter the code that it shows in the console.",
        )
        return
    if found.get("space") != pairing.space:
        yield warning("pairing", "the agent was moved to another space", "Nothing: `run` notices it by itself.")
        return
    yield ok("pairing", f"paired with {pairing.account}")
    yield _keys(found, pairing, clock)
    yield from _link(store, configuration, pairing, clock)


def _certificate(api: CloudClient) -> Finding:
    """Whether the server is who its address says, and for how long."""
    parts = urlsplit(api.server)
    host, port = parts.hostname or "", parts.port or 443
    whom = f"the authority in {api.ca}" if api.ca else "the authorities of this machine"
    try:
        with (
            socket.create_connection((host, port), timeout=_TLS_S) as plain,
            tls.context(api.ca).wrap_socket(plain, server_hostname=host) as link,
        ):
            shown = link.getpeercert() or {}
            version = link.version()
    except ssl.SSLCertVerificationError as error:
        return problem(
            "certificate",
            f"{host}: {error.verify_message}; trusted are {whom}",
            "If the server's authority is its own, give the agent its certificate: `enroll --ca ca.crt`. If it is over "
            "or names another host, make a new one at the server: `python -m infra.tls --renew`.",
        )
    except OSError as error:
        return problem("certificate", f"{host}:{port} shows none: {error}", "Check whether the server speaks TLS.")
    days = (ssl.cert_time_to_seconds(str(shown["notAfter"])) - time.time()) / 86_400
    if days < _SOON_DAYS:
        return warning("certificate", f"{host}'s ends in {days:.0f} days", "Renew it: `python -m infra.tls --renew`.")
    return ok("certificate", f"{host} is vouched for by {whom} for {days:.0f} days ({version})")


def _server(
    api: CloudClient, configuration: AgentConfig, clock: CloudClock
) -> Generator[Finding, None, dict[str, Any] | None]:
    """Whether it answers, and knows this agent; what it says of it."""
    began_s = time.monotonic()
    try:
        try:
            found = api.enrollment()
        except CloudError:
            # A clock that is far off makes the first token look old; its answer has told the right time.
            if clock.now_ms() is None:
                raise
            found = api.enrollment()
    except CloudError as error:
        advice = "If it does not know this agent, run `python -m device_agent enroll` once more."
        yield problem("server", f"{configuration.server} refuses this agent: {error}", advice)
        return None
    except OSError as error:
        advice = "Check the address in agent.toml, the network, and whether the server runs."
        yield problem("server", str(error), advice)
        return None
    took_ms = (time.monotonic() - began_s) * 1000
    yield ok("server", f"{configuration.server} answers in {took_ms:.0f} ms and knows this agent")
    return found


def _keys(found: dict[str, Any], pairing: Pairing, clock: CloudClock) -> Finding:
    """Whether this agent obeys what the cloud signs now, or learns to by itself."""
    try:
        news = responses.read(found, responses.News)
        pins = PinnedKeys(pairing, save=lambda _: None, now_ms=clock.now_ms)
        pins.follow(news.key_statements)
    except (CloudError, Refused) as error:
        return problem("keys", f"the cloud's new key is not followed: {error}", f"Then {ADVICE}.")
    if news.signing_key and news.signing_key not in pins:
        return problem(
            "keys",
            f"the cloud signs its orders with key {news.signing_key}, which this agent has not learned: it was off for "
            "longer than the former one counted, or that one has leaked",
            "End the agent, run `python -m device_agent repin`, and start it again; or un-pair it and claim it anew.",
        )
    return ok("keys", f"obeys {len(pins)} of the cloud's keys, the newest number {pins.serial}")


def _clocks(clock: CloudClock) -> Iterator[Finding]:
    now_ms = clock.now_ms()
    if now_ms is None:
        yield warning("clock", "the server does not tell its time", "Update the server.")
        return
    off_ms = wall_ms() - now_ms
    if abs(off_ms) > _OFF_MS:
        ahead = "ahead of" if off_ms > 0 else "behind"
        yield warning(
            "clock",
            f"this machine's clock is {abs(off_ms) / 1000:.1f} s {ahead} the server's: what it measures gets wrong "
            "times (orders do not: their time is judged by the server's clock)",
            "Set it, and keep it set: timedatectl set-ntp true",
        )
    else:
        yield ok("clock", f"{abs(off_ms):.0f} ms from the server's")


def _link(store: IdentityStore, configuration: AgentConfig, pairing: Pairing, clock: CloudClock) -> Iterator[Finding]:
    """Connect as the agent does; not beside one that runs, whose link that would end."""
    try:
        with store.lock():
            yield from _connect(store, configuration, pairing, clock)
    except ConfigError as error:
        if "already" not in str(error):
            yield problem("link", str(error), "Correct agent.toml.")
            return
        yield ok("link", "the agent is running; its link is not disturbed to try it")


def _connect(
    store: IdentityStore, configuration: AgentConfig, pairing: Pairing, clock: CloudClock
) -> Iterator[Finding]:
    journal = Journal(store.journal)
    journal.open(now_ms=wall_ms())
    pins = PinnedKeys(pairing, save=store.save_pairing, now_ms=clock.now_ms)
    membership = factory.PairingMonitor(pairing, configuration, catalogue.enrolled_devices(configuration), pins)
    transport = factory.make(
        factory.Wiring(
            configuration=configuration,
            pairing=pairing,
            membership=membership,
            open_api=lambda: bootstrap.api_of(store, configuration, clock),
            next_session=journal.next_session,
            quiet=lambda: True,
            certificate=OwnCertificate(store.folder),
            now_ms=clock.now_ms,
        )
    )
    up = threading.Event()
    with _Overheard() as overheard:
        began = tick_ms()
        transport.start(lambda _topic, _payload: None, lambda is_up: up.set() if is_up else None)
        there = up.wait(_LINK_S)
        took_ms = tick_ms() - began
        transport.stop()
    journal.close()
    if there:
        yield ok("link", f"{configuration.transport}: connected in {took_ms} ms, with this agent's own rights")
    else:
        yield problem(
            "link",
            f"{configuration.transport}: no link within {_LINK_S:.0f} s{overheard.last}",
            "The server answers, what carries messages does not: check that it runs, and that no firewall is between; "
            'where only HTTP passes, write `transport = "http"` into agent.toml.',
        )


class _Overheard(logging.Handler):
    """The last thing that the transport complained about. A ``with`` listens, and keeps it from the terminal."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.last = ""
        self._log = logging.getLogger("device_agent.transports")

    def emit(self, record: logging.LogRecord) -> None:
        self.last = f": {record.getMessage()}"

    def __enter__(self) -> Self:
        self._propagated = self._log.propagate
        self._log.propagate = False
        self._log.addHandler(self)
        return self

    def __exit__(self, *_: object) -> None:
        self._log.removeHandler(self)
        self._log.propagate = self._propagated
