"""The file of outcomes and the words of its verdicts, which the report and MLflow share.

The analysis writes the file; ``tracking.final_outcomes`` reads it and does not import the analysis.
"""

from __future__ import annotations

OUTCOMES_FILE = "outcomes.csv"  # in the sweep's figures folder
VERDICT_MEASURE = "stochastic"  # value of its column ``measure`` in the rows that verdicts are made from
SOLVED, FEASIBLE, INFEASIBLE = "solved", "feasible", "infeasible"
