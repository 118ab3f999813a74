"""Settings: documented key by key, read from TOML and the command line, wrong ones answered with the nearest."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import chdtri

from toolkit.settings import DEFAULTS, POLICIES, SettingsError, as_values, changes_of
from toolkit.settings.reading import assigned, describe, settings_of, with_changes


def _with(given: dict[str, Any], assignments: Iterable[str]) -> dict[str, Any]:
    return with_changes(given, dict(map(assigned, assignments)))


def test_every_setting_is_described_with_its_default() -> None:
    described = {one.key: one for one in describe()}
    values = as_values(DEFAULTS)
    sections = {key: value for key, value in values.items() if isinstance(value, dict) and key != "estimators"}
    keys = {f"{section}.{key}" for section, inner in sections.items() for key in inner}
    assert described.keys() == keys | (values.keys() - sections.keys() - {"estimators"})
    assert all(one.meaning for one in described.values())
    meaning = described["window.lag_s"].meaning
    assert described["window.lag_s"] == ("window.lag_s", "s", "2 with an IMU, else 0.6", ">= 0.001, <= 3600", meaning)


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ({"window": {"lag": 3}}, "there is no setting window.lag; did you mean window.lag_s?"),
        ({"nois": {}}, "there is no setting nois; did you mean noise?"),
        ({"window": {"lag_s": "3s"}}, "window.lag_s: expected number or none, got string '3s'; it is a number, in s"),
        # No JSON file has such a number, and so no manifest.
        ({"outliers": {"smoother_gate_factor": math.inf}}, "outliers.smoother_gate_factor: expected a finite number"),
        ({"estimators": {"mine": {"gain": -math.inf}}}, "estimators.mine.gain: expected a finite number, not -inf"),
        ({"window": 3}, "window: expected a section of keys, got integer"),
        ({"start": "thruth"}, "start: cannot be 'thruth', only measurements, truth"),
        ({"noise": {"pixel_sigma_px": 1e-300}}, "noise.pixel_sigma_px: expected number >= 0.001"),
        ({"noise": {"bridge_gaps": "yes"}}, "noise.bridge_gaps: expected true or false, got string 'yes'"),
        # Of earlier versions, answered with what there is now.
        ({"noise": {"tracks": True}}, "there is no setting noise.tracks: the noise of tracks is measured once"),
        ({"noise": {"disparity_scale": 1.0}}, "there is no setting noise.disparity_scale: no estimator has"),
    ],
)
def test_a_wrong_setting_is_refused_in_one_line_that_names_it(given: dict[str, object], complaint: str) -> None:
    with pytest.raises(SettingsError) as refusal:
        settings_of(given, "run.toml")
    assert str(refusal.value).startswith(f"run.toml: {complaint}")
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("key", ["track_weight", "motion_scale"])
def test_a_noise_is_measured_or_a_number_within_its_range(key: str) -> None:
    assert getattr(settings_of({"noise": {key: "auto"}}, "here").noise, key) == "auto"
    assert getattr(settings_of({"noise": {key: 1}}, "here").noise, key) == 1.0
    for value in (0, -0.5, "much", 1e9):
        with pytest.raises(SettingsError, match=f"here: noise.{key}: "):
            settings_of({"noise": {key: value}}, "here")


def test_assignments_take_values_as_toml_writes_them_and_bare_words() -> None:
    given = {"window": {"lag_s": 1.0}}
    merged = _with(given, ("window.landmarks=7", "start=truth", "noise.pixel_sigma_px=0.7"))
    assert given == {"window": {"lag_s": 1.0}}
    read = settings_of(merged, "--set")
    assert (read.window.lag_s, read.window.landmarks, read.start, read.noise.pixel_sigma_px) == (1.0, 7, "truth", 0.7)


def test_the_word_none_is_no_value_where_a_setting_may_have_none() -> None:
    read = settings_of(_with({}, ("outliers.filter_huber=none", "outliers.policy=none")), "--set")
    assert (read.outliers.policy, read.outliers.filter_huber) == ("none", None)
    assert settings_of({"window": {"lag_s": "none"}}, "run.toml") == DEFAULTS
    with pytest.raises(SettingsError, match="expected integer, got string"):
        settings_of({"window": {"landmarks": "none"}}, "run.toml")


def test_single_values_hold_on_top_of_a_policy_in_whatever_order_they_are_named() -> None:
    both = ("outliers.gate_probability=0.9", "outliers.policy=gate")
    one, other = (settings_of(_with({}, order), "--set").outliers for order in (both, both[::-1]))
    assert one == other
    assert (one.policy, one.gate_probability, one.joint_huber) == ("gate", 0.9, None)


def test_by_default_all_estimators_obey_one_gate_and_one_loss_and_under_classic_their_own() -> None:
    outliers, classic = DEFAULTS.outliers, POLICIES["classic"]
    assert outliers.smoother_gate_factor == 1.0
    assert outliers.joint_huber == outliers.filter_huber == outliers.smoother_huber == outliers.batch_huber
    # The filters' gate, as a length.
    assert classic.smoother_huber == float(np.sqrt(chdtri(3, 1.0 - classic.gate_probability)))


def test_what_differs_from_the_defaults_is_kept_alone_and_reads_back() -> None:
    assert changes_of(DEFAULTS) == {}
    changes = {"window": {"lag_s": 3.0}, "seeds": 4, "estimators": {"mine": {"gain": 0.5}}}
    changed = settings_of(changes, "here")
    assert changes_of(changed) == changes
    assert settings_of(as_values(changed), "there") == changed
    assert (changed.options_of("mine"), changed.options_of("other")) == ({"gain": 0.5}, {})
    with pytest.raises(SettingsError, match=r"start\.early is set, and start is a value"):
        _with({"start": "truth"}, ("start.early=3",))


def test_the_page_documents_every_setting_as_it_is() -> None:
    page = (Path(__file__).parents[1] / "docs/settings.md").read_text(encoding="utf-8")
    for one in describe():
        assert f"| `{one.key}` | {one.unit} | {one.default} | {one.range} | {one.meaning} |" in page
