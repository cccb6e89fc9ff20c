"""Checks of the connection: server, certificate, pairing, keys, clocks and link."""

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
from device_agent.config.client_certificate import ClientCertificate
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore, Pairing
from device_agent.ports.clock import CloudClock, tick_ms, wall_ms
from device_agent.runtime.commands.pinned_keys import ADVICE, PinnedKeys
from device_agent.runtime.errors import Refused
from device_agent.runtime.storage.journal import Journal
from device_agent.transports import factory, pairing_monitor, tls
from device_agent.transports.http import responses
from device_agent.transports.http.client import CloudClient, CloudError

_MAX_CLOCK_OFFSET_MS = 2000
_LINK_S = 20.0
_TLS_S = 5.0
_EXPIRY_WARNING_DAYS = 30


def examine(store: IdentityStore, configuration: AgentConfig) -> Iterator[Finding]:
    """Run all checks, as far as the server can be reached."""
    clock = CloudClock()
    try:
        pairing = store.pairing()
        api = bootstrap.cloud_client(store, configuration, clock)
    except ConfigError as error:
        yield problem("server", str(error), "Run `python -m device_agent enroll`.")
        return
    if api.server.startswith("https:"):
        yield _certificate(api)
    enrollment = yield from _server(api, configuration, clock)
    if enrollment is None:
        return
    yield from _clocks(clock)
    if pairing is None or enrollment.get("state") != "claimed":
        yield problem(
            "pairing",
            "no account has claimed this agent",
            "Run `python -m device_agent enroll`, and enter the code that it shows in the console.",
        )
        return
    if enrollment.get("space") != pairing.space:
        yield warning("pairing", "the agent was moved to another space", "No action is needed: `run` detects it.")
        return
    yield ok("pairing", f"paired with {pairing.account} #{pairing.owner[:6]}")
    yield _keys(store, enrollment, pairing, clock)
    yield from _link(store, configuration, pairing, clock)


def _certificate(api: CloudClient) -> Finding:
    """Check that the server's certificate is valid and does not expire soon."""
    parts = urlsplit(api.server)
    host, port = parts.hostname or "", parts.port or 443
    authorities = f"the authority in {api.ca}" if api.ca else "the authorities of this machine"
    try:
        with (
            socket.create_connection((host, port), timeout=_TLS_S) as plain,
            tls.context(api.ca).wrap_socket(plain, server_hostname=host) as link,
        ):
            certificate = link.getpeercert() or {}
            version = link.version()
    except ssl.SSLCertVerificationError as error:
        return problem(
            "certificate",
            f"{host}: {error.verify_message}; trusted: {authorities}",
            "If the server has a private certificate authority, provide it: `enroll --ca ca.crt`. If the certificate "
            "expired "
            "or names another host, renew it at the server: `python -m infra.tls --renew`.",
        )
    except OSError as error:
        return problem(
            "certificate", f"{host}:{port} presents no certificate: {error}", "Check whether the server uses TLS."
        )
    days = (ssl.cert_time_to_seconds(str(certificate["notAfter"])) - time.time()) / 86_400
    if days < _EXPIRY_WARNING_DAYS:
        return warning(
            "certificate",
            f"the certificate of {host} expires in {days:.0f} days",
            "Renew it: `python -m infra.tls --renew`.",
        )
    return ok("certificate", f"the certificate of {host} is valid for {days:.0f} days ({version}; {authorities})")


def _server(
    api: CloudClient, configuration: AgentConfig, clock: CloudClock
) -> Generator[Finding, None, dict[str, Any] | None]:
    """Check that the server responds and knows this agent; returns its response."""
    started_s = time.monotonic()
    try:
        try:
            enrollment = api.enrollment()
        except CloudError:
            # With a wrong local clock the first token looks expired; the response corrected the clock offset.
            if clock.now_ms() is None:
                raise
            enrollment = api.enrollment()
    except CloudError as error:
        advice = "If it does not know this agent, run `python -m device_agent enroll` again."
        yield problem("server", f"{configuration.server} rejects this agent: {error}", advice)
        return None
    except OSError as error:
        advice = "Check the address in agent.toml, the network, and whether the server runs."
        yield problem("server", str(error), advice)
        return None
    duration_ms = (time.monotonic() - started_s) * 1000
    yield ok("server", f"{configuration.server} responds in {duration_ms:.0f} ms and knows this agent")
    return enrollment


def _keys(store: IdentityStore, enrollment: dict[str, Any], pairing: Pairing, clock: CloudClock) -> Finding:
    """Check that this agent trusts the key with which the cloud signs now."""
    try:
        keys = responses.read(enrollment, responses.KeyUpdate)
        pins = PinnedKeys(pairing, identity=store.private_key(), save=lambda _: None, now_ms=clock.now_ms)
        pins.follow(keys.key_statements)
    except (CloudError, Refused) as error:
        return problem("keys", f"the cloud's new key is not trusted: {error}", f"Then {ADVICE}.")
    if keys.signing_key and keys.signing_key not in pins:
        return problem(
            "keys",
            f"the cloud signs commands with key {keys.signing_key}, which this agent does not trust: it was offline "
            "for longer than the previous key was valid, or that key was revoked",
            "Stop the agent, run `python -m device_agent repin`, and start it again; or unpair and claim it again.",
        )
    return ok("keys", f"{len(pins)} keys of the cloud are pinned; the newest is number {pins.serial}")


def _clocks(clock: CloudClock) -> Iterator[Finding]:
    now_ms = clock.now_ms()
    if now_ms is None:
        yield warning("clock", "the server's responses contain no time", "Update the server.")
        return
    offset_ms = wall_ms() - now_ms
    if abs(offset_ms) > _MAX_CLOCK_OFFSET_MS:
        direction = "ahead of" if offset_ms > 0 else "behind"
        yield warning(
            "clock",
            f"this machine's clock is {abs(offset_ms) / 1000:.1f} s {direction} the server's: its measurements get "
            "wrong timestamps (commands are not affected: their expiry uses the server's clock)",
            "Synchronize it: timedatectl set-ntp true",
        )
    else:
        yield ok("clock", f"{abs(offset_ms):.0f} ms from the server's")


def _link(store: IdentityStore, configuration: AgentConfig, pairing: Pairing, clock: CloudClock) -> Iterator[Finding]:
    """Connect as the agent does, unless the agent is running: a second connection would end its link."""
    try:
        with store.lock():
            yield from _connect(store, configuration, pairing, clock)
    except ConfigError as error:
        if "already" not in str(error):
            yield problem("link", str(error), "Correct agent.toml.")
            return
        yield ok("link", "the agent is running; its link is not tested")


def _connect(
    store: IdentityStore, configuration: AgentConfig, pairing: Pairing, clock: CloudClock
) -> Iterator[Finding]:
    journal = Journal(store.journal)
    journal.open(now_ms=wall_ms())
    pins = PinnedKeys(pairing, identity=store.private_key(), save=store.save_pairing, now_ms=clock.now_ms)
    monitor = pairing_monitor.PairingMonitor(pairing, configuration, catalogue.enrolled_devices(configuration), pins)
    transport = factory.make(
        factory.Wiring(
            configuration=configuration,
            pairing=pairing,
            pairing_monitor=monitor,
            open_api=lambda: bootstrap.cloud_client(store, configuration, clock),
            next_session=journal.next_session,
            quiet=lambda: True,
            certificate=ClientCertificate(store.folder),
            now_ms=clock.now_ms,
        )
    )
    up = threading.Event()
    with _WarningCapture() as warnings:
        started_ms = tick_ms()
        transport.start(lambda _topic, _payload: None, lambda is_up: up.set() if is_up else None)
        connected = up.wait(_LINK_S)
        duration_ms = tick_ms() - started_ms
        transport.stop()
    journal.close()
    if connected:
        yield ok("link", f"{configuration.transport}: connected in {duration_ms} ms with the agent's credentials")
    else:
        yield problem(
            "link",
            f"{configuration.transport}: no link within {_LINK_S:.0f} s{warnings.last}",
            "The server responds, but the message broker does not. Check that it runs and that no firewall blocks it; "
            'if only HTTP is allowed, set `transport = "http"` in agent.toml.',
        )


class _WarningCapture(logging.Handler):
    """Captures the last warning of the transports and keeps it from the terminal, inside a ``with`` block."""

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
