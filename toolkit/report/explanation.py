"""An explanation in words, as a table, as ``explain.json`` (``vislam.explain/1``), and the folder that has it all."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from toolkit.experiment.contests import HELD_OUT
from toolkit.experiment.explanation import (
    FEWEST_SEEDS,
    ContributionRecord,
    Explanation,
    FactorRecord,
    IngredientRecord,
    Other,
)
from toolkit.files.documents import reader
from toolkit.metrics import metrics_called
from toolkit.report.manifest import RecordingRecord, SeedsUsed, made_here, recording_record
from toolkit.report.run_directory import Results, Shown
from toolkit.report.text import MISSING, Table, listed, number
from toolkit.settings import changes_of

Kind = Literal["added", "taken"]
_DIGITS = 3
# So many ingredients a sentence names; the table has all.
_MOST_NAMED = 3
# An effect of less than a hundredth may be certain, and is not worth a sentence.
_LEAST_TOLD = 0.01


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
    found: Explanation, command: str = "", figures: Mapping[str, str] | None = None, files: tuple[str, ...] = ()
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
        gap=found.gap,
        parts=found.parts,
        figures=dict(figures or {}),
        files=files,
    )
    return msgspec.structs.replace(record, words=in_words(record))


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
        return f"{on} {over(found)} show no difference of {error_of(found)} between {start} and {goal} ({_range(gap)})."
    better, worse, by = (goal, start, gap) if gap.factor > 1.0 else (start, goal, gap.inverse())
    does = "predicts withheld tracks" if found.metric == HELD_OUT else "is"
    claim = (
        f"{does} {number(by.factor, _DIGITS)} times as {'well' if found.metric == HELD_OUT else 'accurate'} as {worse}"
    )
    return f"{on} {better} {claim} ({_range(by)} with 95 % confidence; {error_of(found)}, {over(found)})."


def _range(one: FactorRecord) -> str:
    return f"{number(one.low, _DIGITS)} to {number(one.high, _DIGITS)}"


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
        return f"{at}, nothing is shown ({_range(effect.error)})"
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
    return f"{number(by.factor, _DIGITS)} times {size} {where}({_range(by)})"


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
        ranges = [f"{_range(error)} near {found.gap.more if last else found.gap.less}" for last, error in ends]
        texts.append(f"{part.ingredient} ({', '.join(ranges)})")
    return listed(texts, len(texts))


def _listed(parts: Sequence[IngredientRecord]) -> str:
    """Return ingredients, each with the range of all its intervals."""
    texts = []
    for part in parts:
        known = [one.error for one in part.effects if one.error]
        whole = FactorRecord(factor=1.0, low=min(e.low for e in known), high=max(e.high for e in known))
        texts.append(f"{part.ingredient} ({_range(whole)})")
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


EXPLANATIONS = Results("explain.json", "explain.md", explanation_document, read_explanation, _shown_as)
