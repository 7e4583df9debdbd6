"""A trained policy for other programs: an ONNX file that says what it needs, and a card for the people who run it.

The graph takes ``obs [1, O]`` and gives ``actions [1, J]``, both float32. Normalization and limits are inside. A joint
target (rad) is ``action_offset + action_scale * actions``. The file's metadata has mjlab's keys, with every digit, and
our own; docs/deploy.md lists them. A list is text with commas, its inner lists with semicolons; points are JSON.
"""

from fmpjax.deploy.files import check_installed, write
from fmpjax.deploy.model_card import card, unmeasured
from fmpjax.deploy.network import check_widths, graph
from fmpjax.deploy.origin import Origin
from fmpjax.deploy.properties import metadata
from fmpjax.deploy.unitree import no_stock, stock
from fmpjax.deploy.web import write_page

__all__ = [
    "Origin",
    "card",
    "check_installed",
    "check_widths",
    "graph",
    "metadata",
    "no_stock",
    "stock",
    "unmeasured",
    "write",
    "write_page",
]
