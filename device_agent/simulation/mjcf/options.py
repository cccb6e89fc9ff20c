"""One set of options for all parts of a model."""

from typing import Any

import numpy as np


def agree(child: Any, parent: Any) -> None:
    """Give one part of a model the options of another: MuJoCo warns, aloud, of each that differs."""
    for name in dir(parent):
        value = getattr(parent, name)
        if name.startswith("_") or callable(value):
            continue
        if isinstance(value, np.ndarray):
            getattr(child, name)[:] = value
        elif isinstance(value, int | float):
            setattr(child, name, value)
        else:
            agree(getattr(child, name), value)
