"""Modules that scripts may import. The zygote imports them once, because script processes cannot open files."""

import contextlib
import importlib
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

_LISTED_TEXT = """
abc array ast base64 binascii bisect calendar cmath collections colorsys contextlib copy csv dataclasses
datetime decimal difflib enum fractions functools graphlib hashlib heapq hmac inspect io itertools json logging
math numbers numpy operator os pprint queue random re secrets signal statistics string struct sys textwrap
threading time traceback types typing unicodedata uuid warnings weakref zlib
"""
LISTED = _LISTED_TEXT.split()
"""Modules that error messages list."""
_LAZY = """
_strptime collections.abc concurrent.futures ctypes encodings.ascii encodings.cp1252 encodings.idna
encodings.latin_1 encodings.utf_16 encodings.utf_32 encodings.utf_8_sig importlib.abc importlib.util linecache
numpy.fft numpy.lib.recfunctions numpy.linalg numpy.ma numpy.polynomial numpy.random pickle platform select
socket stringprep tokenize
"""
"""Modules that the listed ones import lazily."""


def load() -> None:
    """Import all modules. Modules that this Python lacks (for example NumPy) are missing in scripts too."""
    for name in (*LISTED, *_LAZY.split()):
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    sys.meta_path.append(LastFinder)


class LastFinder:
    """Last finder of the import system: its error lists the importable modules."""

    @staticmethod
    def find_spec(name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Always fails.

        Raises:
            ModuleNotFoundError: For a top-level module. Python itself reports missing submodules.
        """
        if path is None and target is None:
            known = ", ".join(module for module in LISTED if module in sys.modules)
            raise ModuleNotFoundError(f"a script cannot import '{name}'; it can import {known}", name=name)
        return None
