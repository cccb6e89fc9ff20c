"""Reads typed values from environment variables."""

import re
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import urlsplit

IDENTITY = re.compile(r"\A([0-9A-Fa-f]{8}(-[0-9A-Fa-f]{4}){3}-[0-9A-Fa-f]{12})?\Z")
_NUMBER = re.compile(r"\A[0-9]{1,9}\Z")
_HOST = re.compile(r"\A[A-Za-z0-9._:%-]{1,255}\Z")
_REGION = re.compile(r"\A[a-z]{2,}(-[a-z]+)+-[0-9]+\Z")
_LAST_PORT = 65_535
_MAX_SHOWN = 80
"""Characters of an invalid value in an error message."""


class SettingsError(Exception):
    """A setting is invalid. The text names the variable and the values that it accepts."""


class Environment:
    """Environment variables with validation. Every method raises ``SettingsError`` for an invalid value."""

    def __init__(self, variables: Mapping[str, str]) -> None:
        self._variables = variables

    def get(self, name: str, default: str = "") -> str:
        """The text of a variable, unchecked."""
        return self._variables.get(name, default)

    def invalid(self, name: str, expected: str, default: str = "") -> SettingsError:
        """The error for an invalid variable."""
        shown = " ".join(self.get(name, default)[:_MAX_SHOWN].split())  # on one line
        return SettingsError(f"{name} is '{shown}'; it must be {expected}")

    def matching(self, name: str, default: str, pattern: re.Pattern[str], expected: str) -> str:
        """A text that matches ``pattern``."""
        text = self.get(name, default)
        if not pattern.match(text):
            raise self.invalid(name, expected, default)
        return text

    def identity(self, name: str) -> str:
        """Client id of a managed identity. Empty for the identity of the host."""
        return self.matching(name, "", IDENTITY, "the client id of a managed identity")

    def host(self, name: str, default: str) -> str:
        """An address or name. Never empty, which would mean every address of the machine."""
        return self.matching(name, default, _HOST, "an address or name, such as 127.0.0.1")

    def port(self, name: str, default: int) -> int:
        """A TCP port."""
        return self.number(name, default, 1, _LAST_PORT)

    def number(self, name: str, default: int, least: int, most: int) -> int:
        """A whole number in a range."""
        text = self.get(name, str(default))
        if not _NUMBER.match(text) or not least <= int(text) <= most:
            raise self.invalid(name, f"a number from {least} to {most}")
        return int(text)

    def folder(self, name: str, default: Path) -> Path:
        """An absolute path. ``~`` is expanded."""
        text = self.get(name, str(default))
        try:
            if text:
                return Path(text).expanduser().resolve()
        except (OSError, RuntimeError, ValueError) as error:
            raise SettingsError(f"{name} is '{text[:_MAX_SHOWN]}'; it must be a folder ({error})") from error
        raise SettingsError(f"{name} is empty; it must be a folder")

    def file(self, name: str) -> Path:
        """Path of a file that exists."""
        path = self.folder(name, Path())
        if not path.is_file():
            raise self.invalid(name, "a file: make one with `python -m infra.tls`")
        return path

    def url(self, name: str, default: str, schemes: tuple[str, ...]) -> str:
        """A URL with one of these schemes and a host."""
        text = self.get(name, default)
        try:
            parts = urlsplit(text)
            valid = parts.scheme in schemes and bool(parts.hostname) and (parts.port is None or parts.port > 0)
        except ValueError:
            valid = False
        if not valid or any(letter.isspace() or letter in ";,'\"" for letter in text):
            raise self.invalid(
                name, f"an address that begins with {' or '.join(f'{each}://' for each in schemes)}", default
            )
        return text

    def region(self) -> str:
        """The AWS region. Lambda sets ``AWS_REGION``."""
        return self.matching("TELESCOPE_AWS_REGION", self.get("AWS_REGION"), _REGION, "a region, such as eu-west-1")

    def aws_endpoint(self) -> str | None:
        """URL of an AWS emulator; ``None`` for AWS itself."""
        name = "TELESCOPE_AWS_ENDPOINT"
        return self.url(name, "", ("http", "https")) if name in self._variables else None
