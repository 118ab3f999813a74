"""The page in a real browser: it sorts, switches off, takes a theme, fits its screen, and runs no name as code."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from toolkit.metrics import known_metrics
from toolkit.report.html import write_html
from toolkit.report.text import cell, unit_of

pytest.importorskip("selenium.webdriver", reason="needs selenium, from the extra 'test'")

from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys

Page = Any  # conftest.py
LAPTOP, WIDE, PHONE = (1280, 800), (1600, 900), (390, 844)
HOSTILE = "</script><script>window.broken = 1</script><img src=x onerror='window.broken = 2'>"


def metrics_of(run_directory: Path, key: str) -> list[float]:
    """Return the values a metric has in the table's rows: one of two equal outputs counts once."""
    runs = json.loads((run_directory / "metrics.json").read_text())["runs"]
    shown = {run["estimator"]: run["metrics"][key] for run in runs}
    return [value for value in shown.values() if value is not None]


def test_a_click_on_a_header_sorts_and_a_second_one_turns_around(page: Page, single: Path, run_directory: Path) -> None:
    page.open(single)
    ascending = sorted(metrics_of(run_directory, "ate_se3_m"))
    header = "th[data-key='ate_se3_m']"
    for direction, values in (("ascending", ascending), ("descending", ascending[::-1])):
        page.click(f"{header} button")
        assert page.find(header).get_attribute("aria-sort") == direction
        shown = page.column("ate_se3_m")
        assert [float(value) for value in shown if value is not None] == values
        assert shown[-1] is None  # what is missing stays last, whichever way
    assert len(page.all("th[aria-sort='ascending'], th[aria-sort='descending']")) == 1


def test_numbers_print_as_in_the_table_of_the_command(page: Page, single: Path) -> None:
    page.open(single)
    page.click(".summary .quiet")
    metrics = {metric.key: metric for metric in known_metrics()}
    keys = [head.get_attribute("data-key") for head in page.all(".summary thead th")]
    script = "return [...document.querySelectorAll('.summary td[data-value]')].map((td) => "
    given = page.run(f"{script}[td.cellIndex, td.dataset.value, td.firstChild.data])")
    shown = [(keys[column], float(value), text) for column, value, text in given if keys[column] in metrics]
    assert {abs(value) < 0.1 for _, value, _ in shown} == {True, False}
    units = {key: unit_of(metrics[key], [value for other, value, _ in shown if other == key]) for key, _, _ in shown}
    for key, value, text in shown:
        expected = cell(value, metrics[key], units[key]).replace("e+0", "e").replace("e+", "e")
        assert text.replace("\N{MINUS SIGN}", "-") == expected, key


def test_a_missing_value_is_a_dash_with_its_reason(page: Page, single: Path) -> None:
    page.open(single)
    cell = page.into_view("tbody tr:last-child td.missing")
    assert cell.text.startswith("\N{EN DASH}")
    assert "the run gave no trajectory" in cell.get_attribute("textContent")
    ActionChains(page.driver).move_to_element(cell).perform()
    assert "the run gave no trajectory" in page.find(".hint").text


@pytest.mark.parametrize("how", ["click", "keyboard"])
def test_an_estimator_can_be_switched_off_everywhere(page: Page, single: Path, how: str) -> None:
    page.open(single)
    views = ("canvas[data-view='top']", "canvas[data-view='orbit']", "canvas[data-chart^='Position error']")
    before = [page.picture(view) for view in views]
    chip = ".chip[data-line='steady both']"
    if how == "click":
        page.click(chip)
        ActionChains(page.driver).move_by_offset(0, 200).perform()  # or it stays pointed at
    else:
        page.press(chip, Keys.SPACE)
        page.run("document.activeElement.blur()")
    assert page.find(chip).get_attribute("aria-pressed") == "false"
    assert all(page.picture(view) != picture for view, picture in zip(views, before, strict=True))
    assert "off" in page.find("tbody tr").get_attribute("class")
    page.press(".chip.plain", Keys.ENTER)
    page.run("document.activeElement.blur()")
    assert [page.picture(view) for view in views] == before


def test_the_theme_follows_the_system_and_the_button(page: Page, single: Path) -> None:
    def background() -> tuple[int, ...]:
        colour: str = page.run("return getComputedStyle(document.body).backgroundColor")
        return tuple(int(part) for part in colour[4:-1].split(","))

    page.open(single, scheme="dark")
    assert max(background()) < 64
    dark = page.picture("canvas[data-view='top']")
    page.press("button.theme", Keys.ENTER)
    assert page.picture("canvas[data-view='top']") != dark
    page.driver.refresh()
    assert min(background()) > 192  # it is remembered


@pytest.mark.parametrize("size", [PHONE, (320, 568), LAPTOP])
@pytest.mark.parametrize("which", ["single", "several"])
def test_no_page_is_wider_than_its_screen(
    page: Page, request: pytest.FixtureRequest, which: str, size: tuple[int, int]
) -> None:
    page.open(request.getfixturevalue(which), size)
    page.click(".summary .quiet")  # every metric: the table scrolls in itself
    assert page.run("return document.documentElement.scrollWidth") <= size[0]
    assert page.run("return document.querySelector('.table-frame').scrollWidth") > 390


def test_whatever_can_be_used_has_a_name_and_a_visible_focus(page: Page, single: Path) -> None:
    page.open(single)
    page.click(".summary .quiet")
    nameless = page.run(
        "return [...document.querySelectorAll('button, select, input, a, summary, [tabindex]')].filter((e) => !("
        "e.getAttribute('aria-label') || e.textContent.trim() || e.closest('label')?.textContent.trim()))"
        ".map((e) => e.outerHTML)"
    )
    assert nameless == []
    reached = set()
    page.run("document.activeElement.blur(); window.scrollTo(0, 0)")
    for _ in range(90):
        ActionChains(page.driver).send_keys(Keys.TAB).perform()
        outline = page.run("return getComputedStyle(document.activeElement).outlineStyle")
        kind = page.run("const e = document.activeElement; return e.dataset.view ?? e.type ?? e.tagName.toLowerCase()")
        if kind == "body":
            break
        assert outline != "none", kind
        reached.add(kind)
    assert {"button", "select-one", "range", "top", "orbit", "summary"} <= reached


def test_a_hostile_name_runs_nothing(page: Page, run_called: Callable[[str], Path], tmp_path: Path) -> None:
    write_html([run_called(HOSTILE)], tmp_path / "page.html")
    page.open(tmp_path / "page.html")
    assert page.find("h1").text == HOSTILE
    assert page.run("return window.broken === undefined")
    assert page.run("return document.querySelectorAll('img').length") == 0
