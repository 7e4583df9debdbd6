"""Learning curves: what a panel shows."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from fmpjax.viz import curves


@pytest.mark.parametrize(("values", "span"), [(0.05, 0.01), (0.0, 0.001)])
def test_a_constant_is_a_line_in_the_middle(values, span):
    """Rounding, for example of the running mean, does not fill the panel."""
    panel = Figure().subplots()
    course = np.full(200, values) * (1 + 1e-9 * np.sin(np.arange(200)))
    curves._draw(panel, "ppo/deviation", np.arange(200.0), course)
    low, high = panel.get_ylim()
    assert high - low >= span and low < values < high
