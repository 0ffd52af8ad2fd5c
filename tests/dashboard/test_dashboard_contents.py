"""The contents of the pages of a hunt and of its crashes, with simple objects in place of hunts."""

from __future__ import annotations

import math
import socket
from pathlib import Path
from types import SimpleNamespace

import pytest
from dashboard_hunts import View

from crashhunt.base import layout, pacing
from crashhunt.base.errors import BundleError, CrashhuntError
from crashhunt.dashboard import _crash_list as _crashes, _details
from crashhunt.dashboard._crash_list import CrashList
from crashhunt.recording import Phase
from crashhunt.report import _page
from crashhunt.trial import Outcome

# Details of a hunt.


def settings(**more):
    given = {
        "scenario": "toy", "agents": {"ego": SimpleNamespace(agent="m:A", arguments={"speed": 1, "gap": 2})},
        "trials": 5, "max_steps": 9, "seed": 7, "sampler": "guided", "crash_on_words": ["hang", "crash"],
        "oracles": ["a", "b"], "disturb": (), "probe": "", "branch": "", "seeds": "", "scenario_arguments": {"cars": 3},
        "run": SimpleNamespace(keep_going=False, near_misses=0, by_cause=False, distinct=0),
    }  # fmt: skip
    return SimpleNamespace(**{**given, **more})


def test_settings_are_in_the_words_of_the_command_line():
    assert _details._settings(settings()) == {
        "scenario": "toy", "agent ego": "m:A", "trials": 5, "max steps": 9, "hunt seed": 7, "sampler": "guided",
        "counts as a crash": "hang, crash", "oracles": "a, b",
    }  # fmt: skip
    run = SimpleNamespace(keep_going=True, near_misses=2, by_cause=True, distinct=4)
    found = _details._settings(settings(trials=0, disturb=("x", "y"), probe="p", branch="b", seeds="1:9", run=run))
    assert {name: value for name, value in found.items() if name not in _details._settings(settings())} == {
        "disturbances": "x, y", "probe": "p", "branch": "b", "seeds": "1:9", "keep going": True,
        "near misses kept": 2, "crash types by cause wanted": 4,
    }  # fmt: skip
    assert found["trials"] == "no limit"
    run.by_cause = False
    assert _details._settings(settings(run=run))["crash types wanted"] == 4


def test_columns_name_the_agent_where_there_are_several():
    assert _details._columns(settings()) == ["speed", "gap", "cars"]
    agents = {"a": SimpleNamespace(arguments={"speed": 1}), "b": SimpleNamespace(arguments={"speed": 1})}
    assert _details._columns(settings(agents=agents)) == ["a.speed", "b.speed", "cars"]


def test_command_is_the_comment_on_the_first_line(tmp_path):
    path = tmp_path / "hunt.toml"
    for text, command in (("# crashhunt run x\nb = 1\n", "crashhunt run x"), ("b = 1\n# later\n", ""), ("", "")):
        path.write_text(text)
        assert _details._command(path) == command
    path.write_text("# " + "x" * 30_000)
    assert len(_details._command(path)) == 19_998
    assert _details._command(tmp_path / "nothing") == ""


def test_detail_of_a_hunt_shows_files_only_where_they_may_be_opened(tmp_path, monkeypatch):
    view = View(path=tmp_path, settings=settings(), events=[(float(n), "s", "w") for n in range(60)])
    view.facts = {"dropped": {"rear end": [1, 2]}, "until_rate": 0.1}
    view.counts = SimpleNamespace(parts=lambda: ["part"], curve=lambda: [[0, 0, 0]])
    view.sample = SimpleNamespace(problems=["odd"])
    (tmp_path / "hunt.toml").write_text("# crashhunt run\n")
    (tmp_path / "run.log").write_text("said\n")
    monkeypatch.setattr(_details, "_workers", lambda view: ["worker"])
    found = _details.detail_of(view)
    assert (found["command"], found["run_log"], found["run_log_of"]) == ("crashhunt run", "said\n", "")
    assert (found["columns"], found["scenario_columns"]) == (["speed", "gap", "cars"], ["cars"])
    assert (found["parts"], found["curve"], found["problems"]) == (["part"], [[0, 0, 0]], ["odd"])
    assert (found["dropped"], found["until_rate"], found["workers"]) == ({"rear end": 2}, 0.1, [])
    assert [event[0] for event in found["events"]] == [float(n) for n in range(10, 60)]
    view.said["state"] = "running"
    assert _details.detail_of(view)["workers"] == ["worker"]
    view.why = "a pipe"
    found = _details.detail_of(view)
    assert (found["command"], found["run_log"]) == ("", "")
    view.settings = view.counts = view.sample = None
    found = _details.detail_of(view)
    for name in ("columns", "scenario_columns", "parts", "curve", "problems"):
        assert found[name] == []
    assert found["settings"] == {}


def test_log_of_a_hunt_is_its_own_or_that_of_its_last_crash(tmp_path):
    view = View(path=tmp_path)
    assert _details._log(view) == ("", "")
    for number, (out, err) in enumerate((("a\n", "b\n"), ("c\n", "d\n"))):
        folder = tmp_path / layout.CRASHES / f"00000{number}-collision"
        folder.mkdir(parents=True)
        (folder / layout.RUN_LOG).write_text(out)
        (folder / layout.ERROR_LOG).write_text(err)
    assert _details._log(view) == ("000001-collision", "c\nd\n")
    (tmp_path / layout.RUN_LOG).write_text("own\n")
    assert _details._log(view) == ("", "own\n")


def test_workers_are_the_running_trials_of_this_hunt(tmp_path, monkeypatch):
    headers = {
        "trial-3": SimpleNamespace(trial=3, step=4, phase=Phase.ACT, started=90.0),
        "trial-1": SimpleNamespace(trial=1, step=-1, phase=Phase.SETUP, started=101.0),
        "trial-2": SimpleNamespace(trial=2, step=9, phase=Phase.DONE, started=0.0),
        "trial-x": SimpleNamespace(trial=7, step=9, phase=Phase.ACT, started=0.0),
        "trial-4": None,
        "trial-5": SimpleNamespace(trial=5, step=0, phase=Phase.SIMULATE, started=99.96),
    }
    for name in headers:
        folder = tmp_path / ".scratch-1" / name
        folder.mkdir(parents=True)
        (folder / layout.BLACK_BOX).write_bytes(b"")
    outside = tmp_path / ".scratch-1" / "trial-6"
    outside.mkdir()
    (outside / layout.BLACK_BOX).symlink_to("/etc/hostname")
    monkeypatch.setattr(_details, "read_header", lambda path: headers[path.parent.name])
    monkeypatch.setattr(_details, "time", SimpleNamespace(monotonic=lambda: 100.0))
    view = View(path=tmp_path, facts={"owner": {"host": socket.gethostname()}})
    assert _details._workers(view) == [
        {"trial": 1, "step": 0, "doing": "sets up the simulator", "since_s": 0.0},
        {"trial": 3, "step": 4, "doing": "the agent decides", "since_s": 10.0},
        {"trial": 5, "step": 0, "doing": "simulates", "since_s": 0.0},
    ]
    for facts in ({"owner": {"host": "far"}}, {}):
        view.facts = facts
        assert {worker["since_s"] for worker in _details._workers(view)} == {None}


def test_importance_is_that_of_trials_that_no_search_has_chosen(monkeypatch):
    monkeypatch.setattr(_details, "importance_of", lambda trials: [dict(values, danger=d) for values, d in trials])
    usual = {"category": "no crash", "danger": 0.25, "origin": "random", "parent": None, "values": {"a": 1}}
    usual["number"] = 7
    points = [
        usual, {**usual, "category": "crash"}, {**usual, "category": "crash", "danger": None},
        {**usual, "danger": None}, {**usual, "parent": 3}, {**usual, "origin": "guided"},
    ]  # fmt: skip
    assert _details.importance_of_points(points) == [
        {"a": 1, "danger": 0.25}, {"a": 1, "danger": 1.0}, {"a": 1, "danger": 1.0}
    ]  # fmt: skip
    assert len(_details.importance_of_points(points, first=7)) == 3
    assert _details.importance_of_points(points, first=8) == []  # trials of earlier code


@pytest.fixture
def comparer(monkeypatch):
    """A comparer on a clock of the test; a comparison takes 2 s."""
    made = _details.HuntComparer()
    made.clock, made.compared = [100.0], []

    def compare(*paths):
        made.compared.append([path.name for path in paths])
        made.clock[0] += 2.0
        if "broken" in made.compared[-1]:
            raise CrashhuntError("broken")
        if "gone" in made.compared[-1]:
            raise FileNotFoundError
        data = {"hunts": [{"dir": str(path), "n": len(made.compared)} for path in paths]}
        pairs = [SimpleNamespace(verdict=f"{paths[-1]} is better than {paths[0]}", caution="few")]
        return SimpleNamespace(to_json=lambda: data, pairs=pairs)

    monkeypatch.setattr(_details, "compare", compare)
    monkeypatch.setattr(pacing, "time", SimpleNamespace(monotonic=lambda: made.clock[0]))
    return made


def test_comparison_names_hunts_as_the_page_does(comparer):
    one, two = View("one"), View("one2")
    two.counts = SimpleNamespace(curve=lambda: [[1, 2, 3]])
    one.said["name"], two.said["name"] = "first", "second"
    found = comparer.compare([one, two])
    assert found["pairs"] == [{"verdict": "second is better than first", "caution": "few"}]
    assert [row["figures"] for row in found["hunts"]] == [{"dir": str(v.path), "n": 1} for v in (one, two)]
    assert [row["curve"] for row in found["hunts"]] == [[], [[1, 2, 3]]]
    assert {row["problem"] for row in found["hunts"]} == {""}
    assert comparer.compare([]) == {"hunts": [], "pairs": []}


def test_comparison_takes_a_twentieth_of_the_time(comparer):
    one, two, three = View("one"), View("two"), View("three")
    comparer.compare([one, two])
    comparer.compare([one, two])  # nothing is new
    assert len(comparer.compared) == 1
    two.said["trials_run"] = 3
    comparer.clock[0] = 102.0 + 2.0 / 0.05 - 0.1
    comparer.compare([one, two])
    assert len(comparer.compared) == 1
    comparer.clock[0] += 0.1
    comparer.compare([one, two])
    assert len(comparer.compared) == 2
    comparer.compare([one, three])  # others are compared at once
    assert comparer.compared[2:] == [["one", "three"]]
    for _ in range(2):  # an error leaves no figures of other hunts
        with pytest.raises(FileNotFoundError):
            comparer.compare([one, View("gone")])


def test_comparison_that_cannot_be_made_states_its_reason(comparer):
    one, two = View("one"), View("broken")
    assert [row["problem"] for row in comparer.compare([one, two])["hunts"]] == ["broken", "broken"]
    one.said["trials_run"], two.said["trials_run"] = 100_000, 100_001
    comparer.clock[0] += 1_000
    (first, _) = comparer.compare([one, two])["hunts"]
    assert first["problem"] == (
        "a comparison reads all trials, of which there are more than 200,000; run: crashhunt compare"
    )
    assert first["figures"] is None
    two.said["trials_run"] = 100_000
    comparer.compare([one, two])
    assert len(comparer.compared) == 2
    third = View("third", why="ledger.sqlite is a pipe")
    one.said["trials_run"] = 5
    assert [row["problem"] for row in comparer.compare([one, third])["hunts"]] == ["ledger.sqlite is a pipe"] * 2


# Crashes of a hunt.


def bundle(name="000003-collision", outcome=Outcome.COLLISION, *, x=1.234, y=-5.678, place="collision", **more):
    at = SimpleNamespace(x=x, y=y)
    result = SimpleNamespace(
        spec=SimpleNamespace(number=3, arguments={"ego": {"speed": 2}}, scenario_arguments={"cars": 3}),
        collision=at if place == "collision" else None, event=at if place == "event" else None, outcome=outcome,
        summary="hits other", steps=12, danger=0.5, disturbed=True,
    )  # fmt: skip
    return SimpleNamespace(
        id=name, result=result, is_near_miss=outcome.category == "no crash", confirmed=True, why_unconfirmed="",
        path=Path("/hunts/one/crashes") / name, added={}, **more,
    )  # fmt: skip


def test_row_of_a_crash_has_its_place_where_it_is_known():
    assert _crashes._summary(bundle()) == {
        "id": "000003-collision", "damaged": "", "near_miss": False, "trial": 3, "outcome": "collision",
        "category": Outcome.COLLISION.category, "summary": "hits other", "steps": 12, "danger": 0.5, "confirmed": True,
        "why_unconfirmed": "", "disturbed": True, "x": 1.23, "y": -5.68,
    }  # fmt: skip
    assert [_crashes._summary(bundle(place="event"))[name] for name in "xy"] == [1.23, -5.68]
    for odd in ({"place": ""}, {"x": math.nan}, {"y": math.inf}):
        assert [_crashes._summary(bundle(**odd))[name] for name in "xy"] == [None, None]
    assert _crashes._summary(bundle(outcome=Outcome.SURVIVED))["near_miss"] is True


def test_analysis_reads_the_log_only_where_it_is_needed(monkeypatch):
    read = []
    monkeypatch.setattr(_crashes, "signature_of", lambda bundle, recording: f"type of {recording}")
    monkeypatch.setattr(_crashes, "fault_of", lambda bundle, recording: SimpleNamespace(verdict=f"by {recording}"))
    crash = bundle(recording=lambda: read.append(1) or "log")
    assert _crashes._analysis(crash) == {"type": "type of log", "fault": "by log"}
    hang = bundle(place="", recording=lambda: read.append(1) or "log")
    assert _crashes._analysis(hang) == {"type": "type of None", "fault": "by None"}
    assert len(read) == 1
    scene = SimpleNamespace(points=[(0.0, 0.0), (1.239, 2.0)], roster=SimpleNamespace(index={"other": 0, "ego": 1}))
    near = bundle(outcome=Outcome.SURVIVED, recording=lambda: SimpleNamespace(scene=lambda step: scene))
    monkeypatch.setattr(_crashes, "most_dangerous", lambda recording: SimpleNamespace(step=3, agent="ego"))
    assert _crashes._analysis(near) == {"x": 1.24, "y": 2.0}
    monkeypatch.setattr(_crashes, "most_dangerous", lambda recording: None)
    assert _crashes._analysis(near) == {}


def test_commands_of_a_crash_are_those_that_suit_it():
    def names(*given):
        return dict(_crashes._commands(Path("/my hunts/one"), *given))

    usual = names("c", bundle())
    assert usual == {
        "show": "crashhunt show '/my hunts/one' --crash c", "replay": "crashhunt replay '/my hunts/one' --crash c",
        "judge": "crashhunt judge '/my hunts/one' --crash c", "minimize": "crashhunt shrink '/my hunts/one' --crash c",
        "replay with your present code": "crashhunt replay '/my hunts/one' --crash c --code current",
        "note": "crashhunt note '/my hunts/one' --crash c TEXT",
        "export": "crashhunt export '/my hunts/one' c.zip --crash c",
        "add to corpus": "crashhunt corpus add /hunts/one/crashes/000003-collision --to corpus",
    }  # fmt: skip
    assert usual.keys() - names(f"c{layout.SMALL}", bundle()).keys() == {"minimize"}
    near = names("c", bundle(outcome=Outcome.SURVIVED))
    assert usual.keys() - near.keys() == {"judge", "minimize", "add to corpus"}


@pytest.fixture
def crashes(tmp_path, monkeypatch):
    """The list of a hunt's crashes, whose bundles are read by their names."""
    for place, names in ((layout.CRASHES, ("000001-collision", "000002-collision", f"000001-collision{layout.SMALL}")),
                         (layout.NEAR_MISSES, ("000002-collision", "000004-survived"))):  # fmt: skip
        for name in names:
            folder = tmp_path / place / name
            folder.mkdir(parents=True)
            (folder / layout.CRASH).write_text("{}")
    made = CrashList(SimpleNamespace(path=tmp_path))
    made.read, made.analysed, made.threads = [], [], []

    def read(folder):
        made.read.append(folder.name)
        if (folder / layout.CRASH).read_text() == "damaged":
            raise BundleError("damaged")
        return bundle(folder.name, Outcome.SURVIVED if folder.parent.name == layout.NEAR_MISSES else Outcome.COLLISION)

    def analysis(found):
        made.analysed.append(found.id)
        if found.id == "000002-collision":
            raise BundleError("its log is damaged")
        return {"type": "rear end", "fault": "ego"} if not found.is_near_miss else {"x": 7.0, "y": 8.0}

    class Thread:
        def __init__(self, *, target, args, daemon):
            assert daemon
            self.run, self.alive = lambda: target(*args), True

        def start(self):
            made.threads.append(self)

        def is_alive(self):
            return self.alive

    monkeypatch.setattr(made, "_read", read)
    monkeypatch.setattr(_crashes, "_analysis", analysis)
    monkeypatch.setattr(_crashes.threading, "Thread", Thread)
    return made


def test_crashes_are_listed_once_and_their_logs_read_by_one_thread(crashes, tmp_path, monkeypatch):
    found = crashes.rows()
    assert [(row["id"], row["near_miss"], row["type"]) for row in found["crashes"]] == [
        ("000001-collision", False, None), ("000002-collision", False, None), ("000004-survived", True, None)
    ]  # fmt: skip
    assert (found["count"], found["pending"]) == (2, 2)
    assert (found["near_misses"], found["pending_near_misses"]) == (1, 1)
    assert crashes.rows() == found
    assert crashes.read == ["000001-collision", "000002-collision", "000004-survived"]  # each once
    (thread,) = crashes.threads
    thread.run()
    thread.alive = False
    found = crashes.rows()
    assert (found["pending"], len(crashes.threads)) == (0, 1)
    first, second, near = found["crashes"]
    assert (first["type"], first["fault"], first["damaged"]) == ("rear end", "ego", "")
    assert (second["type"], second["damaged"]) == (None, "its log is damaged")
    assert (near["x"], near["y"], near["type"]) == (7.0, 8.0, None)
    (tmp_path / layout.CRASHES / "000001-collision" / layout.CRASH).write_text("{ }")
    assert crashes.rows()["pending"] == 1  # it has been written again
    crashes.threads[1].run()
    assert crashes.analysed.count("000001-collision") == 2
    crashes.threads[1].alive = False
    (tmp_path / layout.CRASHES / "000001-collision" / layout.CRASH).write_text("damaged")
    found = crashes.rows()
    assert found["pending"] == 0
    assert found["crashes"][0]["damaged"] == "damaged"
    assert found["crashes"][0]["near_miss"] is False
    (tmp_path / layout.NEAR_MISSES / "000004-survived" / layout.CRASH).write_text("damaged")
    assert crashes.rows()["crashes"][2]["near_miss"] is True
    monkeypatch.setattr(_crashes, "_MAX_LISTED", 2)
    found = crashes.rows()
    assert (len(found["crashes"]), found["count"], found["near_misses"]) == (2, 2, 1)


def test_folder_of_a_minimized_crash_is_found_by_its_own_name(crashes, tmp_path):
    small = f"000001-collision{layout.SMALL}"
    assert crashes.folder("000001-collision") == tmp_path / layout.CRASHES / "000001-collision"
    assert crashes.folder("000002-collision").parent.name == layout.CRASHES  # which hides the near miss
    assert crashes.folder("000004-survived").parent.name == layout.NEAR_MISSES
    assert crashes.folder(small) == tmp_path / layout.CRASHES / small
    for name in (f"000002-collision{layout.SMALL}", f"000009-collision{layout.SMALL}", "000009-collision", ""):
        assert crashes.folder(name) is None
    assert crashes.bundle("nothing") is None
    assert crashes.bundle("000001-collision").id == "000001-collision"
    assert crashes.detail("nothing") is None
    assert crashes.log("nothing") is None


def test_log_is_a_file_inside_the_hunt(crashes, tmp_path_factory, tmp_path):
    log = tmp_path / layout.CRASHES / "000001-collision" / layout.LOG
    assert crashes.log("000001-collision") is None
    log.mkdir()
    assert crashes.log("000001-collision") is None
    log.rmdir()
    outside = tmp_path_factory.mktemp("outside") / "log"
    outside.write_text("secret")
    log.symlink_to(outside)
    assert crashes.log("000001-collision") is None
    log.unlink()
    log.write_text("log")
    assert crashes.log("000001-collision") == log


def test_map_has_each_lane_once_and_the_places_that_are_known(crashes, tmp_path, monkeypatch):
    for name in ("000001-collision", "000002-collision"):
        (tmp_path / layout.CRASHES / name / layout.LOG).write_text("log")
    right, left, read = [(0.0, 0.0), (10.004, 0.0)], [(0.0, 4.0), (10.0, 4.0)], []

    def lanes(path):
        read.append(path.parent.name)
        return [(right, left), ([(1.0, 1.0)], [(1.0, 2.0)])]  # and one without a length

    monkeypatch.setattr(_crashes, "read_lanes", lanes)
    building = [(0.0, 9.0), (5.004, 9.0), (5.0, 14.0)]
    monkeypatch.setattr(_crashes, "read_obstacles", lambda path: [building, [(0.0, 9.0), (5.0, 9.0)]])
    found = crashes.map()
    assert found["obstacles"] == [[0.0, 9.0, 5.0, 9.0, 5.0, 14.0]]
    assert found["lanes"] == [[0.0, 0.0, 10.0, 0.0, 10.0, 4.0, 0.0, 4.0]]
    assert found["points"][0] == {"id": "000001-collision", "x": 1.23, "y": -5.68, "type": None, "near_miss": False,
                                  "outcome": "collision"}  # fmt: skip
    crashes.map()
    assert read == ["000001-collision", "000002-collision"]  # each once
    crashes._lanes.clear()
    monkeypatch.setattr(_crashes, "_MAX_MAP_LOGS", 1)
    crashes.map()
    assert read[2:] == ["000001-collision"]
    crashes._lanes.clear()
    monkeypatch.setattr(_crashes, "read_lanes", lambda path: (_ for _ in ()).throw(ValueError))
    assert crashes.map()["lanes"] == []
    assert crashes._lanes == {"000001-collision": []}


def test_lineage_names_ancestors_up_to_a_trial_without_a_known_parent(crashes, tmp_path, monkeypatch):
    trials = {
        9: {"spec": {"number": 9, "parent": 7, "origin": "guided"}, "danger": 0.9},
        7: {"spec": {"number": 7, "parent": 2, "origin": "start"}, "danger": 0.7},
        2: {"spec": {"number": 2}, "danger": None},
        8: {"spec": {"number": 8, "parent": 8}}, 6: {"spec": {"number": 6, "parent": 1}},
    }  # fmt: skip
    opened, closed = [], []

    def ledger(path, *, read_only):
        opened.append((path, read_only))
        return SimpleNamespace(plain_trial=trials.get, close=lambda: closed.append(1))

    monkeypatch.setattr(_crashes, "Ledger", ledger)
    monkeypatch.setattr(_crashes, "has_begun", lambda path: False)
    assert crashes._lineage(9) == []
    monkeypatch.setattr(_crashes, "has_begun", lambda path: path == tmp_path / layout.LEDGER)
    assert crashes._lineage(9) == [[7, "start", 0.7], [2, "", None]]
    assert crashes._lineage(8) == crashes._lineage(6) == crashes._lineage(5) == []
    assert opened == [(tmp_path / layout.LEDGER, True)] * 4
    assert len(closed) == 4
    monkeypatch.setattr(_page, "_MAX_GENERATIONS", 1)
    assert crashes._lineage(9) == [[7, "start", 0.7]]


def test_bundle_is_read_only_where_all_its_files_may_be_opened(tmp_path, monkeypatch):
    monkeypatch.setattr(_crashes, "read_bundle", lambda folder: folder.name)
    made = CrashList(SimpleNamespace(path=tmp_path))
    folder = tmp_path / layout.CRASHES / "000001-collision"
    folder.mkdir(parents=True)
    (folder / layout.CRASH).write_text("{}")
    (tmp_path / layout.SNAPSHOTS / "s").mkdir(parents=True)
    assert made._read(folder) == "000001-collision"
    for place, name in ((folder, layout.LOG), (tmp_path, layout.HUNT), (tmp_path / layout.SNAPSHOTS / "s", "code.py")):
        (place / name).symlink_to("/etc/hostname")
        with pytest.raises(BundleError, match=f"{name} is a symbolic link to a place outside"):
            made._read(folder)
        (place / name).unlink()
    (tmp_path / layout.CRASHES / "000002-collision").symlink_to("/etc")
    with pytest.raises(BundleError, match="000002-collision is a symbolic link"):
        made._read(tmp_path / layout.CRASHES / "000002-collision")
