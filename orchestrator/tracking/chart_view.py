"""The page of charts that a sweep's experiment opens with: its sections, columns and charts.

Of its own, the UI draws one chart a metric. This view draws each cost of the training and the deployment
phase in one chart with its limit. On other pages their charts are neighbours, because a section is sorted by
name.
"""

from __future__ import annotations

import json
from typing import Any

from recrl.orchestrator.tracking.run_content import GROUP_TAG

VIEW = "recrl"  # key of the view
SECTIONS = ("final", "train", "curriculum", "deploy", "summary", "evaluation", "agent", "perf")
OVER_STEPS = ("deploy", "train")  # sections with cost_i and limit_i over environment steps, in sorted order


def charts_page(experiment_id: str) -> str:
    """Return the address of the sweep's charts, averaged over seeds, after the ``#`` of the UI's address."""
    page = f"/experiments/{experiment_id}/runs?viewStateShareKey={VIEW}"
    return f"{page}&compareRunsMode=CHART&workflowType=machine_learning"


def view_tag(num_costs: int) -> dict[str, str]:
    """Return the tag of the experiment that holds the view.

    Args:
        num_costs: largest number of costs of a task.
    """
    return {f"mlflow.sharedViewState.{VIEW}": json.dumps(_view(num_costs))}


def _view(num_costs: int) -> dict[str, Any]:
    """Return the UI's own state, in its own words (MLflow 3.17; undocumented: links without it must work)."""
    shown_metrics = ("final/return", "final/cost_0", "final/limit_0")
    return {
        "groupBy": {
            "aggregateFunction": "average",
            "groupByKeys": [{"mode": "tag", "groupByData": GROUP_TAG}],
        },
        "runsHiddenMode": "SHOW_ALL",
        "selectedColumns": [
            *(f"params.`{name}`" for name in ("task", "agent", "method")),
            *(f"metrics.`{name}`" for name in shown_metrics),
            "tags.`recrl.verdict`",
        ],
        "compareRunCharts": [
            chart for section in OVER_STEPS for i in range(num_costs) for chart in _cost_charts(section, i)
        ],
        "compareRunSections": [
            {
                "uuid": f"recrl-{name}",
                "name": name,
                "display": True,
                "isReordered": False,
                "deleted": False,
                "isGenerated": True,
            }
            for name in SECTIONS
        ],
        "isAccordionReordered": True,
    }


def _cost_charts(section: str, i: int) -> list[dict[str, Any]]:
    """Return the chart of cost i with its limit, and the deletion of the limit's own chart."""
    cost, limit = f"{section}/cost_{i}", f"{section}/limit_{i}"
    both = _chart(section, cost, deleted=False) | {"selectedMetricKeys": [cost, limit]}
    return [both, _chart(section, limit, deleted=True)]


def _chart(section: str, metric: str, *, deleted: bool) -> dict[str, Any]:
    """Return the UI's line chart of a metric, with the UI's own settings."""
    return {
        "type": "LINE",
        "uuid": f"recrl-{metric}",
        "metricSectionId": f"recrl-{section}",
        "metricKey": metric,
        "deleted": deleted,
        "isGenerated": False,
        "runsCountToCompare": 10,
        "lineSmoothness": 0,
        "xAxisScaleType": "linear",
        "scaleType": "linear",
        "xAxisKey": "step",
        "selectedXAxisMetricKey": "",
        "yAxisKey": "metric",
        "yAxisExpressions": [],
        "range": {},
        "ignoreOutliers": False,
        "useGlobalXaxisKey": True,
        "useGlobalLineSmoothing": True,
    }
