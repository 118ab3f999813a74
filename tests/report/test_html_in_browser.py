"""The page in a real browser: it sorts, toggles, moves and zooms by pointer and by keyboard, and fits a phone."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from toolkit.report.html import write_html

webdriver = pytest.importorskip("selenium.webdriver", reason="needs selenium, from the extra 'test'")

from selenium.webdriver.chrome.service import Service  # noqa: E402
from selenium.webdriver.common.action_chains import ActionChains  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402
from selenium.webdriver.remote.webelement import WebElement  # noqa: E402

Json = dict[str, Any]
LAPTOP, WIDE, PHONE = (1280, 800), (1600, 900), (390, 844)
HOSTILE = "</script><script>window.broken = 1</script><img src=x onerror='window.broken = 2'>"
# Away from the network altogether; a container has no sandbox to give.
FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-dev-shm-usage "
    "--disable-background-networking --disable-component-update --disable-sync --disable-extensions"
)


class Page:
    """The page in the browser; every look at it waits until what was changed is drawn."""

    def __init__(self, driver: Any) -> None:
        self.driver = driver

    def open(self, path: Path, size: tuple[int, int] = LAPTOP, *, scheme: str = "light") -> None:
        metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": size == PHONE}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        features = [
            {"name": "prefers-color-scheme", "value": scheme},
            {"name": "prefers-reduced-motion", "value": "reduce"},
        ]
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
        self.driver.get(path.as_uri())
        self.run("localStorage.clear()")
        self.driver.refresh()
        self.settle()

    def settle(self) -> None:
        self.driver.execute_async_script(
            "const next = requestAnimationFrame; const done = arguments[0]; next(() => next(() => next(done)))"
        )

    def run(self, script: str, *arguments: object) -> Any:
        return self.driver.execute_script(script, *arguments)

    def find(self, selector: str) -> WebElement:
        return self.driver.find_element("css selector", selector)

    def all(self, selector: str) -> list[WebElement]:
        return self.driver.find_elements("css selector", selector)

    def into_view(self, selector: str) -> WebElement:
        element = self.find(selector)
        self.run("arguments[0].scrollIntoView({ block: 'center', behavior: 'instant' })", element)
        self.settle()
        return element

    def click(self, selector: str) -> None:
        self.into_view(selector).click()
        self.settle()

    def press(self, selector: str, *keys: str) -> None:
        """Give an element the focus as the Tab key would, and type."""
        self.run("arguments[0].focus()", self.into_view(selector))
        ActionChains(self.driver).send_keys(*keys).perform()
        self.settle()

    def picture(self, selector: str) -> str:
        """Return what a canvas shows."""
        self.settle()
        picture: str = self.run("return arguments[0].toDataURL()", self.find(selector))
        return picture

    def complaints(self) -> list[str]:
        return [entry["message"] for entry in self.driver.get_log("browser")]

    def column(self, key: str) -> list[str | None]:
        """Return the values of a column of the table, exact as they are kept, from the top."""
        script = (
            "const [key] = arguments; const at = [...document.querySelectorAll('thead th')]"
            ".findIndex((th) => th.dataset.key === key);"
            "return [...document.querySelectorAll('tbody tr')].map((tr) => tr.children[at].dataset.value ?? null)"
        )
        values: list[str | None] = self.run(script, key)
        return values


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    chromedriver = shutil.which("chromedriver")
    if chromium is None or chromedriver is None:
        pytest.skip("needs Chromium and chromedriver (Debian: apt-get install chromium chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in (*FLAGS.split(), f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(chromedriver))
    driver.set_script_timeout(60)
    yield driver
    driver.quit()


@pytest.fixture(scope="module")
def single(run_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("pages") / "single.html"
    write_html([run_directory], target)
    return target


@pytest.fixture(scope="module")
def several(run_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("pages") / "several.html"
    write_html([run_directory, run_directory], target)
    return target


@pytest.fixture
def page(browser: Any) -> Iterator[Page]:
    """A page that must not have complained of anything when the test is over."""
    shown = Page(browser)
    shown.complaints()  # what an earlier test left
    yield shown
    assert shown.complaints() == []


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


def test_the_keyboard_sorts_and_keeps_its_place(page: Page, single: Path, run_directory: Path) -> None:
    page.open(single)
    page.press("th[data-key='total_s'] button", Keys.ENTER)
    values = [float(value) for value in page.column("total_s") if value is not None]
    assert values == sorted(metrics_of(run_directory, "total_s"))
    assert page.run("return document.activeElement.closest('th').dataset.key") == "total_s"
    assert "total" in page.find("#announcer").get_attribute("textContent")


def test_all_metrics_can_be_shown(page: Page, single: Path, run_directory: Path) -> None:
    page.open(single)
    assert not page.all("th[data-key='ate_sim3_m']")
    page.click(".summary .quiet")
    shown = [float(value) for value in page.column("ate_sim3_m") if value is not None]
    assert shown == metrics_of(run_directory, "ate_sim3_m")


def test_a_missing_value_is_a_dash_with_its_reason(page: Page, single: Path) -> None:
    page.open(single)
    cell = page.into_view("tbody tr:last-child td.missing")
    assert cell.text.startswith("\N{EN DASH}")
    assert "the run gave no trajectory" in cell.get_attribute("textContent")
    ActionChains(page.driver).move_to_element(cell).perform()
    assert "the run gave no trajectory" in page.find(".hint").text


def test_trouble_is_told_in_words(page: Page, single: Path) -> None:
    page.open(single)
    told = page.find(".trouble").text
    assert "astray diverged" in told
    assert "broken failed" in told
    assert [one.text for one in page.all(".status.bad")] == ["diverged", "failed"]


@pytest.mark.parametrize("how", ["click", "keyboard"])
def test_an_estimator_can_be_switched_off_everywhere(page: Page, single: Path, how: str) -> None:
    page.open(single)
    views = ("canvas[data-view='top']", "canvas[data-view='orbit']", "canvas[data-chart='Position error']")
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
    canvas = "canvas[data-view='top']"
    dark = page.picture(canvas)
    page.press("button.theme", Keys.ENTER)
    assert min(background()) > 192
    assert page.picture(canvas) != dark
    page.driver.refresh()
    assert min(background()) > 192  # it is remembered
    page.open(single, scheme="light")
    assert min(background()) > 192


@pytest.mark.parametrize("size", [PHONE, (320, 568), LAPTOP])
@pytest.mark.parametrize("which", ["single", "several"])
def test_no_page_is_wider_than_its_screen(
    page: Page, request: pytest.FixtureRequest, which: str, size: tuple[int, int]
) -> None:
    page.open(request.getfixturevalue(which), size)
    page.click(".summary .quiet")  # every metric: the table scrolls in itself
    assert page.run("return document.documentElement.scrollWidth") <= size[0]
    assert page.run("return document.querySelector('.table-frame').scrollWidth") > 390


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


def test_the_wheel_zooms_only_where_it_is_asked_to(page: Page, single: Path) -> None:
    page.open(single)
    element = page.into_view("canvas[data-view='top']")
    before = page.picture("canvas[data-view='top']")
    wheel = (
        "arguments[0].dispatchEvent(new WheelEvent('wheel', { deltaY: -200, ctrlKey: arguments[1], cancelable: true }))"
    )
    page.run(wheel, element, False)
    assert page.picture("canvas[data-view='top']") == before
    page.run(wheel, element, True)
    assert page.picture("canvas[data-view='top']") != before


def test_two_fingers_zoom(page: Page, single: Path) -> None:
    page.open(single, PHONE)
    canvas = page.into_view("canvas[data-view='top']")
    before = page.picture("canvas[data-view='top']")
    box = page.run("const b = arguments[0].getBoundingClientRect(); return [b.left + b.width / 2, b.top + 100]", canvas)

    def touch(kind: str, *offsets: int) -> None:
        points = [{"x": box[0] + dx, "y": box[1], "id": i} for i, dx in enumerate(offsets)]
        page.driver.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    touch("touchStart", -20, 20)
    for spread in range(25, 90, 10):
        touch("touchMove", -spread, spread)
    touch("touchEnd")
    assert page.picture("canvas[data-view='top']") != before
    assert page.run("return window.visualViewport.scale") == 1  # the view was zoomed, not the page


def test_one_cursor_moves_every_figure(page: Page, single: Path) -> None:
    page.open(single)
    figures = ("canvas[data-view='top']", "canvas[data-view='orbit']", "canvas[data-chart='Position error']")
    before = [page.picture(figure) for figure in figures]
    page.press(".scrubber input", *[Keys.PAGE_UP] * 3)
    assert all(page.picture(figure) != picture for figure, picture in zip(figures, before, strict=True))
    told = page.find(".readout").text
    assert told.endswith(" m")
    assert float(told.split(" s")[0]) > 0.0
    assert page.find(".scrubber input").get_attribute("aria-valuetext") == told


def test_pointing_at_a_chart_reads_every_line_there(page: Page, single: Path) -> None:
    page.open(single)
    ActionChains(page.driver).move_to_element(page.into_view("canvas[data-chart='Position error']")).perform()
    page.settle()
    told = page.find(".hint").text
    assert all(name in told for name in ("steady", "astray", "late final"))
    assert page.find(".readout").text != "0.0 s, 0 m"


def test_errors_are_over_distance_or_time(page: Page, single: Path) -> None:
    page.open(single)
    chart = "canvas[data-chart='Position error']"
    over_distance = page.picture(chart)
    page.click(".segmented button:last-child")
    assert page.find(".segmented button:last-child").get_attribute("aria-pressed") == "true"
    assert page.picture(chart) != over_distance


def test_landmarks_can_be_left_out(page: Page, single: Path) -> None:
    page.open(single)
    before = page.picture("canvas[data-view='top']")
    page.run("const s = document.querySelector('select'); s.value = ''; s.dispatchEvent(new Event('change'))")
    assert page.picture("canvas[data-view='top']") != before


def test_a_view_can_fill_the_window_and_escape_leaves_it(page: Page, single: Path) -> None:
    page.open(single, PHONE)
    page.press(".view-card .quiet", Keys.ENTER)
    assert page.run("return document.querySelector('.expanded').getBoundingClientRect().height") == PHONE[1]
    ActionChains(page.driver).send_keys(Keys.ESCAPE).perform()
    page.settle()
    assert not page.all(".expanded")
    assert page.run("return document.activeElement.textContent") == "Expand"


def test_several_runs_stand_side_by_side_and_below_each_other_on_a_phone(page: Page, several: Path) -> None:
    def edges() -> list[tuple[float, float]]:
        boxes = page.run(
            "return [...document.querySelectorAll('.cases > .case')].map((c) => c.getBoundingClientRect())"
        )
        return [(box["left"], box["top"]) for box in boxes]

    page.open(several, WIDE)
    left, right = edges()
    assert right[0] > left[0]
    assert right[1] == left[1]
    assert len(page.all("tbody tr")) == 8
    page.open(several, PHONE)
    upper, lower = edges()
    assert lower[0] == upper[0]
    assert lower[1] > upper[1]


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


def test_a_hostile_name_runs_nothing(page: Page, run_directory: Path, tmp_path: Path) -> None:
    shutil.copytree(run_directory, tmp_path / "run")
    for name in ("metrics.json", "report.json", "manifest.json"):
        path = tmp_path / "run" / name
        path.write_text(
            path.read_text().replace('"steady"', json.dumps(HOSTILE)).replace('"drive"', json.dumps(HOSTILE))
        )
    write_html([tmp_path / "run"], tmp_path / "page.html")
    page.open(tmp_path / "page.html")
    assert page.find("h1").text == HOSTILE
    assert page.run("return window.broken === undefined")
    assert page.run("return document.querySelectorAll('img').length") == 0
