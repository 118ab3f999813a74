"""An explanation in words, as a table, as ``explain.json`` (``vislam.explain/1``), and the folder that has it all."""

import math
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType

from toolkit.answers import Output
from toolkit.experiment.comparison import NEES
from toolkit.experiment.contests import HELD_OUT
from toolkit.experiment.explanation import ERROR, FEWEST_SEEDS, VARIANCE, Contribution, Explanation, Variant, called
from toolkit.experiment.statistics import Paired
from toolkit.files.documents import Count, reader, rounded
from toolkit.metrics import metrics_called
from toolkit.report.manifest import RecordingRecord, SeedsUsed, made_here, recording_record
from toolkit.report.results_folder import Results, Shown
from toolkit.report.text import MISSING, Table, listed, number
from toolkit.settings import changes_of

Kind = Literal["added", "taken"]
Other = Literal["variance", "nees"]
# Factors of more than this stand for any larger one, which a diverged run may have.
_MOST = 1e6
_DIGITS = 3
_KEYS: dict[Other, str] = {"variance": VARIANCE, "nees": NEES}
# So many ingredients a sentence names; the table has all.
_MOST_NAMED = 3
# An effect of less than a hundredth may be certain, and is not worth a sentence.
_LEAST_TOLD = 0.01


class VariantRecord(Struct, frozen=True, kw_only=True):
    """One kind of output of an estimator, what it has, and what of it was taken away."""

    estimator: str
    output: Output
    has: tuple[str, ...]
    without: tuple[str, ...]

    def __str__(self) -> str:
        return called(self.estimator, self.without)


class FactorRecord(Struct, frozen=True, kw_only=True):
    """How many times as large a figure is without the ingredient as with it, with its 95 % interval."""

    factor: float
    low: float
    high: float

    @property
    def is_off(self) -> bool:
        return not self.low <= 1.0 <= self.high

    def inverse(self) -> "FactorRecord":
        """Return how many times as large it is with the ingredient as without it."""
        return FactorRecord(factor=1.0 / self.factor, low=1.0 / self.high, high=1.0 / self.low)

    def range(self) -> str:
        return f"{number(self.low, _DIGITS)} to {number(self.high, _DIGITS)}"


class ContributionRecord(Struct, frozen=True, kw_only=True):
    """What an ingredient brings between two variants; null is what is not known."""

    less: VariantRecord
    more: VariantRecord
    distance: Annotated[Count, Meta(description="ingredients in which the pair differs from the estimator it tells of")]
    runs: Count
    ok: Annotated[Count, Meta(description="runs in which both ended well")]
    shown: Annotated[bool, Meta(description="whether the error differs by more than chance, by Holm's test over all")]
    error: FactorRecord | None
    variance: Annotated[FactorRecord | None, Meta(description="variance of the pose over the Cramér-Rao bound")]
    nees: FactorRecord | None
    also_shown: Annotated[tuple[Other, ...] | UnsetType, Meta(description="of the others, those beyond chance")] = UNSET

    def shows(self, measure: str) -> bool:
        return self.shown if measure == "error" else measure in (self.also_shown or ())


class IngredientRecord(Struct, frozen=True, kw_only=True):
    """An ingredient: what it brings the first estimator alone, and what the second loses without it."""

    ingredient: str
    first_in: Annotated[ContributionRecord | None, Meta(description="null where no two variants differ in it alone")]
    last_in: ContributionRecord | None
    order_matters: Annotated[bool, Meta(description="whether the two differ by more than chance")]

    @property
    def effects(self) -> tuple[ContributionRecord, ...]:
        """Return the effects first in and last in, one where both are of the same pair, none where there is none."""
        if self.first_in is None or self.last_in is None:
            return ()
        same = (self.first_in.less, self.first_in.more) == (self.last_in.less, self.last_in.more)
        return (self.first_in,) if same else (self.first_in, self.last_in)


class ExplanationRecord(Struct, frozen=True, kw_only=True):
    """Why one estimator is more accurate than another; ``gap`` compares the two themselves."""

    schema: Literal["vislam.explain/1"]
    made: Annotated[dict[str, str], Meta(description="command, date, git_revision and cpu")]
    sequence: RecordingRecord
    seeds: SeedsUsed
    settings: Annotated[dict[str, Any], Meta(description="those that differ from the defaults")]
    intervals: Annotated[Literal["seeds", "stretches"], Meta(description="what they are over")]
    metric: Annotated[str, Meta(description="key of the error; over stretches against a truth their drift is meant")]
    words: Annotated[str, Meta(description="the explanation in sentences")]
    gap: ContributionRecord
    parts: Annotated[tuple[IngredientRecord, ...], Meta(description="what brings most first")]
    figures: Annotated[dict[str, str], Meta(description="captions by file")]
    files: Annotated[tuple[str, ...], Meta(description="that were written, relative to the directory")]


read_explanation = reader(ExplanationRecord, "repeat vislam explain")


def explanation_document(
    found: Explanation, command: str = "", figures: dict[str, str] | None = None, files: tuple[str, ...] = ()
) -> ExplanationRecord:
    """Return an explanation as a record; ``figures`` are captions by file, ``files`` all that is written beside it."""
    plan = found.grid.plan
    record = ExplanationRecord(
        schema="vislam.explain/1",
        made=made_here(command),
        sequence=recording_record(found.grid.case.sequence),
        seeds=SeedsUsed(sequence=plan.seeds[0], count=len(plan.seeds)),
        settings=changes_of(plan.settings),
        intervals="seeds" if found.over_seeds else "stretches",
        metric=found.metric,
        words="",
        gap=_effect(found.gap),
        parts=tuple(
            IngredientRecord(
                ingredient=part.ingredient,
                first_in=None if part.first is None else _effect(part.first),
                last_in=None if part.last is None else _effect(part.last),
                order_matters=part.order is not None,
            )
            for part in found.parts
        ),
        figures=figures or {},
        files=files,
    )
    return msgspec.structs.replace(record, words=in_words(record))


def _effect(effect: Contribution) -> ContributionRecord:
    by = {key: None if one is None else _factor_record(one) for key, one in effect.by.items()}
    return ContributionRecord(
        less=_variant(effect.edge.less),
        more=_variant(effect.edge.more),
        distance=effect.edge.distance,
        runs=effect.runs,
        ok=effect.ok,
        shown=ERROR in effect.shown,
        error=by[ERROR],
        variance=by.get(VARIANCE),
        nees=by.get(NEES),
        also_shown=tuple(name for name, key in _KEYS.items() if key in effect.shown),
    )


def _variant(one: Variant) -> VariantRecord:
    return VariantRecord(estimator=one.name, output=one.output, has=tuple(sorted(one.has)), without=one.without)


def _factor_record(one: Paired) -> FactorRecord:
    most = math.log(_MOST)
    factor, low, high = (rounded(math.exp(min(max(end, -most), most))) for end in one.interval)
    return FactorRecord(factor=factor, low=low, high=high)


def in_words(found: ExplanationRecord) -> str:
    """Return an explanation in plain sentences, which call only that an effect which is more than chance."""
    return " ".join([_gap(found), *_shown(found), *_by_other_measures(found), *_not_shown(found), *_beside(found)])


def _gap(found: ExplanationRecord) -> str:
    start, goal, gap = found.gap.less, found.gap.more, found.gap.error
    on = f"On {found.sequence.name}"
    if gap is None:
        ended = f"both ended well in {found.gap.ok} of {found.gap.runs} runs"
        takes = f"it takes {FEWEST_SEEDS} seeds" if found.intervals == "seeds" else "it takes a longer stretch of path"
        return f"{on} {start} and {goal} cannot be compared: {ended}, and {takes}."
    if not gap.is_off:
        return f"{on} {over(found)} show no difference of {error_of(found)} between {start} and {goal} ({gap.range()})."
    better, worse, by = (goal, start, gap) if gap.factor > 1.0 else (start, goal, gap.inverse())
    does = "predicts withheld tracks" if found.metric == HELD_OUT else "is"
    claim = (
        f"{does} {number(by.factor, _DIGITS)} times as {'well' if found.metric == HELD_OUT else 'accurate'} as {worse}"
    )
    return f"{on} {better} {claim} ({by.range()} with 95 % confidence; {error_of(found)}, {over(found)})."


def over(found: ExplanationRecord) -> str:
    return f"{found.seeds.count} seeds" if found.intervals == "seeds" else "stretches of the one recording"


def error_of(found: ExplanationRecord) -> str:
    if found.metric == HELD_OUT:
        return "the error of withheld tracks, for there is no truth"
    return metrics_called((found.metric,))[0].column if found.intervals == "seeds" else "drift"


def _shown(found: ExplanationRecord) -> Iterator[str]:
    parts = [part for part in found.parts if _is_shown(part)]
    for i, part in enumerate(parts):
        name = part.ingredient.capitalize() + (", the largest effect" if i == 0 and len(parts) > 1 else "")
        clauses = [_clause(one, kind, _tests(found)) for _, kind, one in placed(found, part)]
        yield f"{name}: {'; '.join(clauses)}{'; the order matters' if part.order_matters else ''}."


def _is_shown(part: IngredientRecord) -> bool:
    return any(one.shown for one in part.effects)


def placed(found: ExplanationRecord, part: IngredientRecord) -> Iterator[tuple[bool, Kind, ContributionRecord]]:
    """Yield the effects of an ingredient: whether it tells of the second estimator, what is done there, and the effect.

    It is taken from an estimator that has it; as near to the first as there is a pair it is added, else taken away.
    """
    for i, effect in enumerate(part.effects):
        of_second = i == 1 or (len(part.effects) == 1 and effect.more == found.gap.more)
        yield of_second, "taken" if of_second or effect.more == found.gap.less else "added", effect


def where(kind: Kind, effect: ContributionRecord) -> str:
    return f"added to {effect.less}" if kind == "added" else f"taken from {effect.more}"


def _tests(found: ExplanationRecord) -> int:
    return sum(len(part.effects) for part in found.parts)


def _clause(effect: ContributionRecord, kind: Kind, tests: int) -> str:
    at = where(kind, effect)
    if effect.error is None:
        return f"{at}, it cannot be told ({effect.ok} of {effect.runs} pairs of runs ended well)"
    if not (effect.shown or effect.error.is_off):
        return f"{at}, nothing is shown ({effect.error.range()})"
    change_told = _size_told(effect.error if kind == "added" else effect.error.inverse())
    if effect.shown:
        return f"{at}, the error becomes {change_told}"
    return f"{at}, it seems to become {change_told}, which may be chance among {tests} tests"


def _by_other_measures(found: ExplanationRecord) -> Iterator[str]:
    """Yield what is more than chance of ingredients whose effect on the error is not, the largest effects first."""
    names: dict[Other, str] = {"variance": "the variance of the pose over its bound", "nees": "the NEES"}
    told = []
    for measure, name in names.items():
        effects: list[tuple[FactorRecord, str]] = []
        for part in found.parts:
            shown = [getattr(one, measure) for one in part.effects if one.shows(measure)]
            if shown and not _is_shown(part) and abs(math.log(shown[0].factor)) > _LEAST_TOLD:
                effects.append((shown[0], part.ingredient))
        effects.sort(key=lambda pair: -abs(math.log(pair[0].factor)))
        clauses = [_size_told(change, f"with {ingredient} ") for change, ingredient in effects[:_MOST_NAMED]]
        if clauses:
            told.append(f"{name} is {listed(clauses)}")
    if told:
        yield f"Other figures show more than the error, beyond chance: {'; '.join(told)}."


def _size_told(change: FactorRecord, where: str = "") -> str:
    """Return how many times smaller or larger something is with an ingredient, whose effect is given."""
    size, by = ("smaller", change) if change.factor > 1.0 else ("larger", change.inverse())
    return f"{number(by.factor, _DIGITS)} times {size} {where}({by.range()})"


def _not_shown(found: ExplanationRecord) -> Iterator[str]:
    """Yield what may be chance, of which some look like more where they are tested alone, and what is not known."""
    silent = [part for part in found.parts if part.effects and not _is_shown(part)]
    if likely := [part for part in silent if any(one.error and one.error.is_off for one in part.effects)]:
        by_size = {"smaller": list(filter(_helps, likely)), "larger": [part for part in likely if not _helps(part)]}
        said = " and ".join(f"{size} with {_where_likely(found, some)}" for size, some in by_size.items() if some)
        yield f"Perhaps the error is {said}; among {_tests(found)} tests that may be chance: more data would tell."
    unknown = [part for part in silent if not any(one.error for one in part.effects)]
    if unknown and found.gap.error is not None:
        yield f"Too few runs ended well to tell of {listed((part.ingredient for part in unknown), len(unknown))}."
    rest = [part for part in silent if part not in (*likely, *unknown)]
    if still_open := [
        part
        for part in rest
        if any(one.error is not None and (one.error.low < 0.5 or one.error.high > 2.0) for one in part.effects)
    ]:
        yield f"Too few data to tell of {_listed(still_open)}: a factor of two is not excluded."
    if rest := [part for part in rest if part not in still_open]:
        yield f"Over {over(found)} no effect on the error is found of {_listed(rest)}."
    if lacking := [part.ingredient for part in found.parts if not part.effects]:
        yield f"What {' and '.join(lacking)} brings cannot be measured: no two estimators differ in that alone."


def _beside(found: ExplanationRecord) -> Iterator[str]:
    if found.gap.error is not None and _tests(found) > 1:
        yield (
            "A range in brackets that follows an ingredient's name is of the error without it over that with it. Each "
            "effect holds beside what else the estimators there have, so they need not multiply to the whole."
        )


def _helps(part: IngredientRecord) -> bool:
    return any(one.error is not None and one.error.low > 1.0 for one in part.effects)


def _where_likely(found: ExplanationRecord, parts: Sequence[IngredientRecord]) -> str:
    """Return ingredients with what does not contain 1, and near which of the two estimators it was found."""
    texts = []
    for part in parts:
        ends = [(of_second, one.error) for of_second, _, one in placed(found, part) if one.error and one.error.is_off]
        ranges = [f"{error.range()} near {found.gap.more if last else found.gap.less}" for last, error in ends]
        texts.append(f"{part.ingredient} ({', '.join(ranges)})")
    return listed(texts, len(texts))


def _listed(parts: Sequence[IngredientRecord]) -> str:
    """Return ingredients, each with the range of all its intervals."""
    texts = []
    for part in parts:
        known = [one.error for one in part.effects if one.error]
        whole = FactorRecord(factor=1.0, low=min(e.low for e in known), high=max(e.high for e in known))
        texts.append(f"{part.ingredient} ({whole.range()})")
    return listed(texts, len(texts))


def explanation_table(found: ExplanationRecord) -> Table:
    """Return the effects of every ingredient: where it is added as near to the first estimator as there is a pair of
    variants, and where it is taken away as near to the second.
    """
    names = {"error": "error", "variance": "variance", "nees": "NEES"}
    effects = [found.gap, *(one for part in found.parts for one in part.effects)]
    keys = [key for key in names if any(getattr(one, key) for one in effects)]
    rows = [("all of it", f"from {found.gap.less} to {found.gap.more}", *_cells(found.gap, keys))]
    for part in found.parts:
        for i, (_, kind, one) in enumerate(placed(found, part)):
            rows.append(("" if i else part.ingredient, where(kind, one), *_cells(one, keys)))
        if not part.effects:
            rows.append((part.ingredient, "no two differ in it alone", *(MISSING for _ in keys)))
    heads = (("ingredient", "", ""), ("where", "", ""), *((names[key], "", "") for key in keys))
    under = [
        f"how many times as large without it as with it, with 95 % intervals over {over(found)}, paired",
        f"error: {error_of(found)}; * more than chance, by Holm's test over all effects of its column",
        *(["variance: of the pose, over the Cramér-Rao bound"] if "variance" in keys else []),
        *(["NEES: squared error over its stated variance, 1 where that is right"] if "nees" in keys else []),
    ]
    return Table(heads, tuple(rows), labels=2, under=tuple(under))


def _cells(effect: ContributionRecord, keys: Sequence[str]) -> Iterator[str]:
    for key in keys:
        one: FactorRecord | None = getattr(effect, key)
        ok = "" if effect.ok == effect.runs else f"{effect.ok} of {effect.runs} ok"
        if one is None:
            yield ok or MISSING
            continue
        factor, low, high = (number(value, _DIGITS) for value in (one.factor, one.low, one.high))
        star = "*" if effect.shows(key) else ""
        yield f"{factor}{star} ({', '.join(filter(None, (f'{low}-{high}', ok if key == 'error' else '')))})"


def _shown_as(found: ExplanationRecord) -> Shown:
    title = f"From {found.gap.less} to {found.gap.more} on {found.sequence.name}"
    return Shown(title, found.words, explanation_table(found), found.figures, found.files)


EXPLANATIONS = Results("explain.json", "explain.md", read_explanation, _shown_as)


def write_explanation(found: Explanation, target: Path, command: str) -> ExplanationRecord:
    """Write the explanation's folder: document, Markdown and figure; raises as :meth:`Results.write` does."""
    from toolkit.report.figures.waterfall import draw_explanation

    figures = draw_explanation(explanation_document(found))
    return EXPLANATIONS.write(target, figures, partial(explanation_document, found, command))
