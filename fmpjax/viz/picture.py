"""What draws: a context that yields a picture's function."""

from collections.abc import Callable

import numpy as np

# picture(configurations, look): uint8 [H, W, 3] of configurations [7 + J] seen by a camera that looks at look [3], m.
Picture = Callable[[list[np.ndarray], np.ndarray], np.ndarray]
