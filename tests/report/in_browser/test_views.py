"""The views and charts of the page in a real browser: they move and zoom by pointer, by keyboard and by touch."""

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("selenium.webdriver", reason="needs selenium, from the extra 'test'")

from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys

Page = Any  # conftest.py


@pytest.mark.parametrize(
    ("view", "key", "back"),
    [
        ("top", Keys.ARROW_LEFT, Keys.ARROW_RIGHT),
        ("top", "+", "0"),
        ("orbit", Keys.ARROW_LEFT, Keys.ARROW_RIGHT),
        ("orbit", Keys.ARROW_UP, "0"),
        ("orbit", "-", "0"),
    ],
)
def test_views_answer_to_the_keyboard(page: Page, single: Path, view: str, key: str, back: str) -> None:
    page.open(single)
    canvas = f"canvas[data-view='{view}']"
    before = page.picture(canvas)
    page.press(canvas, key)
    assert page.picture(canvas) != before
    page.press(canvas, back)
    assert page.picture(canvas) == before


@pytest.mark.parametrize("view", ["top", "orbit"])
def test_views_answer_to_the_pointer_and_the_buttons(page: Page, single: Path, view: str) -> None:
    page.open(single)
    canvas = f"canvas[data-view='{view}']"
    before = page.picture(canvas)
    ActionChains(page.driver).drag_and_drop_by_offset(page.into_view(canvas), 60, 10).perform()
    dragged = page.picture(canvas)
    assert dragged != before
    page.run("arguments[0].closest('.view-frame').querySelector('button').click()", page.find(canvas))
    assert page.picture(canvas) != dragged


def test_one_cursor_moves_every_figure(page: Page, single: Path) -> None:
    page.open(single)
    figures = ("canvas[data-view='top']", "canvas[data-view='orbit']", "canvas[data-chart^='Position error']")
    before = [page.picture(figure) for figure in figures]
    page.press(".scrubber input", *[Keys.PAGE_UP] * 3)
    assert all(page.picture(figure) != picture for figure, picture in zip(figures, before, strict=True))
    reported = page.find(".readout").text
    assert reported.endswith(" m")
    assert float(reported.split(" s")[0]) > 0.0
    assert page.find(".scrubber input").get_attribute("aria-valuetext") == reported
