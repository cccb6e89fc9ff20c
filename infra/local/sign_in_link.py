"""``make link``: another one-time sign-in link for what ``make up`` has started, as it was started."""

import os
import sys
from typing import NoReturn

from infra.local import settings
from infra.local.settings import SettingsError


def main() -> NoReturn:
    """Become the program that prints the link; exits with one line where it is not known how."""
    try:
        chosen = settings.read(settings.recall(os.environ))
    except SettingsError as error:
        sys.exit(f"telescope: {error}")
    command = [sys.executable, "-m", "function_app", "sign-in-link", *sys.argv[1:]]
    os.execve(sys.executable, command, chosen.environment())  # noqa: S606  # nosec B606 (our own program)


if __name__ == "__main__":
    main()
