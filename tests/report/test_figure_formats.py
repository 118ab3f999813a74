"""Figures in other formats are whole and repeatable, and fourteen estimators are told apart."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from toolkit.report.figures import FigureFormat, save
from toolkit.report.figures.style import NamedFigure, new_figure, stroke_of

BEGINS = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}


def figures() -> list[NamedFigure]:
    figure = new_figure(2.0)
    figure.add_subplot().plot([0, 1], [1, 0], label="a line")
    return [NamedFigure("line", "A line.", figure)]


@pytest.mark.parametrize("kind", BEGINS)
def test_a_figure_is_of_its_format_and_the_same_every_time(tmp_path, kind: FigureFormat) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        assert save(figures(), tmp_path / name, kind) == {f"line.{kind}": "A line."}
    one, two = ((tmp_path / name / f"line.{kind}").read_bytes() for name in ("one", "two"))
    assert one.startswith(BEGINS[kind])
    assert one == two


def test_fourteen_estimators_are_distinguished_and_both_outputs_keep_one_colour() -> None:
    names = [f"e{i}" for i in range(14)]
    comparison = cast(Any, SimpleNamespace(runs=[SimpleNamespace(estimator=name) for name in names]))
    for output in ("causal", "final"):
        looks = [str(stroke_of(comparison, name, output)) for name in names]
        assert len(set(looks)) == 14
    lines = {str(stroke_of(comparison, name, output)["linestyle"]) for name in names for output in ("causal", "final")}
    assert len(lines) == 4
