"""What the page shows of a comparison over seeds: means with their spread, every seed's value, NEES and its band."""

from typing import Any

from toolkit.report.html.run_files import RunFiles
from toolkit.report.html.thinning import thinned

Json = dict[str, Any]


def seeds_case(files: RunFiles, case_id: str, title: str, colours: dict[str, int]) -> Json:
    """Return what the page shows of one directory of a comparison over seeds."""
    sequence = files.scores["sequence"]
    return {
        "kind": "seeds",
        "id": case_id,
        "title": title,
        "sequence": sequence,
        "seeds": files.scores["seeds"],
        "words": files.report["words"],
        "rows": _rows(files, case_id, colours),
        "manifest": files.manifest,
    }


def _rows(files: RunFiles, case_id: str, colours: dict[str, int]) -> list[Json]:
    rows: list[Json] = []
    for i, (run, drawn) in enumerate(zip(files.scores["runs"], files.report["runs"], strict=True)):
        if i > 0 and _say_the_same(files.scores["runs"][i - 1], run):
            rows[-1]["output"] = "both"
            continue
        rows.append(
            {
                "id": f"{case_id}r{i}",
                "estimator": run["estimator"],
                "output": run["output"],
                "status": _status(run["counts"], len(run["status"])),
                "colour": colours[run["estimator"]],
                "change": run.get("change", ""),
                "metrics": {key: spread["mean"] for key, spread in run["metrics"].items()},
                "spreads": {key: {"std": s["std"], "n": s["n"]} for key, s in run["metrics"].items()},
                "values": {key: spread["values"] for key, spread in run["metrics"].items()},
                "statuses": run["status"],
                "notes": run["notes"],
                "nees": _series(drawn["nees"], files.report["t_s"], "pose"),
                "errors": _series(
                    None if drawn["position_rms_m"] is None else {"position_m": drawn["position_rms_m"]},
                    files.report["t_s"],
                    "position_m",
                ),
            }
        )
    return rows


def _say_the_same(causal: Json, final: Json) -> bool:
    """Say whether a final row repeats the causal one before it: every error of every seed is the same."""
    same = causal["estimator"] == final["estimator"] and causal["output"] == "causal"
    keys = ("ate_none_m", "ate_se3_m", "ate_yaw_m", "heldout_reproj_rmse_px", "nees_pose_mean")
    known = [key for key in keys if causal["metrics"][key]["n"] and final["metrics"][key]["n"]]
    return same and bool(known) and all(causal["metrics"][k]["values"] == final["metrics"][k]["values"] for k in known)


def _status(counts: dict[str, int], seeds: int) -> str:
    """Return "ok" where every seed ended well, else how many did."""
    return "ok" if counts["ok"] == seeds else f"{counts['ok']} of {seeds} ok"


def _series(series: Json | None, t_s: list[float], leading: str) -> Json | None:
    return None if series is None else thinned({"t_s": t_s, **series}, leading)
