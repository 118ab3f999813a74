"""``vislam diff``: what differs between two run directories is named, and chance is told from a change."""

import json
from collections.abc import Callable
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from msgspec.structs import replace

from toolkit.cli import main
from toolkit.files.documents import read, schema
from toolkit.report.differences import ChangeRecord, DiffRecord, diff_text
from toolkit.report.run_directory import read_run, repeated

DOCUMENTS = Path(__file__).parent / "documents"


def write_run(directory: Path, edit: Callable[[dict, dict], None] = lambda seeds, manifest: None) -> None:
    """Write the directory of a comparison over three seeds, with its scores and manifest edited."""
    directory.mkdir()
    seeds, manifest = (
        json.loads((DOCUMENTS / f"{name}.json").read_text()) for name in ("seeds", "manifest-over-seeds")
    )
    edit(seeds, manifest)
    (directory / "seeds.json").write_text(json.dumps(seeds))
    (directory / "manifest.json").write_text(json.dumps(manifest))
    (directory / "report.json").write_text((DOCUMENTS / "report-over-seeds.json").read_text())


def noise_stated(seeds: dict, manifest: dict) -> None:
    """The motion is stated to be noisier: the NEES falls by as good as the same factor, the ATE by chance."""
    manifest["settings"] = {"noise": {"motion_scale": 1.5}}
    manifest["versions"]["numpy"] = "9.9"
    for run in seeds["runs"]:
        metrics = run["metrics"]
        for key, factors in (("nees_pose_mean", (0.5, 0.50001, 0.49999)), ("ate_se3_m", (1.3, 0.8, 0.9))):
            metrics[key]["values"] = np.multiply(metrics[key]["values"], factors).tolist()


def other_recordings(seeds: dict, manifest: dict) -> None:
    """Every value is one of another recording, and one run has failed."""
    seeds["hashes"] = ["0" * 64] * 3
    for run in seeds["runs"]:
        for metric in run["metrics"].values():
            metric["values"] = metric["values"][::-1]
    for run in seeds["runs"][2:]:
        run["status"][0], run["counts"] = "failed", {"ok": 2, "diverged": 0, "failed": 1}
        for metric in run["metrics"].values():
            metric["n"] = min(metric["n"], 2)


def without_errors(seeds: dict, manifest: dict) -> None:
    """No truth and no withheld tracks: there is nothing by which final and causal answers could be told apart."""
    for run in seeds["runs"]:
        for key, metric in run["metrics"].items():
            metric.update(dict.fromkeys(metric.keys() - {"quantiles_all"}) | {"n": 0, "values": [None] * 3})
            metric.pop("quantiles_all", None)
            run["notes"][key] = "no truth"


def test_a_final_answer_repeats_the_causal_one_over_seeds_only_where_errors_say_so(tmp_path: Path) -> None:
    write_run(tmp_path / "known")
    write_run(tmp_path / "unknown", without_errors)
    assert repeated(read_run(tmp_path / "known")) == {"dead-reckoning", "ekf"}
    assert repeated(read_run(tmp_path / "unknown")) == set()


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, run_directory: Path) -> Path:
    """Three comparisons over the same three seeds, and one of one seed."""
    root = tmp_path_factory.mktemp("runs")
    write_run(root / "seeds")
    write_run(root / "louder", noise_stated)
    write_run(root / "others", other_recordings)
    (root / "one").symlink_to(run_directory)
    return root


@pytest.fixture
def messages(runs: Path, capsys) -> Callable[..., dict]:
    def tell(before: str, after: str) -> dict:
        assert main(["diff", str(runs / before), str(runs / after), "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        jsonschema.validate(found, schema(DiffRecord))
        return found

    return tell


def by_metric(found: dict) -> dict[str, dict]:
    return {one["metric"]: one for one in found["metrics"] if one["output"] == "causal"}


@pytest.mark.parametrize("name", ["one", "seeds"])
def test_a_run_does_not_differ_from_itself(messages, runs, name: str, capsys) -> None:
    found = messages(name, name)
    assert found["same_results"]
    assert not any(one["moved"] for one in found["metrics"])
    assert found["settings"] == found["data"] == found["environment"] == found["ends"] == []
    assert main(["diff", str(runs / name), str(runs / name)]) == 0
    assert "the results are the same, to a millionth" in capsys.readouterr().out


def test_what_differs_at_the_end_of_a_long_text_is_shown() -> None:
    """As of a commit and the same commit changed."""
    commit = "8498ca72c387555fad878cff71f56b44dc9a20cc"
    found = read(DOCUMENTS / "diff.json", DiffRecord)
    revision = ChangeRecord(name="git_revision", before=commit, after=f"{commit}+changed")
    assert "+changed" in diff_text(replace(found, environment=(revision,)))


def test_a_setting_is_named_and_what_it_moves_is_beyond_chance(messages, runs, capsys) -> None:
    found = messages("seeds", "louder")
    assert "settings.noise.motion_scale" in {one["name"] for one in found["settings"]}
    assert "versions.numpy" in {one["name"] for one in found["environment"]}
    metrics = by_metric(found)
    assert metrics["nees_pose_mean"]["change_percent"] == pytest.approx(-50.0, abs=0.1)
    assert metrics["nees_pose_mean"]["beyond_chance"]
    assert metrics["ate_se3_m"]["moved"]
    assert metrics["ate_se3_m"]["beyond_chance"] is False
    assert not metrics["ate_yaw_m"]["moved"]
    assert metrics["total_s"]["p"] is None
    assert not found["same_results"]
    assert main(["diff", str(runs / "seeds"), str(runs / "louder")]) == 0
    printed = capsys.readouterr().out
    assert "beyond chance" in printed and "paired by seed" in printed


def test_other_recordings_are_independent_draws_and_may_be_chance(messages) -> None:
    found = messages("seeds", "others")
    assert not found["paired"]
    assert {"name": "ekf causal", "before": "3 of 3 ok", "after": "2 of 3 ok"} in found["ends"]
    tested = [one for one in found["metrics"] if one["p"] is not None]
    assert tested
    assert not any(one["beyond_chance"] for one in tested)
