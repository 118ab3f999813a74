"""The content of the page as one JSON value; its numbers are those of the run directories' documents.

Over seeds: means with their spread, every seed's value, NEES and its band. Series are thinned to a subset of the
recording's points, as many as a screen can show, to keep the file small.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from msgspec import UNSET, to_builtins
from msgspec.structs import asdict

from toolkit.answers import STATUS_MEANING
from toolkit.files import documents
from toolkit.geometry import Array, IntArray
from toolkit.metrics import Metric, known_metrics
from toolkit.report.curves import ComponentSeries, NeesSeries, look_numbers
from toolkit.report.headers import usual_metrics
from toolkit.report.messages import ContestRecord, contest_text
from toolkit.report.report_json import DrawnMap, DrawnRun
from toolkit.report.run_directory import DrawnPath, RunFiles, SeedsFiles, repeated
from toolkit.report.scores import MetricOverSeeds, RunOverSeeds, ScoredRun
from toolkit.report.text import unit_of

Json = dict[str, Any]
Files = RunFiles | SeedsFiles
_MOST_POSES = 1500
_MOST_SAMPLES = 1200
_MOST_OF_COMPONENTS = 400
_MOST_LANDMARKS = 5000
_HALF_WINDOW, _MILLIMETRES = 7, 3
_LARGE_M = 1e7
_TITLES = {
    "accuracy at each frame": "Most accurate at each frame (causal)",
    "accuracy in the end": "Most accurate in the end (final)",
    "withheld tracks": "Best on withheld tracks",
}


def payload_of(runs: Sequence[Files]) -> Json:
    names = [one.scores.sequence.name for one in runs]
    titles = [
        f"{name} ({one.directory})" if names.count(name) > 1 else name for name, one in zip(names, runs, strict=True)
    ]
    colours = look_numbers(run.estimator for files in runs for run in files.scores.runs)
    return {
        "title": " / ".join(titles) or "Experiments",
        "statuses": STATUS_MEANING,
        "columns": columns_of(_values(runs), real=any(one.manifest.sequence.format != "simulated" for one in runs)),
        "cases": [
            _case(files, f"c{i}", title, colours) for i, (files, title) in enumerate(zip(runs, titles, strict=True))
        ],
    }


def _case(files: Files, case_id: str, title: str, colours: dict[str, int]) -> Json:
    if isinstance(files, SeedsFiles):
        rows = _rows_over_seeds(files, case_id, colours)
        own: Json = {"kind": "seeds", "seeds": files.scores.seeds}
        of_runs = f"{len(files.scores.seeds)} seeds"
    else:
        rows = _rows(files, case_id, colours)
        own, of_runs = {"kind": "run"} | _of_one_run(files, rows), "one run"
    return own | {
        "id": case_id,
        "title": title,
        "sequence": to_builtins(files.scores.sequence),
        "words": to_builtins(files.report.words),
        "highlights": highlights(files.report.contests or (), rows, of_runs),
        "rows": rows,
        "manifest": to_builtins(files.manifest),
    }


def _of_one_run(files: RunFiles, rows: list[Json]) -> Json:
    report = files.report
    return {
        "card": [] if report.card is UNSET else report.card.words,
        "alignment": report.alignment,
        "error": to_builtins(report.error),
        "truth": None if report.truth is None else _drawn(files.tracks[report.truth]),
        "maps": [_map(one, files, rows) for one in report.maps],
        "steps": [
            {"estimator": one.estimator, "finish_s": one.finish_s, "rows": _rows_of(one.estimator, rows)}
            | _with_median({"t_s": one.t_s, "step_ms": one.step_ms}, "step_ms")
            for one in report.steps
        ],
    }


def _rows(files: RunFiles, case_id: str, colours: dict[str, int]) -> list[Json]:
    """Return a row for each kind of output that says something of its own, as in the other tables."""
    twice, changes = repeated(files), files.report.words.changes
    return [
        _row(run, f"{case_id}r{i}", colours)
        | {
            "output": "both" if run.estimator in twice else run.output,
            "good": run.status == "ok",
            "change": changes.get(run.estimator, ""),
            "track": None if drawn.trajectory is None else _drawn(files.tracks[drawn.trajectory], drawn),
            "errors": None if drawn.errors is None else thinned(asdict(drawn.errors), "position_m"),
            "nees": _nees(drawn.nees),
            "components": None if drawn.components is UNSET else _components(drawn.components),
            "nis": drawn.nis if isinstance(drawn.nis, str) else _with_median(asdict(drawn.nis), "per_dof"),
        }
        for i, (run, drawn) in enumerate(zip(files.scores.runs, files.report.runs, strict=True))
        if not drawn.repeats_causal
    ]


def _row(run: ScoredRun | RunOverSeeds, row_id: str, colours: dict[str, int]) -> Json:
    """Return a run as its document has it, with its id and look, and what its stated uncertainty is marked as."""
    mark = "" if run.consistency is UNSET or run.consistency.verdict == "consistent" else run.consistency.verdict
    return {**to_builtins(run), "id": row_id, "colour": colours[run.estimator], "mark": mark}


def _rows_of(estimator: str, rows: list[Json]) -> list[str]:
    return [row["id"] for row in rows if row["estimator"] == estimator]


def _moved(points: Array, drawn: DrawnRun) -> Array:
    moved: Array = points @ np.array(drawn.rotation).T + np.array(drawn.translation_m)
    return moved


def _drawn(track: DrawnPath, aligned_as: DrawnRun | None = None) -> Json:
    kept = evenly(track.t_s.size, _MOST_POSES)
    points = track.positions[kept] if aligned_as is None else _moved(track.positions[kept], aligned_as)
    return {"t_s": [round(t, 4) for t in track.t_s[kept].tolist()], **coordinates(points)}


def _map(one: DrawnMap, files: RunFiles, rows: list[Json]) -> Json:
    points, name = files.landmarks[one.landmarks], one.estimator
    last = next(run for run in files.report.runs if (run.estimator, run.output) == (name, one.output))
    shown = _moved(points[evenly(len(points), _MOST_LANDMARKS)], last)
    return {"estimator": name, "rows": _rows_of(name, rows), "count": len(points), **coordinates(shown)}


def _with_median(series: Json, leading: str) -> Json:
    """Return a thinned series with the running median of all its values, not only of those that are kept."""
    return thinned(series | {"median": running_median(series[leading])}, leading)


def _components(series: ComponentSeries) -> Json:
    """Return the errors by component with their stated deviations, at few enough times for twelve columns."""
    columns = asdict(series)
    kept = evenly(len(series.t_s), _MOST_OF_COMPONENTS)
    return {name: [column[i] for i in kept.tolist()] for name, column in columns.items()}


def _nees(series: NeesSeries | str) -> Json | str:
    if isinstance(series, str):
        return series
    columns = asdict(series)
    band = {"band": columns.pop("band")}
    return thinned(columns, "pose") | band


def _values(runs: Sequence[Files]) -> dict[str, list[float | None]]:
    """Return the values, over seeds the means, that stand in the column of each metric, of runs that ended well."""
    values: dict[str, list[float | None]] = {}
    for files in runs:
        for run in files.scores.runs:
            for key, metric in run.metrics.items():
                value = metric.mean if isinstance(metric, MetricOverSeeds) else metric
                values.setdefault(key, []).append(value if "ok" in run.status else None)
    return values


def columns_of(values: Mapping[str, Sequence[float | None]], *, real: bool) -> list[Json]:
    """Return a column for each metric that has values, and for each key that no metric here declares.

    First stand those of the table of a comparison, of a ``real`` recording where any of them is one.
    """
    present = [metric for metric in known_metrics() if metric.key in values]
    valued = [metric for metric in present if any(value is not None for value in values[metric.key])]
    usual = usual_metrics(valued, real=real)
    usual += [metric for metric in present if metric.table == "where rows differ"]
    undeclared = sorted(values.keys() - {metric.key for metric in present})
    others = [metric for metric in present if metric not in usual]
    return [
        {
            "key": metric.key,
            "name": metric.name,
            "unit": metric.unit,
            "shown_in": unit_of(metric, values[metric.key])._asdict(),
            "count": metric.count,
            "meaning": metric.meaning,
            "best": metric.best,
            "usual": metric in usual,
            "usual_over_seeds": metric.over_seeds,
        }
        for metric in (*usual, *others, *(Metric(key, "", "", (key, ""), best="") for key in undeclared))
    ]


def _rows_over_seeds(files: SeedsFiles, case_id: str, colours: dict[str, int]) -> list[Json]:
    rows: list[Json] = []
    twice, t_s = repeated(files), files.report.t_s
    for i, (run, drawn) in enumerate(zip(files.scores.runs, files.report.runs, strict=True)):
        ok, seeds, nees, errors_m = run.counts["ok"], len(run.status), drawn.nees, drawn.position_rms_m
        if run.estimator in twice and run.output == "final":
            continue
        rows.append(
            _row(run, f"{case_id}r{i}", colours)
            | {
                "output": "both" if run.estimator in twice else run.output,
                "status": "ok" if ok == seeds else f"{ok} of {seeds} ok",
                "good": ok == seeds,
                "change": run.change or "",
                "metrics": {key: metric.mean for key, metric in run.metrics.items()},
                "spreads": {key: {"std": metric.std, "n": metric.n} for key, metric in run.metrics.items()},
                "values": {key: metric.values for key, metric in run.metrics.items()},
                "statuses": run.status,
                "nees": None if nees is None else thinned({"t_s": t_s, **asdict(nees)}, "pose"),
                "errors": None if errors_m is None else thinned({"t_s": t_s, "position_m": errors_m}, "position_m"),
            }
        )
    return rows


def highlights(contests: Sequence[ContestRecord], rows: Sequence[Json], runs: str) -> list[dict[str, str | None]]:
    """Return the answers a reader looks for first: a question, the answer, its row or None, and why.

    A contest's winner is the one that its document names; a row with a mark wins nothing. ``rows`` are those of the
    page's table; ``runs`` says over how many runs a contest is, as in "one run".
    """
    found = []
    for contest in contests:
        first = contest.rivals[0]
        same = (row for row in rows if row["estimator"] == first.estimator and row["output"] in (first.output, "both"))
        row: Json = next(same, {"id": None, "mark": ""})
        found.append(
            {
                "question": _TITLES[contest.question],
                "answer": contest.winner or ("no winner" if len(contest.leaders) == 1 else "no clear winner"),
                "row": row["id"] if contest.winner else None,
                "detail": contest_text(contest, runs, row["mark"]),
            }
        )
    return found


def evenly(count: int, most: int) -> IntArray:
    """Return at most ``most`` indices (n,) of 0 ... count - 1, evenly spread, the first and the last among them."""
    if count <= most:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, most).round().astype(np.int64))


def with_peaks(values: Array, most: int) -> IntArray:
    """Return at most ``most`` indices into values (N,) that keep the least and the largest of each stretch.

    So a single bad frame among thousands stays visible. NaN never wins; the first and the last index stay.
    """
    if values.size <= most:
        return np.arange(values.size)
    edges = np.linspace(0, values.size, max(most // 2 - 1, 1) + 1).round().astype(np.int64)
    kept = {0, values.size - 1}
    for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        part = values[begin:end]
        kept |= {begin + int(np.where(np.isnan(part), np.inf, part).argmin())}
        kept |= {begin + int(np.where(np.isnan(part), -np.inf, part).argmax())}
    return np.array(sorted(kept))


def thinned(series: Mapping[str, Sequence[float | None]], leading: str) -> dict[str, list[float | None]]:
    """Return the lists of a series, all thinned alike, so that the peaks of the ``leading`` one stay."""
    values = _as_array(series[leading])
    kept = with_peaks(values, _MOST_SAMPLES).tolist()
    return {name: [column[i] for i in kept] for name, column in series.items() if len(column) == values.size}


def running_median(values: Sequence[float | None]) -> list[float | None]:
    """Return the median of the known ones of the fifteen values around each, fewer at the ends; None without any."""
    padded = np.pad(_as_array(values), _HALF_WINDOW, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _HALF_WINDOW + 1)
    known = np.isfinite(windows).any(axis=1)
    medians = np.full(len(values), np.nan)
    medians[known] = np.nanmedian(windows[known], axis=1)
    return list(documents.numbers(medians))


def _as_array(values: Sequence[float | None]) -> Array:
    return np.array([np.nan if value is None else value for value in values], dtype=float)


def coordinates(points: Array) -> dict[str, list[float | None]]:
    """Return points (N, 3) as lists of x, y and z to the millimetre, beyond 10 000 km with six digits."""
    return {
        axis: [round(v, _MILLIMETRES) if abs(v) < _LARGE_M else documents.number(v) for v in values]
        for axis, values in zip("xyz", points.T.tolist(), strict=True)
    }
