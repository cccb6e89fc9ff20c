"""``python -m infra.tls``: make, renew or take in the certificates of a site. Prints what for and until when."""

import argparse
import datetime as dt
import sys
from pathlib import Path

from infra.tls import agent_ca, server_ca
from infra.tls.server_ca import TlsError

_BAD_INPUT = 2


def main() -> int:
    """Run; the exit code."""
    options = _arguments()
    now = dt.datetime.now(dt.UTC)
    try:
        if options.renew:
            server_ca.renew(options.home, now=now)
        elif options.devices:
            agent_ca.make(options.home, now=now)
            print(f"agents are vouched for by {options.home / agent_ca.CA_CERTIFICATE}")
            return 0
        elif options.certificate:
            server_ca.take(options.home, certificate=options.certificate, key=options.key, ca=options.ca, now=now)
        elif not options.show:
            server_ca.make(options.home, server_ca.names(tuple(options.name), tuple(options.address)), now=now)
        print(server_ca.describe(options.home, now=now))
        if (options.home / server_ca.CA_CERTIFICATE).exists():
            print(f"browsers and agents are to trust {options.home / server_ca.CA_CERTIFICATE}")
        if options.renew or options.certificate:
            print("restart broker and functions, which read it at their start")
    except TlsError as error:
        print(f"tls: {error}", file=sys.stderr)
        return _BAD_INPUT
    except OSError as error:
        print(f"tls: cannot use {error.filename or options.home}: {error.strerror}", file=sys.stderr)
        return _BAD_INPUT
    return 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m infra.tls", description="Certificates of a site.")
    parser.add_argument("--home", type=Path, required=True, help="folder for them; made when it is not there")
    parser.add_argument("--name", action="append", default=[], help="DNS name of the site; may be given several times")
    parser.add_argument("--address", action="append", default=[], help="its address; may be given several times")
    parser.add_argument("--renew", action="store_true", help="a new certificate for the same names")
    parser.add_argument("--show", action="store_true", help="only say what is there")
    parser.add_argument("--devices", action="store_true", help="an authority for agents, where mosquitto wants theirs")
    parser.add_argument("--certificate", type=Path, metavar="FILE", help="use this one, with its chain (PEM)")
    parser.add_argument("--key", type=Path, metavar="FILE", help="the key of --certificate (PEM, without a password)")
    parser.add_argument("--ca", type=Path, metavar="FILE", help="the authority of --certificate, if it is private")
    found = parser.parse_args()
    if bool(found.certificate) != bool(found.key) or (found.ca and not found.certificate):
        parser.error("certificates from elsewhere need --certificate and --key, and --ca if their authority is private")
    return found


if __name__ == "__main__":
    sys.exit(main())
