"""The page in a real browser, driven as a reader would: by pointer, by keyboard and on several screens."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from toolkit.report.html import write_html

if TYPE_CHECKING:
    from selenium.webdriver.remote.webelement import WebElement

LAPTOP, PHONE = (1280, 800), (390, 844)
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
        if self.run("const kept = localStorage.length; localStorage.clear(); return kept"):
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
        from selenium.webdriver.common.action_chains import ActionChains

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


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    chromedriver = shutil.which("chromedriver")
    if chromium is None or chromedriver is None:
        pytest.skip("needs Chromium and chromedriver (Debian: apt-get install chromium chromium-driver)")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in (*FLAGS.split(), f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(chromedriver))
    driver.set_script_timeout(60)
    yield driver
    driver.quit()


@pytest.fixture(scope="session")
def single(run_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("pages") / "single.html"
    write_html([run_directory], target)
    return target


@pytest.fixture(scope="session")
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
