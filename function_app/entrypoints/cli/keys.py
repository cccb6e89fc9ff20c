"""Rotates the signing keys."""

import argparse
from typing import Any

from function_app.bootstrap import Functions
from function_app.domain.audit.hash_chain import CLOUD, AccountEvent
from function_app.domain.common.timestamps import rfc3339
from function_app.entrypoints.cli import with_functions
from function_app.ports.signing_keys import LEARN_MS, OVERLAP_MS, RotationRefused
from function_app.settings import SettingsError

_MINUTE_MS = 60_000
_HOUR_MS = 60 * _MINUTE_MS
_MIN_LEARN_MINUTES = 65
_MIN_OVERLAP_HOURS = 24


def add_commands(commands: Any) -> None:
    """Add ``rotate-keys``."""
    text = "create a new signing key; the current key stays valid for an overlap period"
    rotate = commands.add_parser("rotate-keys", help=text, description=text)
    rotate.add_argument(
        "--learn-minutes",
        type=int,
        default=LEARN_MS // _MINUTE_MS,
        metavar="N",
        help=f"start signing commands with the new key after N minutes (default: %(default)s; at least "
        f"{_MIN_LEARN_MINUTES})",
    )
    rotate.add_argument(
        "--overlap-hours",
        type=int,
        default=OVERLAP_MS // _HOUR_MS,
        metavar="N",
        help=f"accept the current key for N more hours (default: %(default)s; at least {_MIN_OVERLAP_HOURS})",
    )
    rotate.add_argument(
        "--leaked",
        action="store_true",
        help="end the current key immediately; all users must sign in again and all agents must repin",
    )
    rotate.set_defaults(run=with_functions(_rotate))


async def _rotate(functions: Functions, options: argparse.Namespace) -> None:
    learn_ms, overlap_ms = options.learn_minutes * _MINUTE_MS, options.overlap_hours * _HOUR_MS
    if options.learn_minutes < _MIN_LEARN_MINUTES or options.overlap_hours < _MIN_OVERLAP_HOURS:
        raise SettingsError(
            f"--learn-minutes must be {_MIN_LEARN_MINUTES} or more (agents fetch keys once per hour), --overlap-hours "
            f"{_MIN_OVERLAP_HOURS} or more (sign-in sessions last 12 h)"
        )
    if learn_ms >= overlap_ms:
        raise SettingsError("--learn-minutes must be less than --overlap-hours")
    try:
        rotated = await functions.keys.rotate(learn_ms=learn_ms, overlap_ms=overlap_ms, leaked=options.leaked)
    except RotationRefused as error:
        raise SettingsError(
            f"agents fetch the previous new key until {rfc3339(error.until_ms)}; wait until then, or use --leaked"
        ) from error
    new = rotated.pins[-1]
    await functions.audit_log.record(CLOUD, AccountEvent.SIGNING_KEY_ROTATED, None, on=new.id, leaked=options.leaked)
    print(f"new key {new.id}, number {new.serial}")
    if options.leaked:
        print("all previous keys have ended; sign in again, and run `python -m device_agent repin` on every agent")
    else:
        ends_ms = max(pin.until_ms for pin in rotated.pins)
        print(f"commands are signed with it in {options.learn_minutes} minutes; agents fetch it until then")
        print(
            f"the previous key is accepted until {rfc3339(ends_ms)}; an agent that is offline until then must `repin`"
        )
