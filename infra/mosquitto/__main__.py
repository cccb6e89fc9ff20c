"""``python -m infra.mosquitto``: run mosquitto behind HAProxy until SIGTERM or SIGINT.

Prints ``ready tcp=PORT websocket=PORT`` once both servers accept connections. Exit codes: 0 on a signal; 3 if a port
is in use or a server is not installed; 2 if the folder cannot be used; 1 if a server exits. Errors print one line.
"""

import argparse
import os
import resource
import sys
from pathlib import Path

from device_agent.protocol.security import private_folder
from infra import programs, service_user
from infra.mosquitto import admission, configuration
from infra.mosquitto.admission import Admission, Limits, Tls

_MAX_CONNECTIONS = 10_000


def main() -> int:
    """Run mosquitto; returns the exit code."""
    os.umask(private_folder.UMASK)
    arguments = _arguments()
    home, user, tls = arguments.home, service_user.choose("mosquitto"), _tls(arguments)
    try:
        # On IPv6 mosquitto's WebSocket listener cannot be bound to one address.
        host = programs.address(arguments.host)
        mosquitto, plugin, haproxy = configuration.binary(), configuration.plugin(), admission.binary()
        internal = (programs.LOOPBACK, 0)
        ports = programs.free_ports((host, arguments.tcp_port), (host, arguments.websocket_port), internal, internal)
        mqtt, websocket = admission.Route(ports[0], ports[2]), admission.Route(ports[1], ports[3])
        limits = _allow_connections(arguments.max_connections)
        configuration.write(
            home,
            tcp_port=mqtt.internal,
            websocket_port=websocket.internal,
            plugin_path=plugin,
            max_connections=limits.clients,
            user=user,
            require_certificate=arguments.agents_ca is not None,
        )
        gate = Admission(home, tls, user)
        gate.write(host=host, mqtt=mqtt, websocket=websocket, limits=limits)
    except (programs.NotInstalledError, programs.PortTakenError, OSError) as error:
        return programs.explain(error, server="mosquitto", host=arguments.host, home=home)
    if user.notice:
        programs.print_error(user.notice)
    return programs.supervise(
        programs.Server(
            "mosquitto", [mosquitto, "-c", configuration.CONFIGURATION_FILE], programs.LOOPBACK, ports[2:], folder=home
        ),
        gate.server(haproxy, host, ports[:2]),
        ready=f"ready tcp={mqtt.public} websocket={websocket.public}",
        watched=arguments.revoked,
        refresh=gate.update_revoked,
        user=user.ids,
    )


def _allow_connections(requested: int) -> Limits:
    """Allow the open files for this number of clients of each listener, or for as many as possible."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    limits = admission.limits(requested, None if hard == resource.RLIM_INFINITY else hard)
    resource.setrlimit(resource.RLIMIT_NOFILE, (limits.files, hard))
    return limits


def _tls(arguments: argparse.Namespace) -> Tls | None:
    if arguments.certificate is None:
        return None
    return Tls(arguments.certificate, arguments.certificate_key, arguments.agents_ca, arguments.revoked)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m infra.mosquitto", description="The site's MQTT broker.")
    parser.add_argument("--home", type=Path, required=True, help="folder for its files; created if missing")
    parser.add_argument("--host", default="127.0.0.1", help="IPv4 address or name to listen on (default: loopback)")
    parser.add_argument("--tcp-port", type=int, required=True, help="MQTT; 0 selects a free port")
    parser.add_argument("--websocket-port", type=int, required=True, help="MQTT over WebSocket; 0 selects a free port")
    parser.add_argument("--certificate", type=Path, help="use TLS only, with this certificate and its chain (PEM)")
    parser.add_argument("--certificate-key", type=Path, help="its key (PEM)")
    parser.add_argument("--agents-ca", type=Path, help="require client certificates of this CA on TCP (PEM)")
    parser.add_argument(
        "--max-connections",
        type=int,
        default=_MAX_CONNECTIONS,
        help="connections of each listener; limited by the open files that the system allows (default: %(default)s)",
    )
    parser.add_argument("--revoked", type=Path, help="revoked client certificates (CRL, PEM); reloaded on change")
    arguments = parser.parse_args()
    if (arguments.agents_ca and not arguments.certificate) or (arguments.revoked and not arguments.agents_ca):
        parser.error("--agents-ca needs --certificate, --revoked needs --agents-ca")
    if bool(arguments.certificate) != bool(arguments.certificate_key):
        parser.error("--certificate and --certificate-key must be given together")
    if arguments.max_connections < 1:
        parser.error("--max-connections must be 1 or more")
    return arguments


if __name__ == "__main__":
    sys.exit(main())
