# SPDX-License-Identifier: Apache-2.0
"""Array types of the suite; shape, unit and frame are in the docstrings of their users."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]
