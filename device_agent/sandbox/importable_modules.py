"""What a script may import: read by the warm parent once, since the script's own process opens no file."""

import contextlib
import importlib
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

_SHOWN = """
abc array ast base64 binascii bisect calendar cmath collections colorsys contextlib copy csv dataclasses
datetime decimal difflib enum fractions functools graphlib hashlib heapq hmac inspect io itertools json logging
math numbers numpy operator os pprint queue random re secrets signal statistics string struct sys textwrap
threading time traceback types typing unicodedata uuid warnings weakref zlib
"""
SHOWN = _SHOWN.split()
"""Modules that are named to somebody who asked for another."""
_BEHIND = """
_strptime collections.abc concurrent.futures ctypes encodings.ascii encodings.cp1252 encodings.idna
encodings.latin_1 encodings.utf_16 encodings.utf_32 encodings.utf_8_sig importlib.abc importlib.util linecache
numpy.fft numpy.lib.recfunctions numpy.linalg numpy.ma numpy.polynomial numpy.random pickle platform select
socket stringprep tokenize
"""
"""Modules that those import when one of their functions is first called."""


def load() -> None:
    """Import all of them; one that this Python lacks (NumPy, say) is missing in scripts too."""
    for name in (*SHOWN, *_BEHIND.split()):
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    sys.meta_path.append(LastFinder)


class LastFinder:
    """Asked when no module was found: says which there are."""

    @staticmethod
    def find_spec(name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Never finds one.

        Raises:
            ModuleNotFoundError: For a whole module; its submodules are looked for and missed by Python itself.
        """
        if path is None and target is None:
            known = ", ".join(module for module in SHOWN if module in sys.modules)
            raise ModuleNotFoundError(f"a script cannot import '{name}'; it can import {known}", name=name)
        return None
