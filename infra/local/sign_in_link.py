"""``make link``: print another one-time sign-in link for the product that ``make up`` started."""

import os
import sys
from typing import NoReturn

from infra.local import settings
from infra.local.settings import SettingsError


def main() -> NoReturn:
    """Replace this process by the program that prints the link; exits with an error if the settings are invalid."""
    try:
        started = settings.read(settings.load_started(os.environ))
    except SettingsError as error:
        sys.exit(f"telescope: {error}")
    command = [sys.executable, "-m", "function_app", "sign-in-link", *sys.argv[1:]]
    os.execve(sys.executable, command, started.environment())  # noqa: S606  # nosec B606 (fixed command)


if __name__ == "__main__":
    main()
