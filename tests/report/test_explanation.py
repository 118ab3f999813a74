"""An explanation's words: they call an effect only what is one, and tell where it was measured (1 s)."""

import re
from pathlib import Path

import msgspec
import numpy as np
import pytest

from toolkit.experiment.comparison import Row
from toolkit.experiment.contests import HELD_OUT, Advantage, Contest
from toolkit.experiment.explanation import ContributionRecord, FactorRecord, IngredientRecord, VariantRecord
from toolkit.experiment.units import Outcome
from toolkit.registry import discover
from toolkit.report.explanation import ExplanationRecord, explanation_table, in_words
from toolkit.report.manifest import RecordingRecord, SeedsUsed
from toolkit.report.messages import why_sentence


def variant(name: str, *without: str) -> VariantRecord:
    return VariantRecord(estimator=name, output="causal", has=(), without=without)


def effect(
    less: VariantRecord, more: VariantRecord, factor: float, reach: float = 1.05, **given: object
) -> ContributionRecord:
    error = FactorRecord(factor=factor, low=factor / reach, high=factor * reach)
    made = ContributionRecord(
        less=less, more=more, distance=0, runs=8, ok=8, shown=error.is_off, error=error, variance=error, nees=error
    )
    return msgspec.structs.replace(made, **given)


def part(
    name: str, first: ContributionRecord | None, last: ContributionRecord | None = None, order: bool = False
) -> IngredientRecord:
    return IngredientRecord(ingredient=name, first_in=first, last_in=last or first, order_matters=order)


A, B, BETWEEN = variant("a"), variant("b"), variant("c", "salt")


def explanation(*parts: IngredientRecord, gap: ContributionRecord | None = None, **given: object) -> ExplanationRecord:
    made = ExplanationRecord(
        schema="vislam.explain/1",
        made={},
        sequence=RecordingRecord(name="drive", hash="", format="simulated", source=""),
        seeds=SeedsUsed(sequence=0, count=8),
        settings={},
        intervals="seeds",
        metric="ate_yaw_m",
        words="",
        gap=gap or effect(A, B, 5.1, 1.2),
        parts=parts,
        figures={},
        files=(),
    )
    return msgspec.structs.replace(made, **given)


def test_each_shown_effect_is_a_sentence_with_where_it_was_measured_and_its_interval() -> None:
    found = explanation(
        part("salt", effect(A, BETWEEN, 2.3), effect(BETWEEN, B, 2.0), order=True),
        part("pepper", effect(BETWEEN, B, 0.8)),
    )
    words = in_words(found)
    assert words.startswith(
        "On drive b is 5.10 times as accurate as a (4.25 to 6.12 with 95 % confidence; ATE yaw, 8 seeds)."
    )
    assert "Salt, the largest effect: added to a, the error becomes 2.30 times smaller (2.19 to 2.42); " in words
    assert "taken from b, the error becomes 2.00 times larger (1.90 to 2.10); the order matters." in words
    assert "Pepper: taken from b, the error becomes 1.25 times smaller (1.19 to 1.31)." in words


@pytest.mark.parametrize("seed", range(20))
def test_no_effect_is_named_whose_interval_contains_none(seed: int) -> None:
    draw = np.random.default_rng(seed)
    parts = []
    for i in range(6):
        made = [effect(A, B, float(np.exp(draw.normal(0.0, 0.1))), float(np.exp(draw.uniform(0.0, 0.3)))) for _ in "ab"]
        shown = [msgspec.structs.replace(one, shown=one.shown and draw.random() < 0.5) for one in made]
        parts.append(part(f"ingredient{i}", shown[0], msgspec.structs.replace(shown[1], more=BETWEEN)))
    words = in_words(explanation(*parts))
    for one in parts:
        claimed = f"{one.ingredient.capitalize()}:" in words or f"{one.ingredient.capitalize()}, the largest" in words
        assert claimed == any(each.shown for each in one.effects)
    shown = [one for each in parts for one in each.effects if one.shown]
    assert all(one.error is not None and one.error.is_off for one in shown)
    assert words.count("the error becomes") == len(shown)


def test_what_is_not_shown_not_measured_or_did_not_end_well_is_said() -> None:
    lost = msgspec.structs.replace(effect(A, BETWEEN, 1.0), ok=2, error=None, shown=False)
    perhaps = msgspec.structs.replace(effect(A, BETWEEN, 1.2), shown=False)
    wide = msgspec.structs.replace(effect(A, BETWEEN, 1.1, 3.0), shown=False)
    given = {"salt": effect(A, BETWEEN, 1.0), "pepper": lost, "tea": None, "oil": perhaps, "flour": wide}
    found = explanation(*(part(name, one) for name, one in given.items()))
    words = in_words(found)
    assert "Over 8 seeds no effect on the error is found of salt (0.952 to 1.05)." in words
    assert "Too few runs ended well to tell of pepper." in words
    assert "Too few data to tell of flour (0.367 to 3.30): a factor of two is not excluded." in words
    assert "What tea brings cannot be measured: no two estimators differ in that alone." in words
    assert "Perhaps the error is smaller with oil (1.14 to 1.26 near a); among 4 tests that may be chance" in words
    assert "need not multiply to the whole" in words
    assert [row[:3] for row in explanation_table(found).rows if row[0] in ("pepper", "tea")] == [
        ("pepper", "added to a", "2 of 8 ok"),
        ("tea", "no two differ in it alone", "-"),
    ]


def test_other_measures_tell_of_what_the_error_does_not_show_and_only_of_that() -> None:
    hidden = msgspec.structs.replace(effect(A, BETWEEN, 1.2), shown=False, also_shown=("variance",))
    worse = msgspec.structs.replace(effect(A, BETWEEN, 0.5), shown=False, also_shown=("variance", "nees"))
    clear = effect(A, BETWEEN, 2.3, also_shown=("variance", "nees"))
    silent = msgspec.structs.replace(effect(A, BETWEEN, 1.1), shown=False)
    tiny = msgspec.structs.replace(effect(A, BETWEEN, 1.001, 1.0001), shown=False, also_shown=("variance",))
    given = {"salt": hidden, "pepper": worse, "tea": clear, "oil": silent, "flour": tiny}
    found = explanation(*(part(name, one) for name, one in given.items()))
    assert (
        "Other figures show more than the error, beyond chance: the variance of the pose over its bound is 2.00 times "
        "larger with pepper (1.90 to 2.10) and 1.20 times smaller with salt (1.14 to 1.26); the NEES is 2.00 times "
        "larger with pepper (1.90 to 2.10)." in in_words(found)
    )
    assert "Other figures show" not in in_words(explanation(part("tea", clear), part("oil", silent)))


def test_what_does_not_differ_is_not_ranked_and_without_a_truth_the_error_is_that_of_withheld_tracks() -> None:
    equal = in_words(explanation(gap=effect(A, B, 1.1, 1.2)))
    assert "8 seeds show no difference of ATE yaw between a and b (0.917 to 1.32)" in equal
    words = in_words(explanation(metric=HELD_OUT, intervals="stretches"))
    assert "b predicts withheld tracks 5.10 times as well as a" in words
    assert "the error of withheld tracks, for there is no truth, stretches of the one recording" in words


@pytest.mark.parametrize(
    ("names", "low", "said"),
    [
        (("riekf", "ekf-slam", "ekf"), 1.1, "Why: vislam explain 'my drive' --from ekf --to riekf"),
        (("riekf", "ekf", "dead-reckoning"), 1.1, "Why: vislam explain 'my drive' --from ekf --to riekf"),
        (("riekf", "ekf"), 0.9, ""),
        (("dead-reckoning", "ekf"), 1.1, ""),
    ],
)
def test_a_verdict_points_to_the_explanation_of_what_is_no_chance(
    names: tuple[str, ...], low: float, said: str
) -> None:
    rows = tuple(Row("causal", (Outcome(0, name, "ok"),)) for name in names)
    advantages = tuple(Advantage(1.5, low, 2.0, 8, "seeds") for _ in names[1:])
    assert why_sentence(Contest("accuracy in the end", "ate_yaw_m", rows, advantages), "my drive", 1) == said


def test_the_page_lists_the_ingredients_that_estimators_declare() -> None:
    page = (Path(__file__).parents[2] / "docs" / "explain.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^\| `([^`]+)` \|", page, flags=re.MULTILINE))
    assert listed >= {name for entry in discover().values() for name in entry.ingredients()}
