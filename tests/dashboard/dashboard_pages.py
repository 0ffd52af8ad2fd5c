"""A page of the dashboard in a real browser."""

from __future__ import annotations

import time
from importlib import resources
from typing import Any

import pytest
from conftest import needed


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
        """Type keys where the focus is."""
        self.browser.switch_to.active_element.send_keys(*keys)

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


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """Chromium without a window."""
    program, driver = needed("chromium", "chromium-browser", "google-chrome"), needed("chromedriver")
    webdriver = pytest.importorskip("selenium.webdriver")
    service = pytest.importorskip("selenium.webdriver.chrome.service")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    for word in (
        "headless=new", "no-sandbox", "disable-gpu", "no-first-run", "disable-background-networking",
        "disable-component-update", "disable-sync", "window-size=1280,1000", "disable-dev-shm-usage",
        f"user-data-dir={tmp_path_factory.mktemp('chromium')}",
    ):  # fmt: skip
        options.add_argument(f"--{word}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    opened = webdriver.Chrome(options=options, service=service.Service(driver))
    yield opened
    opened.quit()


@pytest.fixture
def page(browser):
    """The page that is open, in an ordinary window and light colours."""
    opened = Page(browser)
    opened.size(1280, 1000)
    opened.scheme("light")
    browser.get_log("browser")
    yield opened
    browser.get("about:blank")
