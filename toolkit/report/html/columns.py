"""The columns of the page's table: every metric as its record describes it, those of the other tables first."""

from typing import Any

from toolkit.metrics import known_metrics


def columns_of(keys_present: set[str]) -> list[dict[str, Any]]:
    """Return a column for each metric that the runs have, and for each key that no metric here declares."""
    present = [metric for metric in known_metrics() if metric.key in keys_present]
    usual = [metric for metric in present if metric.table != "on request"]
    columns = [
        {
            "key": metric.key,
            "name": metric.name,
            "unit": metric.unit,
            "decimals": metric.decimals,
            "meaning": metric.meaning,
            "best": metric.best,
            "usual": metric in usual,
            "usual_over_seeds": metric.over_seeds,
        }
        for metric in (*usual, *(metric for metric in present if metric not in usual))
    ]
    return [*columns, *(_undeclared(key) for key in sorted(keys_present - {metric.key for metric in present}))]


def _undeclared(key: str) -> dict[str, Any]:
    """Return the column of a metric that the runs have and this installation does not know."""
    words = {"key": key, "name": key, "unit": "", "decimals": 3, "meaning": "", "best": ""}
    return {**words, "usual": False, "usual_over_seeds": False}
