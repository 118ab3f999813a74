"""What the page shows of a comparison over seeds: means with their spread, every seed's value, NEES and its band."""

from typing import Any

from msgspec import UNSET, UnsetType, to_builtins
from msgspec.structs import asdict

from toolkit.report.html.run_files import SeedsFiles
from toolkit.report.html.thinning import thinned
from toolkit.report.records.metrics import Judged
from toolkit.report.records.report import DrawnOverSeeds
from toolkit.report.records.seeds import RunOverSeeds

Json = dict[str, Any]


def seeds_case(files: SeedsFiles, case_id: str, title: str, colours: dict[str, int]) -> Json:
    """Return what the page shows of one directory of a comparison over seeds."""
    return {
        "kind": "seeds",
        "id": case_id,
        "title": title,
        "sequence": asdict(files.scores.sequence),
        "seeds": files.scores.seeds,
        "words": asdict(files.report.words),
        "rows": _rows(files, case_id, colours),
        "manifest": to_builtins(files.manifest),
    }


def _rows(files: SeedsFiles, case_id: str, colours: dict[str, int]) -> list[Json]:
    rows: list[Json] = []
    for i, (run, drawn) in enumerate(zip(files.scores.runs, files.report.runs, strict=True)):
        if i > 0 and _say_the_same(files.scores.runs[i - 1], run):
            rows[-1]["output"] = "both"
            continue
        rows.append(
            {
                "id": f"{case_id}r{i}",
                "estimator": run.estimator,
                "output": run.output,
                "status": _status(run),
                "mark": mark_of(run.consistency),
                "colour": colours[run.estimator],
                "change": "" if run.change is UNSET else run.change,
                "metrics": {key: metric.mean for key, metric in run.metrics.items()},
                "spreads": {key: {"std": metric.std, "n": metric.n} for key, metric in run.metrics.items()},
                "values": {key: metric.values for key, metric in run.metrics.items()},
                "statuses": run.status,
                "notes": run.notes,
                **_series(drawn, files.report.t_s),
            }
        )
    return rows


def mark_of(judged: Judged | UnsetType) -> str:
    """Return "overconfident" or "timid" where a run is so, nothing where it is consistent or cannot be judged."""
    return "" if judged is UNSET or judged.verdict == "consistent" else judged.verdict


def _status(run: RunOverSeeds) -> str:
    """Return "ok" where every seed ended well, else how many did."""
    seeds = len(run.status)
    return "ok" if run.counts["ok"] == seeds else f"{run.counts['ok']} of {seeds} ok"


def _say_the_same(causal: RunOverSeeds, final: RunOverSeeds) -> bool:
    """Say whether a final row repeats the causal one before it: every error of every seed is the same."""
    same = causal.estimator == final.estimator and causal.output == "causal"
    keys = ("ate_none_m", "ate_se3_m", "ate_yaw_m", "heldout_reproj_rmse_px", "nees_pose_mean")
    pairs = [(causal.metrics[key], final.metrics[key]) for key in keys]
    known = [(one, other) for one, other in pairs if one.n and other.n]
    return same and bool(known) and all(one.values == other.values for one, other in known)


def _series(drawn: DrawnOverSeeds, t_s: tuple[float, ...]) -> Json:
    """Return the NEES and the position errors over the frames' times, thinned, or None each where there is none."""
    nees, errors_m = drawn.nees, drawn.position_rms_m
    return {
        "nees": None if nees is None else thinned({"t_s": t_s, **asdict(nees)}, "pose"),
        "errors": None if errors_m is None else thinned({"t_s": t_s, "position_m": errors_m}, "position_m"),
    }
