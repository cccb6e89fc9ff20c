"""What a swarm is to be, as the command line says it."""

import argparse
import os
import re
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from device_agent.protocol.manifests.robot_type import MAX_JOINTS
from device_agent.protocol.topics import ID_PATTERN

MOST_AGENTS = 20_000
MOST_HZ = 50.0
"""Telemetry's most, as of any robot."""
_LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})


class LoadTestError(Exception):
    """The swarm cannot begin. Its text is one line that says what to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadOptions:
    """One run.

    Attributes:
        cloud: Base address of the server.
        broker: The one other host that may be spoken to; empty: none.
        ca: The authority that alone may speak for an ``https`` server.
        count: Agents.
        rate_hz: Measurements of each in a second.
        joints: Of each arm.
        type: Id of the robot type that they say they are.
        seconds: How long the run takes, from the first connection on.
        spread_s: Over which time the agents connect.
        home: Folder of their keys.
        sign_in: A one-time sign-in link; ``token``: an access token.
        json: Where the figures go; ``None``: to the terminal alone.
        every_s: A line each so many seconds.
    """

    cloud: str
    count: int = 100
    rate_hz: float = 5.0
    joints: int = 6
    type: str = "swarm-arm"
    seconds: float = 60.0
    spread_s: float = 10.0
    home: Path = Path(".telescope-swarm")
    broker: str = ""
    ca: Path | None = None
    sign_in: str = ""
    token: str = ""
    json: Path | None = None
    every_s: float = 5.0

    def check(self) -> None:
        """Refuse what cannot be run.

        Raises:
            LoadTestError: Which option, and what it may be.
        """
        parts = urlsplit(self.cloud)
        if parts.scheme not in {"http", "https"} or not parts.hostname:
            raise LoadTestError(f"--cloud: '{self.cloud}' is not an address like http://127.0.0.1:8080")
        if self.ca is not None and parts.scheme != "https":
            raise LoadTestError("--ca says who may speak for an https server; this one speaks http")
        if not re.fullmatch(ID_PATTERN, self.type):
            raise LoadTestError(f"--type: '{self.type}' is not {ID_PATTERN}")
        ranges: tuple[tuple[str, float, float, float], ...] = (
            ("--count", self.count, 1, MOST_AGENTS),
            ("--rate-hz", self.rate_hz, 0.01, MOST_HZ),
            ("--joints", self.joints, 1, MAX_JOINTS),
            ("--seconds", self.seconds, 1, 86_400),
            ("--spread-s", self.spread_s, 0, self.seconds),
        )
        for option, value, least, most in ranges:
            if not least <= value <= most:
                raise LoadTestError(f"{option}: {value:g} is not between {least:g} and {most:g}")

    def may_speak_to(self, host: str) -> bool:
        """Whether this host was named: as the server's, or as the broker's."""
        named = {urlsplit(self.cloud).hostname, self.broker} - {None, ""}
        return host in named or (host in _LOOPBACK and bool(named & _LOOPBACK))


def add_options(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument(
        "--cloud", required=True, metavar="URL", help="the server, http://host:port; nothing else is spoken to"
    )
    parser.add_argument("--broker", default="", metavar="HOST", help="the broker's host, where it is not the server's")
    parser.add_argument(
        "--ca", type=Path, metavar="FILE", help="the authority (PEM) that alone may speak for an https server"
    )
    parser.add_argument("--count", type=int, default=100, help="agents (default: %(default)s)")
    parser.add_argument(
        "--rate-hz", type=float, default=5.0, help="measurements of each in a second (default: %(default)g)"
    )
    parser.add_argument("--joints", type=int, default=6, help="joints of each arm (default: %(default)s)")
    parser.add_argument(
        "--type", default="swarm-arm", metavar="ID", help="robot type that they say they are (default: %(default)s)"
    )
    parser.add_argument(
        "--seconds", type=float, default=60.0, help="end by itself after this time (default: %(default)g)"
    )
    parser.add_argument(
        "--spread-s", type=float, default=10.0, metavar="S", help="connect over this time (default: %(default)g)"
    )
    parser.add_argument(
        "--sign-in",
        default=os.environ.get("TELESCOPE_SIGN_IN", ""),
        metavar="LINK",
        help="a one-time sign-in link of the account that claims new agents (or TELESCOPE_SIGN_IN; or an access token "
        "in TELESCOPE_TOKEN). API keys claim nothing",
    )
    parser.add_argument(
        "--home",
        type=Path,
        default=Path.home() / ".telescope-swarm",
        metavar="FOLDER",
        help="where the agents' keys are kept: the next run is the same robots (default: %(default)s)",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here too")
    parser.add_argument(
        "--every-s", type=float, default=5.0, metavar="S", help="print a line so often (default: %(default)g)"
    )


def parse_options(options: argparse.Namespace) -> LoadOptions:
    """What was asked for, checked.

    Raises:
        LoadTestError: An option is wrong.
    """
    plan = LoadOptions(
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
    plan.check()
    return plan
