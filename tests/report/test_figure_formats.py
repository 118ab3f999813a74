"""Figures in other formats are whole and repeatable, and estimators are told apart in all of them."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from toolkit.registry import defaults, discover
from toolkit.report.figures import FigureFormat, save
from toolkit.report.figures.style import NamedFigure, new_figure, stroke_of
from toolkit.report.looks import COLOURS, look_numbers

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


def test_all_estimators_are_distinguished_and_both_outputs_keep_one_colour() -> None:
    names = [*discover(), "one of my own"]
    comparison = cast(Any, SimpleNamespace(estimators=names))
    for output in ("causal", "final"):
        looks = [str(stroke_of(comparison, name, output)) for name in names]
        assert len(set(looks)) == len(names)
    lines = {str(stroke_of(comparison, name, output)["linestyle"]) for name in names for output in ("causal", "final")}
    assert len(lines) == 6


def test_an_estimator_has_one_look_whatever_it_is_compared_with() -> None:
    together = look_numbers([*discover(), "one of my own"])
    for name in together:
        assert look_numbers([name])[name] == together[name]
    assert len({together[name] % COLOURS for name in (*defaults(), "one of my own")}) == len(defaults()) + 1
