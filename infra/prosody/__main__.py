"""``python -m infra.prosody``: run Prosody until SIGTERM or SIGINT.

Prints ``ready xmpp=PORT`` once it accepts connections, with ``websocket=PORT`` if it serves browsers. Exit codes: 0 on
a signal; 3 if the port is in use or Prosody is not installed; 2 if an argument or the folder is invalid; 1 if Prosody
exits. Errors print one line.
"""

import argparse
import os
import sys
from pathlib import Path

from device_agent.protocol.security import private_folder
from infra import programs, service_user
from infra.prosody import configuration


def main() -> int:
    """Run Prosody; returns the exit code."""
    os.umask(private_folder.UMASK)
    arguments = _arguments()
    home, user = arguments.home, service_user.choose("prosody")
    try:
        host = programs.address(arguments.host)
        binary = configuration.binary()
        asked = [port for port in (arguments.port, arguments.websocket_port) if port is not None]
        ports = programs.free_ports(*((host, port) for port in asked))
        configuration.write(
            home,
            domain=arguments.domain,
            host=host,
            port=ports[0],
            websocket_port=ports[1] if ports[1:] else None,
            verify_url=arguments.verify_url,
            certificate=arguments.certificate,
            key=arguments.key,
            user=user,
        )
    except (programs.NotInstalledError, programs.PortTakenError, OSError, configuration.ConfigurationError) as error:
        return programs.explain(error, server="Prosody", host=arguments.host, home=home)
    if user.notice:
        programs.print_error(user.notice)
    command = [binary, "--config", f"./{configuration.CONFIGURATION_FILE}", "-F"]
    server = programs.Server("prosody", command, host, tuple(ports), folder=home)
    named = " ".join(f"{name}={port}" for name, port in zip(("xmpp", "websocket"), ports, strict=False))
    return programs.supervise(server, ready=f"ready {named}", user=user.ids)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m infra.prosody", description="The site's XMPP server.")
    parser.add_argument("--home", type=Path, required=True, help="folder for its files; created if missing")
    parser.add_argument("--domain", required=True, help="domain of all addresses, in lower case")
    parser.add_argument("--verify-url", required=True, help="the functions' …/api/v1/xmpp/verify")
    parser.add_argument("--host", default="127.0.0.1", help="IPv4 address or name to listen on (default: loopback)")
    parser.add_argument(
        "--port", type=int, default=5222, help="for clients; 0 selects a free port (default: %(default)s)"
    )
    parser.add_argument("--websocket-port", type=int, help="for browsers; 0 selects a free port (default: no browsers)")
    parser.add_argument(
        "--certificate", type=Path, help="of the domain, with its chain (PEM); required except on loopback"
    )
    parser.add_argument("--key", type=Path, help="the certificate's private key (PEM)")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
