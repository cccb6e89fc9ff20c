"""A ``mink`` constraint: only motions that the robot's own joints can make."""

import mink
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


class FixedDirections(mink.Task):  # type: ignore[misc]  # it has no types
    """Forbids motion along some directions of the whole model.

    Args:
        rows: The directions, shape (k, nv).
    """

    def __init__(self, rows: Floats) -> None:
        super().__init__(cost=np.ones(len(rows)))
        self._rows = rows

    def compute_error(self, configuration: mink.Configuration) -> Floats:
        """See ``mink.Task``; 0, because the start satisfies the constraint."""
        del configuration
        return np.zeros(len(self._rows))

    def compute_jacobian(self, configuration: mink.Configuration) -> Floats:
        """See ``mink.Task``."""
        del configuration
        return self._rows
