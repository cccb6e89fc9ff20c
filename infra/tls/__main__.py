"""``python -m infra.tls``: create, renew or import the certificates of a site; prints names and expiry."""

import argparse
import datetime as dt
import os
import sys
from pathlib import Path

from device_agent.protocol.security import private_folder
from infra.tls import agent_ca, server_ca
from infra.tls.server_ca import TlsError

_BAD_INPUT = 2


def main() -> int:
    """Run the command; returns the exit code."""
    os.umask(private_folder.UMASK)
    options = _arguments()
    now = dt.datetime.now(dt.UTC)
    try:
        if options.renew:
            server_ca.renew(options.home, now=now)
        elif options.devices:
            agent_ca.create(options.home, now=now)
            print(f"agents' CA certificate: {options.home / agent_ca.CA_CERTIFICATE}")
            return 0
        elif options.certificate:
            server_ca.import_certificate(
                options.home, certificate=options.certificate, key=options.key, ca=options.ca, now=now
            )
        elif not options.show:
            server_ca.create(options.home, server_ca.names(tuple(options.name), tuple(options.address)), now=now)
        print(server_ca.describe(options.home, now=now))
        if (options.home / server_ca.CA_CERTIFICATE).exists():
            print(f"browsers and agents must trust {options.home / server_ca.CA_CERTIFICATE}")
        if options.renew or options.certificate:
            print("restart the broker and the functions to use it")
    except TlsError as error:
        print(f"tls: {error}", file=sys.stderr)
        return _BAD_INPUT
    except OSError as error:
        print(f"tls: cannot use {error.filename or options.home}: {error.strerror}", file=sys.stderr)
        return _BAD_INPUT
    return 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m infra.tls", description="Certificates of a site.")
    parser.add_argument("--home", type=Path, required=True, help="folder for the certificates; created if missing")
    parser.add_argument("--name", action="append", default=[], help="DNS name of the site; may be given several times")
    parser.add_argument(
        "--address", action="append", default=[], help="IP address of the site; may be given several times"
    )
    parser.add_argument("--renew", action="store_true", help="issue a new certificate for the same names")
    parser.add_argument("--show", action="store_true", help="only show the current certificate")
    parser.add_argument(
        "--devices", action="store_true", help="create a CA for client certificates of agents (mosquitto)"
    )
    parser.add_argument("--certificate", type=Path, metavar="FILE", help="use this one, with its chain (PEM)")
    parser.add_argument("--key", type=Path, metavar="FILE", help="the key of --certificate (PEM, without a password)")
    parser.add_argument("--ca", type=Path, metavar="FILE", help="the CA of --certificate, if it is private")
    options = parser.parse_args()
    if bool(options.certificate) != bool(options.key) or (options.ca and not options.certificate):
        parser.error("--certificate and --key must be given together; --ca needs --certificate")
    return options


if __name__ == "__main__":
    sys.exit(main())
