"""Command-line options of the load test."""

import argparse
import os
import re
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from device_agent.protocol.manifests.robot_type import MAX_JOINTS
from device_agent.protocol.topics import ID_PATTERN

MAX_AGENTS = 20_000
MAX_HZ = 50.0
"""Maximum telemetry rate of a robot [Hz]."""
_LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})


class LoadTestError(Exception):
    """The load test cannot start. The message names the remedy."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadOptions:
    """Options of one run; see the help texts of ``add_options``. Without ``json``, results are only printed."""

    cloud: str
    count: int = 100
    rate_hz: float = 5.0
    joints: int = 6
    type: str = "load-test-arm"
    seconds: float = 60.0
    spread_s: float = 10.0
    home: Path = Path(".telescope-load-test")
    broker: str = ""
    ca: Path | None = None
    sign_in: str = ""
    token: str = ""
    json: Path | None = None
    every_s: float = 5.0

    def check(self) -> None:
        """Check the ranges.

        Raises:
            LoadTestError: An option is out of range; the message names it.
        """
        parts = urlsplit(self.cloud)
        if parts.scheme not in {"http", "https"} or not parts.hostname:
            raise LoadTestError(f"--cloud: '{self.cloud}' is not an address like http://127.0.0.1:8080")
        if self.ca is not None and parts.scheme != "https":
            raise LoadTestError("--ca needs an https server; an http server has no certificate")
        if not re.fullmatch(ID_PATTERN, self.type):
            raise LoadTestError(f"--type: '{self.type}' is not {ID_PATTERN}")
        ranges: tuple[tuple[str, float, float, float], ...] = (
            ("--count", self.count, 1, MAX_AGENTS),
            ("--rate-hz", self.rate_hz, 0.01, MAX_HZ),
            ("--joints", self.joints, 1, MAX_JOINTS),
            ("--seconds", self.seconds, 1, 86_400),
            ("--spread-s", self.spread_s, 0, self.seconds),
        )
        for option, value, lower, upper in ranges:
            if not lower <= value <= upper:
                raise LoadTestError(f"{option}: {value:g} is not between {lower:g} and {upper:g}")

    def may_connect_to(self, host: str) -> bool:
        """Whether the host was named as server or broker."""
        permitted = {urlsplit(self.cloud).hostname, self.broker} - {None, ""}
        return host in permitted or (host in _LOOPBACK and bool(permitted & _LOOPBACK))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument(
        "--cloud", required=True, metavar="URL", help="URL of the server; the test connects to no other host"
    )
    parser.add_argument(
        "--broker", default="", metavar="HOST", help="host of the broker, if it differs from the server's"
    )
    parser.add_argument("--ca", type=Path, metavar="FILE", help="certificate authority (PEM) of an https server")
    parser.add_argument("--count", type=int, default=100, help="number of agents (default: %(default)s)")
    parser.add_argument(
        "--rate-hz", type=float, default=5.0, help="telemetry rate per agent [Hz] (default: %(default)g)"
    )
    parser.add_argument("--joints", type=int, default=6, help="joints per arm (default: %(default)s)")
    parser.add_argument(
        "--type", default="load-test-arm", metavar="ID", help="robot type that the agents report (default: %(default)s)"
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="duration [s] (default: %(default)g)")
    parser.add_argument(
        "--spread-s", type=float, default=10.0, metavar="S", help="connect over this time [s] (default: %(default)g)"
    )
    parser.add_argument(
        "--sign-in",
        default=os.environ.get("TELESCOPE_SIGN_IN", ""),
        metavar="LINK",
        help="one-time sign-in link of the account that claims new agents (or TELESCOPE_SIGN_IN; or an access token in "
        "TELESCOPE_TOKEN). API keys cannot claim agents",
    )
    parser.add_argument(
        "--home",
        type=Path,
        default=Path.home() / ".telescope-load-test",
        metavar="FOLDER",
        help="folder of the agents' keys; the next run reuses the agents (default: %(default)s)",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the results to this file")
    parser.add_argument(
        "--every-s", type=float, default=5.0, metavar="S", help="interval of progress lines [s] (default: %(default)g)"
    )


def parse_options(options: argparse.Namespace) -> LoadOptions:
    """Convert and check parsed options.

    Raises:
        LoadTestError: An option is wrong.
    """
    load_options = LoadOptions(
        cloud=options.cloud,
        broker=options.broker,
        ca=options.ca,
        count=options.count,
        rate_hz=options.rate_hz,
        joints=options.joints,
        type=options.type,
        seconds=options.seconds,
        spread_s=min(options.spread_s, options.seconds / 2),
        home=options.home,
        sign_in=options.sign_in,
        token=os.environ.get("TELESCOPE_TOKEN", ""),
        json=options.json,
        every_s=max(options.every_s, 0.1),
    )
    load_options.check()
    return load_options
