"""A baseline is read back to the bit, and anything wrong with its file is told in one line."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from msgspec import structs

from toolkit.gate.baseline import BaselineError, installed_releases, json_text, load_baseline, other_releases, to_text
from toolkit.metrics import describe


@pytest.fixture
def path(baseline, tmp_path):
    file = tmp_path / "here.json"
    file.write_text(to_text(baseline))
    return file


def test_a_baseline_is_read_back_to_the_bit(baseline, path):
    assert load_baseline(path) == baseline
    rows = [line for line in path.read_text().splitlines() if '"ate_se3_m": [' in line]
    assert len(rows) == 6  # an estimator and sequence a line, all of its seeds on it
    assert all(line.endswith(("]", "],")) for line in rows)
    given = {"truth": "/data/[ old ]/truth.tum", "names": ["x [", "y ]"], "empty": []}
    assert json.loads(json_text(given)) == given  # brackets in a text are none of a list


def test_not_a_number_is_never_written(baseline):
    case, measured = baseline.cases[0]
    bad = structs.replace(measured.runs["one"], speed=(float("nan"),) * 24)
    with pytest.raises(ValueError, match="not JSON compliant"):
        to_text(replace(baseline, cases=((case, replace(measured, runs={"one": bad})),)))


def _run(document):
    return document["sequences"][0]["runs"]["one"]


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (lambda d: d["sequences"][0].update(seeds=[0, 0]), "seeds"),
        (lambda d: d["sequences"][0]["hashes"].pop(), "hashes"),
        (lambda d: _run(d)["causal"]["ate_se3_m"].pop(), "ate_se3_m"),
        (lambda d: _run(d)["causal"]["ate_se3_m"].__setitem__(3, float("nan")), r"ate_se3_m\[3\].*NaN"),
    ],
)
def test_a_spoilt_baseline_is_reported_in_one_line_with_the_place(path, spoil, expected):
    document = json.loads(path.read_text())
    spoil(document)
    path.write_text(json.dumps(document))
    with pytest.raises(BaselineError, match=expected) as raised:
        load_baseline(path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(("release", "same"), [("1.2.3", True), ("1.2.9", True), ("1.3.3", False), ("2.2.3", False)])
def test_numpys_repairs_are_the_same_release(monkeypatch, release, same):
    monkeypatch.setattr("toolkit.gate.baseline.version", lambda name: {"gtsam": "4.3.0", "numpy": "1.2.3"}[name])
    assert (not other_releases({"gtsam": "4.3.0", "numpy": release})) == same
    assert other_releases({"gtsam": "4.3.1", "numpy": "1.2.3"})
    assert other_releases({"numpy": "1.2.3"})


def test_a_folder_gives_the_baseline_of_the_releases_installed(baseline, path):
    older = replace(baseline, releases=installed_releases() | {"gtsam": "4.2.0"})
    (path.parent / "older.json").write_text(to_text(older))
    assert load_baseline(path.parent) == baseline
    shutil.copy(path, path.parent / "again.json")
    with pytest.raises(BaselineError, match=r"again\.json, here\.json .* name one"):
        load_baseline(path.parent)
    for name in ("again.json", "here.json"):
        (path.parent / name).unlink()
    with pytest.raises(BaselineError, match="none of 1 baselines"):
        load_baseline(path.parent)


SHIPPED = sorted((Path(__file__).parents[1] / "baselines").glob("*.json"))


@pytest.mark.parametrize("shipped", SHIPPED or [None], ids=str)
def test_a_shipped_baseline_is_usable_and_named_by_its_releases(shipped):
    baseline = load_baseline(shipped)
    gtsam, numpy = (baseline.releases[name] for name in ("gtsam", "numpy"))
    assert shipped.stem == f"gtsam-{gtsam}_numpy-{'.'.join(numpy.split('.')[:2])}"
    assert {*baseline.bounds.simulated, *baseline.bounds.recorded} <= set(describe())
    assert all(status == "ok" for _, m in baseline.cases for one in m.runs.values() for status in one.status)
