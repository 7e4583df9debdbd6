"""What is wrong with a run, in words: one sentence per symptom, with the figure, its healthy range and where to look.

`RULES` is the one place that has the healthy ranges; the table in ``docs/metrics.md`` is `page()`. A rule reads a
`History`: the rows of ``metrics.csv``, the configuration and one evaluation. Among the runs of the preset ``laptop``
below ``experiments/results``, the bounds separate those that walk from those that do not; `Rule.evidence` names them.
Where no run shows the fault, the bound lies beyond all that the runs reach, and the evidence says so.

Rules whose figure is missing in a history are not checked, and the report names them.
"""

from fmpjax.diagnose.history import History, Missing, newest, read
from fmpjax.diagnose.rules import RULES, Range, Rule
from fmpjax.diagnose.sentences import SETTLED, page, report, symptoms, text

__all__ = [
    "RULES",
    "SETTLED",
    "History",
    "Missing",
    "Range",
    "Rule",
    "newest",
    "page",
    "read",
    "report",
    "symptoms",
    "text",
]
