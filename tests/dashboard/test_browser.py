"""The dashboard in a real browser."""

from __future__ import annotations

import shutil
import signal
import sqlite3
from contextlib import closing

import pytest
from conftest import add_toy, crashes_on_loop
from served import served

from crashhunt.base.integrity import digest_of_row
from crashhunt.ledger import Ledger

pytestmark = pytest.mark.long
STRANGE = "<img src=x onerror='window.hacked=1'><script>window.hacked=1</script>&amp;"


@pytest.fixture
def hunts(shell, made_once):
    return made_once(crashes_on_loop, shell).folder / "runs"


def ended(process) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    process.communicate(timeout=120)


@pytest.mark.nightly  # by day, test_control.py starts commands from the page
def test_a_hunt_that_is_started_while_the_page_is_open_appears_and_its_crash_plays(shell, page):
    root = shell.folder / "empty"
    root.mkdir()
    with served(root) as dashboard:
        page.open(dashboard.url)
        assert "No hunt yet" in page.text("main")
        assert "crashhunt run" in page.text("main")
        page.run("window.same = true")
        words = ("--scenario", "toy", "--arg", "speed=14:20", "--seed", "1", "--keep-going")
        hunt = add_toy(shell).begin("run", "empty/new", "1", "3", "99", *words)
        try:
            page.wait("document.querySelector('tbody a')?.innerText === 'new'")
            assert page.run("return document.getElementById('begin').hidden")
            page.run("document.querySelector('tbody a').click()")
            page.wait("location.pathname.startsWith('/hunts/') && document.querySelector('h1').innerText === 'new'")
            page.run("window.same = true")
            page.wait("document.querySelector('#crashes a')")  # the crash arrives
            assert page.run("return window.same")  # without a reload
            page.run("document.querySelector('#crashes a').click()")
            page.wait("window.crashhuntView?.crash")
            page.run("document.getElementById('rate').value = '20'; document.getElementById('play').click()")
            page.wait("crashhuntView.step === crashhuntView.crash.steps - 1 && !crashhuntView.playing")
            assert page.run("return crashhuntView.frames") > 2
        finally:
            ended(hunt)
    assert page.faults() == []


def test_texts_of_strangers_are_text_on_every_page(hunts, page):
    one = hunts / STRANGE.replace("/", "\u2215")
    shutil.move(hunts / "one", one)
    settings = one / "hunt.toml"
    text = settings.read_text().replace("crashhunt.agents:KeepLaneWithSpeed", STRANGE)
    text = text.replace("keep_going = true", "keep_going = false")
    settings.write_text(text.replace('scenario = "loop"', f'scenario = "{STRANGE}"'))
    (one / "run.log").write_text(STRANGE)
    with closing(sqlite3.connect(one / "ledger.sqlite")) as database, database:
        (kinds,) = database.execute("SELECT value FROM hunt WHERE key = 'kinds'").fetchone()
        row = ("kinds", kinds.replace('"words": "', f'"words": "{STRANGE}'))
        database.execute("UPDATE hunt SET value = ?, digest = ? WHERE key = ?", (row[1], digest_of_row(row), "kinds"))
    with closing(Ledger(one / "ledger.sqlite", writable=True)) as ledger:
        ledger.note(notices=[f"a notice {STRANGE}"])
    shutil.copytree(one, hunts / "two")
    page.size(360, 900)
    with served(hunts) as dashboard:
        rows = dashboard.hunts()
        row = rows[one.name]
        assert row["agents"]["ego"] == STRANGE
        crash = dashboard.get(f"/api/hunts/{row['id']}/crashes")["crashes"][0]["id"]
        address = f"{dashboard.url}/hunts/{row['id']}"
        for url, expected in (
            (dashboard.url, STRANGE),
            (address, STRANGE),
            (f"{address}/crashes/{crash}", "onerror"),
            (f"{dashboard.url}/compare?hunts={row['id']},{rows['two']['id']}", "onerror"),
        ):
            page.open(url)
            page.wait("document.body.innerText.includes(arguments[0])", expected)
            assert url != address or page.text("#notices") == f"a notice {STRANGE}"
            assert page.run("return window.hacked") is None
            assert page.run("return document.querySelectorAll('img, main script').length") == 0
            assert page.run("return document.documentElement.scrollWidth") <= 360, url
            if "/compare" in url:  # hunts that stop at their first crash have no estimate
                assert page.run("return document.querySelectorAll('#table tbody td')[3].innerText") == "-"
            if url == dashboard.url:
                assert page.serious() == []  # which takes seconds a page
            assert not page.run("return document.querySelector('.loading').checkVisibility()")
            page.run("delete document.body.dataset.polls; delete document.body.dataset.complete")  # as before an answer
            assert page.run("return document.querySelector('.loading').checkVisibility()")
    assert [fault for fault in page.faults() if "404" not in fault] == []


@pytest.mark.nightly  # by day, the report is driven by keyboard
def test_the_table_of_hunts_is_reached_by_keyboard(hunts, page, shell):
    add_toy(shell).crashhunt("run", str(hunts / "two"), "1", "3", "99", "--scenario", "toy", "--arg", "speed=20")
    with served(hunts) as dashboard:
        page.open(dashboard.url)
        page.wait("document.querySelectorAll('tbody tr').length === 2")
        assert "4\ncrashes\n-\ncrash types" in page.text("#tiles")  # those of `two` are not counted
        page.tab_to("at.id === 'filter'")
        page.keys("two")
        assert page.run("return document.querySelectorAll('tbody tr').length") == 1
        assert "q=two" in page.browser.current_url
        page.browser.refresh()  # the link keeps what was chosen
        page.wait("document.querySelectorAll('tbody tr').length === 1")
        page.run("document.getElementById('filter').focus()")
        page.keys("\ue003" * 3)
        page.tab_to("at.closest('th') && at.innerText === 'Hunt'")
        page.keys("\ue007")
        assert page.run("return document.querySelector('th[aria-sort=ascending]').innerText").startswith("Hunt")
        assert page.run("return [...document.querySelectorAll('tbody a')].map((a) => a.innerText)") == ["one", "two"]
        page.tab_to("at.type === 'checkbox' && at.closest('tbody')")
        page.keys(" ")
        assert page.run("return document.activeElement.checked")
        page.open(f"{dashboard.url}/hunts/{dashboard.hunts()['two']['id']}")
        page.wait("document.getElementById('discovery').data")
        assert page.run("return document.getElementById('discovery')._fullLayout.yaxis.dtick") == 1  # whole crashes
    assert page.faults() == []


@pytest.mark.nightly  # by day, on the pages with texts of strangers, axe on the first of them alone
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious_and_nothing_is_cut_off(hunts, page, scheme):
    shutil.copytree(hunts / "one", hunts / "two")
    with served(hunts) as dashboard:
        page.scheme(scheme)
        rows = dashboard.hunts()
        one = rows["one"]["id"]
        crash = dashboard.get(f"/api/hunts/{one}/crashes")["crashes"][0]["id"]
        both = ",".join(row["id"] for row in rows.values())
        for path in ("/", f"/hunts/{one}", f"/hunts/{one}/crashes/{crash}", f"/compare?hunts={both}"):
            page.open(dashboard.url + path)
            assert page.serious() == [], path
            for width in (360, 800, 2500):
                page.size(width, 900)
                assert page.run("return document.documentElement.scrollWidth") <= width, (path, width)
            page.size(1280, 1000)
    assert page.faults() == []


@pytest.mark.nightly
def test_the_page_of_a_deleted_hunt_reports_that_it_is_gone(hunts, page):
    with served(hunts) as dashboard:
        page.open(f"{dashboard.url}/hunts/{dashboard.hunts()['one']['id']}")
        page.wait("document.body.dataset.complete === 'true'")
        shutil.rmtree(hunts / "one")
        page.wait("!document.getElementById('banner').hidden")
        assert "not there (any more)" in page.text("#banner")
        assert page.text("#state") == "gone"
        page.open(dashboard.url)
        page.wait("!document.getElementById('begin').hidden")


def test_the_page_reports_that_the_dashboard_has_ended(hunts, page):
    with served(hunts) as dashboard:
        page.open(dashboard.url)
    page.wait("!document.getElementById('banner').hidden")
    assert "does not answer" in page.text("#banner")


@pytest.mark.nightly  # by day, test_trials.py compares what the API returns
def test_charts_draw_what_the_api_returns(hunts, page):
    with served(hunts) as dashboard:
        identifier = dashboard.hunts()["one"]["id"]
        page.open(f"{dashboard.url}/hunts/{identifier}?across=speed&up=vehicles")
        page.wait("document.getElementById('scatter').data && document.getElementById('map').data")
        points = dashboard.get(f"/api/hunts/{identifier}/trials")["points"]
        drawn = page.run(
            "const dots = (one) => one.customdata.map((number, i) => [number, one.x[i], one.y[i]]);"
            "return document.getElementById('scatter').data.flatMap(dots)"
        )
        assert sorted(drawn) == sorted(
            [point["number"], point["values"]["speed"], point["values"]["vehicles"]] for point in points
        )
        curve = page.run("const [c] = document.getElementById('discovery').data; return [c.x, c.y]")
        detail = dashboard.get(f"/api/hunts/{identifier}")
        assert curve == [[one[0] for one in detail["curve"]], [one[2] for one in detail["curve"]]]
        page.wait("!document.getElementById('near-box').hidden")  # their places come later: they need the logs
        where = dashboard.get(f"/api/hunts/{identifier}/map")
        drawn = "document.getElementById('map').data.filter((t) => t.customdata).flatMap((t) => t.customdata)"
        crashed = [point["id"] for point in where["points"] if not point["near_miss"]]
        assert sorted(page.run(f"return {drawn}")) == sorted(crashed)
        page.run("document.getElementById('near').click(); document.getElementById('map').scrollIntoView()")
        page.wait(f"{drawn}.length === {len(where['points'])}")
        assert sorted(page.run(f"return {drawn}")) == sorted(point["id"] for point in where["points"])
        assert where["lanes"]


@pytest.mark.nightly
def test_charts_out_of_sight_are_drawn_when_they_come_near(hunts, page):
    with served(hunts) as dashboard:
        page.size(1280, 1200)
        page.open(f"{dashboard.url}/hunts/{dashboard.hunts()['one']['id']}")
        assert page.run("return document.getElementById('discovery').data.length > 0")
        page.wait("document.getElementById('map').data")  # never drawn before: without scrolling, when there is time
        page.run(
            "window.jobs = []; import('/static/common.js').then(({ drawWhenNear }) => {"
            "for (const id of ['discovery', 'map'])"
            "for (const turn of [1, 2]) drawWhenNear(document.getElementById(id), () => jobs.push(id + turn)); })"
        )
        page.wait("jobs.length >= 2")
        assert page.run("return jobs") == ["discovery1", "discovery2"]
        page.run("document.getElementById('map').scrollIntoView()")
        page.wait("jobs.includes('map2')")
        assert page.run("return jobs.filter((one) => one.startsWith('map'))") == ["map2"]  # the last data alone
