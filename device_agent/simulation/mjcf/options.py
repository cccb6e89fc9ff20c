"""Copies options between model parts."""

from typing import Any

import numpy as np


def copy_options(child: Any, parent: Any) -> None:
    """Copy options from one model part to another; MuJoCo warns of each difference."""
    for name in dir(parent):
        value = getattr(parent, name)
        if name.startswith("_") or callable(value):
            continue
        if isinstance(value, np.ndarray):
            getattr(child, name)[:] = value
        elif isinstance(value, int | float):
            setattr(child, name, value)
        else:
            copy_options(getattr(child, name), value)
