"""A constraint for ``mink``: only motions that the robot's own joints can make, with all that they carry."""

import mink
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


class Holding(mink.Task):  # type: ignore[misc]  # it has no types
    """No motion along some directions of the whole model.

    Args:
        rows: The directions, shape (k, nv).
    """

    def __init__(self, rows: Floats) -> None:
        super().__init__(cost=np.ones(len(rows)))
        self._rows = rows

    def compute_error(self, configuration: mink.Configuration) -> Floats:
        """See ``mink.Task``: none, for it begins where all is together."""
        del configuration
        return np.zeros(len(self._rows))

    def compute_jacobian(self, configuration: mink.Configuration) -> Floats:
        """See ``mink.Task``."""
        del configuration
        return self._rows
