"""The columns of the report's table: every metric with its name, unit, decimals and meaning, and what is best in it."""

from typing import Any, Literal

from toolkit.metrics import describe
from toolkit.report.table import COLUMNS

Best = Literal["least", "most", "one", ""]

_NAMES = {
    "ate_none_m": "ATE, first pose placed",
    "ate_sim3_m": "ATE Sim(3)",
    "ate_se3_deg": "ATE rotation SE(3)",
    "rpe_1s_m": "RPE 1 s",
    "rpe_1s_deg": "RPE 1 s rotation",
    "kitti_r_deg_per_m": "KITTI rot",
    "reproj_rmse_px": "reproj own RMSE",
    "heldout_reproj_rmse_px": "reproj held-out RMSE",
    "nees_pose_mean": "NEES pose",
    "nees_ori_mean": "NEES rotation",
    "nees_pos_mean": "NEES position",
    "nees_pose_in_band_percent": "NEES pose in band",
    "frame_ms_p95": "frame p95",
    "frame_ms_max": "frame max",
    "cpu_s": "CPU",
    "peak_rss_mb": "peak memory",
}
# Over seeds, what is not aligned and what is stated about it come first.
_USUAL_OVER_SEEDS = (
    "ate_none_m",
    "ate_yaw_m",
    "nees_ori_mean",
    "nees_pos_mean",
    "nees_pose_mean",
    "heldout_reproj_median_px",
    "nis_mean",
    "frame_ms_mean",
    "total_s",
)
# A unit by the end of a key; longer ends come first.
_UNITS = (
    ("_deg_per_m", "deg/m"),
    ("_percent", "%"),
    ("_deg", "deg"),
    ("_px", "px"),
    ("_mb", "MB"),
    ("_m", "m"),
    ("_s", "s"),
)
_ONE = ("nis_", "nees_")
_MOST = ("coverage_percent", "nees_pose_in_band_percent")


def columns_of(keys_present: set[str]) -> list[dict[str, Any]]:
    """Return the columns of the table in its order: the usual ones first, then every other metric."""
    usual = {column.key: column for column in COLUMNS}
    meanings = describe()
    others = [key for key in (*meanings, *sorted(keys_present - meanings.keys())) if key not in usual]
    return [
        {
            "key": key,
            "name": usual[key].name if key in usual else _NAMES.get(key, key),
            "unit": usual[key].heading[-1] if key in usual else unit_of(key),
            "decimals": usual[key].decimals if key in usual else 3,
            "meaning": meanings.get(key, ""),
            "best": best_of(key),
            "usual": key in usual,
            "usual_over_seeds": key in _USUAL_OVER_SEEDS,
        }
        for key in (*usual, *others)
    ]


def unit_of(key: str) -> str:
    """Return the unit of a metric by its key, "1" for a ratio, nothing for a count."""
    if key.startswith("frame_ms"):
        return "ms"
    unit = next((unit for ending, unit in _UNITS if key.endswith(ending)), "")
    return unit or ("1" if key.startswith(_ONE) else "")


def best_of(key: str) -> Best:
    """Return which value of a metric is best: the least, the most, the one nearest 1, or none that is."""
    if key in _MOST:
        return "most"
    if key == "pairs":
        return ""
    return "one" if key.startswith(_ONE) else "least"
