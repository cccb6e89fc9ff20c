"""``python -m infra.mosquitto``: run mosquitto until SIGTERM or SIGINT.

Prints ``ready tcp=PORT websocket=PORT`` once both listeners answer. Exits 0 when told to stop; 3 when a port is taken
or mosquitto is not installed, 2 when the folder cannot be used; 1 when mosquitto ends by itself. Each with one line.
"""

import argparse
import socket
import sys
from pathlib import Path

from infra import programs
from infra.mosquitto import configuration
from infra.mosquitto.configuration import Tls


def main() -> int:
    """Run; the exit code."""
    arguments = _arguments()
    home = arguments.home
    try:
        # On IPv6 mosquitto's listener for WebSocket cannot be kept to one address.
        host = programs.address(arguments.host)
        binary, plugin = configuration.binary(), configuration.plugin()
        tcp_port, websocket_port = programs.free_ports(host, arguments.tcp_port, arguments.websocket_port)
        configuration.write(
            home,
            host=host,
            tcp_port=tcp_port,
            websocket_port=websocket_port,
            plugin_path=plugin,
            tls=_tls(arguments),
        )
    except programs.NotInstalledError as error:
        print(f"broker: {error}", file=sys.stderr)
        return programs.CANNOT_START
    except programs.PortTakenError as error:
        print(f"broker: {error}; choose another port", file=sys.stderr)
        return programs.CANNOT_START
    except socket.gaierror:
        print(f"broker: '{arguments.host}' has no IPv4 address, which is what it listens on", file=sys.stderr)
        return programs.BAD_INPUT
    except OSError as error:
        print(f"broker: cannot use {error.filename or home}: {error.strerror}", file=sys.stderr)
        return programs.BAD_INPUT
    return programs.supervise(
        "mosquitto",
        [binary, "-c", str(home / configuration.CONFIGURATION_FILE)],
        host=host,
        ports=(tcp_port, websocket_port),
        ready=f"ready tcp={tcp_port} websocket={websocket_port}",
        watched=arguments.revoked,
    )


def _tls(arguments: argparse.Namespace) -> Tls | None:
    if arguments.certificate is None:
        return None
    return Tls(arguments.certificate, arguments.certificate_key, arguments.agents_ca, arguments.revoked)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m infra.mosquitto", description="The site's MQTT broker.")
    parser.add_argument("--home", type=Path, required=True, help="folder for its files; made when it is not there")
    parser.add_argument("--host", default="127.0.0.1", help="IPv4 address or name to listen on (default: loopback)")
    parser.add_argument("--tcp-port", type=int, required=True, help="MQTT; 0 takes a free one")
    parser.add_argument("--websocket-port", type=int, required=True, help="MQTT over WebSocket; 0 takes a free one")
    parser.add_argument("--certificate", type=Path, help="speak TLS alone, with this certificate and its chain (PEM)")
    parser.add_argument("--certificate-key", type=Path, help="its key (PEM)")
    parser.add_argument("--agents-ca", type=Path, help="over TCP let in only who shows a certificate of it (PEM)")
    parser.add_argument("--revoked", type=Path, help="which of them count no more (CRL, PEM); read again on change")
    found = parser.parse_args()
    if (found.agents_ca and not found.certificate) or (found.revoked and not found.agents_ca):
        parser.error("--agents-ca needs --certificate, --revoked needs --agents-ca")
    if bool(found.certificate) != bool(found.certificate_key):
        parser.error("--certificate and --certificate-key belong together")
    return found


if __name__ == "__main__":
    sys.exit(main())
