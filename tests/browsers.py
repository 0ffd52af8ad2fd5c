"""A page of the report or of the dashboard in a real browser."""

from __future__ import annotations

import os
import shutil
import time
from contextlib import suppress
from importlib import resources
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from pathlib import Path


def needed(*names: str) -> str:
    """Where a program that is no Python package is; without it, the test cannot run, and in CI fails."""
    found = next(filter(None, map(shutil.which, names)), None)
    if found is None:
        (pytest.fail if os.environ.get("CRASHHUNT_TEST_SCREEN") == "required" else pytest.skip)(f"needs {names[0]}")
    return found


class Page:
    """What is open in a browser.

    Args:
        browser: the driver.
    """

    def __init__(self, browser: Any) -> None:
        self.browser = browser

    def open(self, url: str) -> None:
        """Open a page, and wait until it has shown what there is."""
        self.browser.get(url)
        self.wait("document.body.dataset.complete === 'true' || Number(document.body.dataset.polls) > 0")

    def size(self, width: int, height: int) -> None:
        """Set the size of the window, in CSS pixels."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)

    def scheme(self, name: str) -> None:
        """Choose light or dark."""
        features = [{"name": "prefers-color-scheme", "value": name}]
        self.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})

    def run(self, script: str, *given: object) -> Any:
        """Return what a script returns."""
        return self.browser.execute_script(script, *given)

    def wait(self, condition: str, *given: object, seconds: float = 90.0) -> None:
        """Wait until an expression is true."""
        deadline = time.monotonic() + seconds
        while not self.run(f"return Boolean({condition})", *given):
            assert time.monotonic() < deadline, f"{condition}: {self.text('body')[:600]}"
            time.sleep(0.05)

    def text(self, selector: str) -> str:
        """Return the text that people see."""
        return self.run("return document.querySelector(arguments[0]).innerText", selector)

    def faults(self) -> list[str]:
        """Return what the browser complains of."""
        return [entry["message"] for entry in self.browser.get_log("browser") if entry["level"] == "SEVERE"]

    def keys(self, *keys: str) -> None:
        """Type keys where the focus is; an element that was asked for could be replaced before the key arrives."""
        from selenium.webdriver import ActionChains

        ActionChains(self.browser).send_keys(*keys).perform()

    def tab_to(self, condition: str, most: int = 80) -> None:
        """Move the focus with the tabulator until an expression about `at`, where it is, is true."""
        for _ in range(most):
            if self.run(f"const at = document.activeElement; return Boolean({condition})"):
                return
            self.keys("\ue004")
        raise AssertionError(f"the tabulator does not lead to {condition}")

    def serious(self) -> list[str]:
        """Return the serious and critical violations that axe-core finds."""
        folder = resources.files("axe_selenium_python")
        self.run(folder.joinpath("node_modules", "axe-core", "axe.min.js").read_text(encoding="utf-8"))
        found = self.browser.execute_async_script(
            "const done = arguments[0];"
            "axe.run(document, {resultTypes: ['violations']}).then(done, (error) => done(String(error)))"
        )
        assert isinstance(found, dict), found
        return [
            f"{one['id']} ({one['impact']}): {one['help']}; {[node['html'][:160] for node in one['nodes'][:3]]}"
            for one in found["violations"]
            if one["impact"] in ("serious", "critical")
        ]


class Chromium:
    """One Chromium without a window for all tests of a worker; starting it takes seconds.

    Args:
        profile: folder for its profile.
    """

    def __init__(self, profile: Path) -> None:
        self._profile = profile
        self._driver: Any = None

    def driver(self) -> Any:
        """Return the driver of a browser that answers; one that a test has crashed is replaced."""
        from selenium.common.exceptions import SessionNotCreatedException, WebDriverException
        from urllib3.exceptions import HTTPError

        if self._driver is not None:
            try:
                self._driver.get("about:blank")
                return self._driver
            except (WebDriverException, HTTPError, OSError):
                self.quit()
        for number in range(3):  # on a loaded machine, a browser may begin later than its driver waits, a minute
            try:
                self._driver = self._start(f"{self._profile}-{number}")
                break
            except SessionNotCreatedException:
                if number == 2:
                    raise
        return self._driver

    def _start(self, profile: str) -> Any:
        program, driver = needed("chromium", "chromium-browser", "google-chrome"), needed("chromedriver")
        webdriver = pytest.importorskip("selenium.webdriver")
        service = pytest.importorskip("selenium.webdriver.chrome.service")
        options = webdriver.ChromeOptions()
        options.binary_location = program
        for word in (
            "headless=new", "no-sandbox", "disable-gpu", "no-first-run", "disable-background-networking",
            "disable-component-update", "disable-sync", "window-size=1280,1000", "disable-dev-shm-usage",
            f"user-data-dir={profile}",
        ):  # fmt: skip
            options.add_argument(f"--{word}")
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        return webdriver.Chrome(options=options, service=service.Service(driver))

    def quit(self) -> None:
        """End the browser."""
        if self._driver is not None:
            with suppress(Exception):
                self._driver.quit()
        self._driver = None


@pytest.fixture(scope="session")
def chromium(tmp_path_factory):
    """The browser of this worker."""
    found = Chromium(tmp_path_factory.mktemp("chromium"))
    yield found
    found.quit()


@pytest.fixture
def browser(chromium):
    """A browser in an ordinary window and light colours, without what an earlier test has left."""
    opened = chromium.driver()
    opened.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    opened.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    opened.delete_all_cookies()
    opened.get_log("browser")
    yield opened
    opened.get("about:blank")  # ends the requests of the page before its dashboard ends


@pytest.fixture
def page(browser):
    """The page that is open, in an ordinary window and light colours."""
    opened = Page(browser)
    opened.size(1280, 1000)
    opened.scheme("light")
    return opened
