"""The report in a real browser, from ``file://``."""

from __future__ import annotations

import json
import shlex
from contextlib import closing
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import crashes_on_loop, wait_for

from crashhunt.base import layout
from crashhunt.base.text import format_number
from crashhunt.crashes import list_bundles, list_near_misses
from crashhunt.ledger import Ledger
from crashhunt.report import describe_running
from crashhunt.report._player_layers import packed_floats
from crashhunt.results import HuntResults, hunt_state

selenium = pytest.importorskip("selenium")
from selenium import webdriver  # noqa: E402
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402

if TYPE_CHECKING:
    from pathlib import Path


def reported(shell):
    (shell.folder / "runs" / "one").rename(shell.folder / "<b>bold&")
    with closing(Ledger(shell.folder / "<b>bold&" / layout.LEDGER, writable=True)) as ledger:
        ledger.note(notices=["SUMO omits <b>"])
    (shell.folder / "report.json").write_text(shell.crashhunt("report", "<b>bold&", "--json").out)


@pytest.fixture
def hunt(shell, made_once):
    """Three real crashes and their report, in a directory whose name would be markup."""
    return made_once(reported, made_once(crashes_on_loop, shell))


def opened(browser, path: Path) -> None:
    browser.get(path.as_uri())
    wait_for(lambda: browser.execute_script("return crashhuntView.crash !== null"))


def report_of(hunt, browser) -> dict[str, Any]:
    """Open the report of the hunt, and return what its command said."""
    done: dict[str, Any] = json.loads((hunt.folder / "report.json").read_text())
    opened(browser, hunt.folder / done["file"])
    return done


def step(browser) -> int:
    return browser.execute_script("return crashhuntView.step")


def text(browser, name: str) -> str:
    return browser.find_element(By.ID, name).text


def test_the_hunt_and_its_crashes_are_shown(hunt, browser):
    done = report_of(hunt, browser)
    bundles, near = list_bundles(hunt.folder / "<b>bold&"), list_near_misses(hunt.folder / "<b>bold&")
    assert text(browser, "title") == "<b>bold&"  # as text, not as markup
    assert text(browser, "notices") == "SUMO omits <b>"
    assert text(browser, "tiles").split("\n")[:4] == ["5 of 5", "trials", str(len(bundles)), "crashes"]
    assert "collision" in text(browser, "outcomes")
    rate = hunt_state(hunt.folder / "<b>bold&").rate
    assert text(browser, "crash-rate") == describe_running(rate).removeprefix("crash rate: ")
    assert browser.find_element(By.CSS_SELECTOR, "#crash-rate-scale .certain").size["width"] > 2
    listed = browser.find_elements(By.CSS_SELECTOR, "#list button")
    assert sorted(button.text.split("\n")[0] for button in listed) == [one.id for one in near + bundles]
    assert [bundle["id"] for bundle in page_data(browser)["crashes"]] == [*done["crashes"], near[0].id]
    browser.find_element(By.XPATH, "//summary[.='The trial']").click()
    facts = browser.find_element(By.XPATH, "//details[summary='The trial']").text
    for words in (
        "crash type\n",
        " in this hunt)",
        f"--code current --crash {done['crashes'][0]}",
        "crashhunt export DIR ",
    ):
        assert words in facts

    # It opens with the animation.
    box = browser.execute_script("return document.getElementById('scene').getBoundingClientRect()")
    assert box["top"] < 400
    assert text(browser, "subtitle").startswith("3 crashes in 5 trials; scenario loop")
    order = browser.execute_script("return [...document.querySelectorAll('h2')].map((one) => one.textContent)")
    first = ("Crashes and near misses", "Crash types", "The hunt in numbers", "Crash rate")
    assert [order.index(one) for one in first] == [0, 1, 2, 4]

    # The scene on the canvas is the one of the log.
    for number, crash in enumerate(done["crashes"][:2]):
        listed[number].click()
        wait_for(lambda crash=crash: text(browser, "summary").startswith(crash))
        bundle = next(bundle for bundle in bundles if bundle.id == crash)
        recording = bundle.recording()
        assert browser.execute_script("return crashhuntView.crash.steps") == recording.steps + 1
        for at in (0, recording.steps):
            browser.execute_script(f"go({at})")
            scene = recording.scene(at)
            row = scene.roster.index["ego"]
            shown = browser.execute_script("return state(crashhuntView.step, crashhuntView.agent)")
            origin = browser.execute_script("return crashhuntView.crash.origin")
            assert np.array(shown[:2]) + origin == pytest.approx(scene.data[row, :2], abs=1e-3)
            assert shown[2:] == pytest.approx(scene.data[row, 2:], rel=1e-6)
        # The ego is in the middle, in its colour.
        pixel = browser.execute_script(
            "const c = document.getElementById('scene'), r = window.devicePixelRatio, p = crashhuntView.scale;"
            "return [...c.getContext('2d').getImageData(c.width / 2 - 1.0 * p * Math.cos(arguments[0]) * r,"
            "c.height / 2 + 1.0 * p * Math.sin(arguments[0]) * r, 1, 1).data]",
            float(scene.headings[row]),
        )
        assert pixel[:3] == [0xFF, 0xB3, 0x1A]
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


def test_obstacles_are_drawn_as_areas_below_the_actors(hunt, browser):
    report_of(hunt, browser)
    x, y = browser.execute_script("view.follow = true; go(5); return [view.x, view.y]")
    house = [(x + along, y + across) for along, across in ((-20, -6), (20, -6), (20, 6), (-20, 6))]

    def colour(along, across):
        return browser.execute_script(
            "const c = document.getElementById('scene'), p = view.scale * window.devicePixelRatio;"
            "return [...c.getContext('2d').getImageData("
            "c.width / 2 + arguments[0] * p, c.height / 2 - arguments[1] * p, 1, 1).data].slice(0, 3)",
            along, across,
        )  # fmt: skip

    places = ((-12.0, 5.0), (-12.0, -5.0), (-12.0, 7.0))
    before = [colour(*place) for place in places]
    browser.execute_async_script(
        "const done = arguments[1]; view.crash.obstacles = [arguments[0]]; view.crash.values = null;"
        "load(view.crash).then(() => { drawScene(); done(); })",
        packed_floats(np.array(house)),
    )
    assert [colour(*place) for place in places] == [[0xC4, 0xBA, 0xB0], [0xC4, 0xBA, 0xB0], before[2]]
    assert before[0] != [0xC4, 0xBA, 0xB0]


def test_curves_are_those_of_the_recording_for_both_vehicles(hunt, browser):
    done = report_of(hunt, browser)
    (bundle,) = (one for one in list_bundles(hunt.folder / "<b>bold&") if one.id == done["crashes"][0])
    recording, other = bundle.recording(), bundle.result.collision.other
    dt = recording.prologue.step_length_s
    for name, speeds, pulls in (("ego", "speeds", "pulls"), (other, "otherSpeeds", "otherPulls")):
        scenes = recording.scenes()
        rows = [scene.roster.index.get(name) for scene in scenes]
        truth = np.array(
            [np.nan if row is None else scene.speeds[row] for row, scene in zip(rows, scenes, strict=True)]
        )
        shown = [
            browser.execute_script(f"return [...crashhuntView.crash.{key}].map(String)") for key in (speeds, pulls)
        ]
        assert np.array(shown[0], dtype=float) == pytest.approx(truth, rel=1e-5, nan_ok=True)
        assert np.array(shown[1], dtype=float)[1:] == pytest.approx(np.diff(truth) / dt, abs=1e-3, nan_ok=True)
    titles = browser.execute_script("return crashhuntView.crash.rows.map((row) => `${row.title} ${row.unit}`.trim())")
    assert titles[:5] == [
        f"time to collision with {other} s", f"gap to {other} m", "speed m/s", "acceleration m/s²", "criticality",
    ]  # fmt: skip
    assert "action: target_speed" in titles
    never = browser.execute_script(
        "const crash = { ...crashhuntView.crash, ttcs: crashhuntView.crash.ttcs.map(() => Infinity) };"
        "return rowsOf(crash).map((row) => `${row.title} ${row.unit}`.trim())"
    )
    assert never == titles[1:]  # a row without a value is not shown
    # Each row has room for its title, its axis and its curve, and the tip has the values of all.
    assert browser.execute_script("return document.getElementById('plot').clientHeight") >= 60 * len(titles)
    browser.execute_script(
        "const plot = document.getElementById('plot'), box = plot.getBoundingClientRect();"
        "plot.dispatchEvent(new PointerEvent('pointermove', { clientX: box.right - 13, clientY: box.top + 30 }))"
    )
    told = browser.execute_script("return document.getElementById('tip').textContent")
    for word in (f"step {recording.steps}", "speed ", f"speed of {other} ", "acceleration ", "criticality", "gap to "):
        assert word in told


def test_last_avoidable_step_is_one_click_away_and_shows_where_braking_leads(hunt, browser):
    report_of(hunt, browser)
    avoidable = next((number for number, crash in enumerate(page_data(browser)["crashes"]) if crash["avoidable"]), None)
    assert avoidable is not None
    browser.find_elements(By.CSS_SELECTOR, "#list button")[avoidable].click()
    crash = page_data(browser)["crashes"][avoidable]
    wait_for(lambda: text(browser, "summary").startswith(crash["id"]))
    bundle = next(one for one in list_bundles(hunt.folder / "<b>bold&") if one.id == crash["id"])
    from_step, how, braking = crash["avoidable"]
    assert (from_step, how, braking) == (bundle.result.escape.step, "brakes", bundle.result.escape.braking)
    browser.find_element(By.ID, "avoidable").click()
    assert step(browser) == from_step
    assert text(browser, "avoidable-words").startswith(f"Last avoidable step: {from_step}. ")
    assert browser.execute_script("return ghostOf(crashhuntView.step)") is None
    # The way that braking takes, along the recorded one.
    recording = bundle.recording()
    ways = [scene.points[scene.roster.index["ego"]] for scene in recording.scenes()[from_step:]]
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(np.array(ways), axis=0).T))])
    speed = recording.scene(from_step).speeds[recording.scene(from_step).roster.index["ego"]]
    later = recording.steps - from_step
    time_s = min(later * recording.prologue.step_length_s, speed / braking)
    driven = speed * time_s - braking * time_s**2 / 2
    expected = [np.interp(driven, along, np.array(ways)[:, axis]) for axis in (0, 1)]
    ghost = browser.execute_script(f"return ghostOf({recording.steps})")
    origin = browser.execute_script("return crashhuntView.crash.origin")
    assert np.array(ghost[:2]) + origin == pytest.approx(expected, abs=0.02)
    assert driven < along[-1]


def page_data(browser):
    return json.loads(browser.execute_script("return document.getElementById('data').textContent"))


def test_observed_matrix_of_a_step_is_that_of_the_recording(hunt, browser):
    report_of(hunt, browser)
    shown = browser.execute_script("return crashhuntView.crash.id")
    recording = next(one for one in list_bundles(hunt.folder / "<b>bold&") if one.id == shown).recording()
    browser.execute_script("document.getElementById('seen-box').open = true; go(crashhuntView.crash.steps - 4)")
    wait_for(lambda: text(browser, "seen"))
    names, *rows = (line.split() for line in text(browser, "seen").splitlines())
    seen = recording.all_steps[step(browser) + 1].observations["ego"]  # with which the next step was decided
    assert names == ["row", "presence", "x", "y", "vx", "vy", "cos_h", "sin_h"]
    values = np.array([[float(cell.replace(",", "")) for cell in row[1:]] for row in rows])
    assert len(values) >= 2
    assert values == pytest.approx(seen[[int(row[0]) for row in rows]], rel=6e-3, abs=1e-4)
    browser.execute_script("go(crashhuntView.crash.steps - 1)")
    assert text(browser, "seen").startswith("no observation is shown at this step; those of steps ")


def test_it_is_driven_by_keyboard_and_plays(hunt, browser):
    report_of(hunt, browser)
    body = browser.find_element(By.TAG_NAME, "body")
    last = browser.execute_script("return crashhuntView.crash.steps") - 1
    body.send_keys(Keys.HOME)
    assert step(browser) == 0
    body.send_keys(Keys.ARROW_RIGHT)
    body.send_keys(Keys.SHIFT + Keys.ARROW_RIGHT)
    assert step(browser) == min(11, last)
    body.send_keys(Keys.NULL, Keys.ARROW_LEFT)
    assert step(browser) == min(11, last) - 1
    body.send_keys(Keys.END)
    assert step(browser) == last
    assert f"step {last} of {last}" in text(browser, "now")
    body.send_keys(Keys.HOME)
    browser.execute_script("document.getElementById('rate').value = '20'")
    body.send_keys(" ")
    wait_for(lambda: step(browser) == last and not browser.execute_script("return crashhuntView.playing"))
    before = browser.execute_script("return crashhuntView.scale")
    body.send_keys("+")
    assert browser.execute_script("return crashhuntView.scale") > before
    follow = browser.find_element(By.ID, "follow")
    assert follow.get_attribute("aria-pressed") == "true"
    body.send_keys("f")
    assert follow.get_attribute("aria-pressed") == "false"
    browser.execute_script(
        "const s = document.getElementById('scrub'); s.value = 3; s.dispatchEvent(new Event('input'))"
    )
    assert step(browser) == 3
    check_contrast(browser, "light")
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [DARK]})
    check_contrast(browser, "dark")


@pytest.mark.nightly
def test_dots_say_which_trial_they_are_and_lead_to_it(hunt, browser):
    hunt.crashhunt("report", "<b>bold&", "-o", "report.html")
    opened(browser, hunt.folder / "report.html")
    names = browser.execute_script("return PLOTS.map((plot) => [plot.name, labelOf(plot.name)])")
    assert ["speed", "speed (m/s)"] in names
    trials = {trial["number"]: trial for trial in page_data(browser)["trials"]}

    # By keyboard: from the lowest value on, with everything that there is to know.
    canvas = browser.find_element(By.CSS_SELECTOR, "#plots canvas")
    browser.execute_script("arguments[0].focus()", canvas)
    canvas.send_keys(Keys.ARROW_RIGHT)
    lowest = min(trials.values(), key=lambda trial: trial["values"][names[0][0]])
    told = text(browser, "tip")
    assert told.startswith(f"trial {lowest['number']}: {lowest['outcome']}")
    assert f"speed {format_number(lowest['values']['speed'])} m/s" in told
    canvas.send_keys(Keys.END)
    highest = max(trials.values(), key=lambda trial: trial["values"][names[0][0]])
    assert text(browser, "tip").startswith(f"trial {highest['number']}:")
    canvas.send_keys(Keys.ENTER)
    wait_for(lambda: text(browser, "summary").startswith(f"{highest['number']:06d}-"))
    assert not browser.find_element(By.ID, "tip").is_displayed()

    # By pointer: over the dot, and beside it.
    dot = browser.execute_script("return [PLOTS[0].dots[0].x, PLOTS[0].dots[0].y, PLOTS[0].dots[0].trial.number]")
    middle = [canvas.size["width"] / 2, canvas.size["height"] / 2]
    at = [round(dot[0] - middle[0]), round(dot[1] - middle[1])]
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", canvas)
    webdriver.ActionChains(browser).move_to_element_with_offset(canvas, *at).perform()
    assert text(browser, "tip").startswith(f"trial {dot[2]}:")
    webdriver.ActionChains(browser).move_to_element_with_offset(canvas, 0, round(middle[1]) - 40).perform()
    assert not browser.find_element(By.ID, "tip").is_displayed()
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


@pytest.fixture
def telephone(browser):
    size = {"width": 375, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    yield browser
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


@pytest.mark.nightly
def test_nothing_is_wider_than_a_telephone(hunt, telephone):
    hunt.crashhunt("report", "<b>bold&", "-o", "report.html")
    opened(telephone, hunt.folder / "report.html")
    assert telephone.execute_script("return document.documentElement.scrollWidth") == 375
    long = f"a{'-very' * 20}-long-name"
    (hunt.folder / "<b>bold&").rename(hunt.folder / long)
    hunt.crashhunt("compare", long, long, "--html", "compare.html")
    telephone.get((hunt.folder / "compare.html").as_uri())
    assert telephone.execute_script("return document.documentElement.scrollWidth") == 375
    labels = [label.text for label in telephone.find_elements(By.CSS_SELECTOR, "svg text")]
    assert {"speed (m/s)", "crash rate per trial"} <= set(labels)


DARK = {"name": "prefers-color-scheme", "value": "dark"}


def check_contrast(browser, scheme) -> None:
    colors = browser.execute_script(
        "const s = getComputedStyle(document.body);"
        "return [s.color, s.backgroundColor].map((c) => c.match(/\\d+/g).slice(0, 3).map(Number))"
    )
    bright = [contrast_part(color) for color in colors]
    assert (bright[1] > 0.5) == (scheme == "light")
    assert (max(bright) + 0.05) / (min(bright) + 0.05) > 7  # WCAG AAA


def contrast_part(color) -> float:
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in (value / 255 for value in color)]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.nightly  # by day, the report of a hunt with collisions is read
def test_software_faults_exports_and_hunts_without_crashes(toy, browser):
    shell = toy
    shell.crashhunt("run", "h", "1", "1", "100", "--scenario", "toy", "--agent", "faulty:Raises")
    shell.crashhunt("export", "h", "one crash.zip")
    done = shell.crashhunt("report", "one crash.zip", "--json").json
    assert done["file"] == "one crash.zip.html"
    opened(browser, shell.folder / done["file"])
    assert "ValueError: no plan" in text(browser, "words")
    shell.crashhunt("run", "calm", "1", "2", "50", "--scenario", "toy", "--arg", "speed=5", "--crash-on", "hang")
    shell.crashhunt("report", "calm")
    browser.get((shell.folder / "calm" / "report.html").as_uri())
    assert text(browser, "tiles").startswith("2 of 2")
    assert not browser.find_element(By.ID, "crashes-section").is_displayed()
    # A trial without a crash can be tried again, with what it was given.
    browser.execute_script("pick(PLOTS[0].dots[0])")
    trial = browser.execute_script("return PLOTS[0].dots[0].trial")
    command = browser.find_element(By.CSS_SELECTOR, "#picked code").text
    assert shlex.split(command)[:6] == ["crashhunt", "run", "again", "0", "100", "50"]
    assert f"--set gap_m={trial['values']['gap_m']}" in command
    words = shlex.split(command.replace("run again 0 100 50", "run again 1 1 50"))
    shell.crashhunt(*words[1:])
    (result,) = HuntResults(shell.folder / "again").results()
    assert {**result.spec.arguments["ego"], **result.spec.scenario_arguments} == trial["values"]
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


def test_mistakes_are_one_line(hunt):
    for words in (
        ("gone",),
        ("<b>bold&", "-o", "missing/r.html"),
        ("<b>bold&", "--crashes", "-1"),
        ("<b>bold&", "--crash", "9"),
    ):
        refused = hunt.crashhunt("report", *words, expect=2)
        assert len(refused.err.strip().splitlines()) == 1
    assert hunt.crashhunt("report", "<b>bold&", "--crashes", "1", "--json").json["crashes"] == [shortest(hunt)]


def shortest(hunt) -> str:
    bundles = list_bundles(hunt.folder / "<b>bold&")
    return min(bundles, key=lambda bundle: (bundle.result.steps, bundle.result.spec.number)).id


def test_click_on_vehicle_shows_its_facts_and_click_on_road_hides_them(hunt, browser):
    report_of(hunt, browser)
    click = (
        "const box = document.getElementById('scene').getBoundingClientRect();"
        "for (const kind of ['pointerdown', 'pointerup'])"
        "document.getElementById('scene').dispatchEvent(new PointerEvent("
        "kind, {clientX: box.left + box.width / 2 + arguments[0], clientY: box.top + box.height / 2 + arguments[1],"
        "pointerId: 1, bubbles: true}));"
    )
    browser.execute_script("document.getElementById('scene').setPointerCapture = () => {}; view.follow = true; go(9)")
    browser.execute_script(click, 0, 0)
    words = text(browser, "vehicle-facts").split("\n")
    assert words[:2] == ["vehicle", "ego"]
    speed = browser.execute_script("return state(view.step, view.agent)[3]")
    assert words[words.index("speed") + 1] == f"{speed:.1f} m/s"
    browser.execute_script(click, 0, 150)
    assert not browser.find_element(By.ID, "vehicle").is_displayed()
    browser.find_element(By.ID, "scene").send_keys("v")
    assert text(browser, "vehicle-facts").split("\n")[1] == "ego"  # the nearest vehicle first


def test_route_and_lights_of_vehicles_are_shown_without_observations(hunt, browser):
    bundle = next(one for one in list_bundles(hunt.folder / "<b>bold&") if one.id == shortest(hunt))
    assert bundle.faults() == []
    lights = json.loads((bundle.path / "lights.json").read_text())
    lit = next(vehicle for vehicle, changes in lights["vehicles"].items() if any(brake for _, brake, _ in changes))
    step, *_ = next(change for change in lights["vehicles"][lit] if change[1])
    report_of(hunt, browser)
    assert browser.find_element(By.ID, "key-route").is_displayed()
    browser.execute_script("view.picked = arguments[0]; go(arguments[1])", lit, step)
    words = text(browser, "vehicle-facts").split("\n")
    assert "brake" in words[words.index("lights") + 1]
    browser.execute_script("go(0)")
    assert "lane goal this lane" in text(browser, "now")
    assert browser.execute_script("const [, route] = until(view.crash.way.routes, 0); return route.length") == 48
