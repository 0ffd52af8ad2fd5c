"""Hunts in folders: which the dashboard lists, which files it opens, what it keeps of them, and where it listens."""

from __future__ import annotations

import errno
import os
import socket
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, HuntDirectoryError, UsageError
from crashhunt.dashboard import _catalog, _crash_list as _crashes, _hunt_page as _hunt, _server, _serving
from crashhunt.dashboard._catalog import Catalog, FoundHunt, is_inside, unreadable, unreadable_below
from crashhunt.dashboard._hunt_page import HuntView
from crashhunt.ledger import Ledger
from crashhunt.training import HeldOutTraffics
from crashhunt.trial import Outcome, TrialResult, TrialSpec


def hunt(path):
    path.mkdir(parents=True)
    (path / layout.HUNT).write_text("# crashhunt run\n")
    return path


def listed(*roots, **options):
    return [(found.name, found.suite) for found in Catalog(roots, **options).hunts().values()]


def test_hunts_are_named_by_their_path_below_the_folder_that_the_user_named(tmp_path):
    for name in ("a", "suite/one/r", "suite/two", "a/inner", ".hidden", "node_modules/x", f"x{layout.REPLACED}1",
                 f"b/{layout.SNAPSHOTS}/s"):  # fmt: skip
        hunt(tmp_path / name)
    assert listed(tmp_path) == [("a", ""), ("suite/two", "suite"), ("suite/one/r", "suite/one")]
    assert listed(tmp_path / "a", tmp_path / "suite" / "..", tmp_path / "a") == [
        ("a", ""), ("suite/two", "suite"), ("suite/one/r", "suite/one")
    ]  # fmt: skip
    assert listed(tmp_path / "nothing") == []
    (tmp_path / "suite" / "two" / "hunt.toml").unlink()
    (tmp_path / "suite" / "two" / layout.LEDGER).write_bytes(b"")
    assert ("suite/two", "suite") in listed(tmp_path)


def test_identifier_depends_on_the_path_only_and_that_of_an_export_on_its_name(tmp_path):
    hunt(tmp_path / "a")
    one, other = (Catalog([root]).hunts() for root in (tmp_path, tmp_path / "a"))
    (found,) = one.values()
    assert list(one) == list(other) == [found.id]
    assert len(found.id) == 16
    assert (found.path, found.root, found.exported) == (tmp_path / "a", tmp_path, False)
    unpacked = [hunt(tmp_path / f".unpacked{number}") for number in range(2)]
    for path in unpacked:  # unpacked to another place each time
        catalog = Catalog([tmp_path], {"x.zip": path, "y.zip": path})
        first, second, third = catalog.hunts().values()
        assert (first.name, first.suite, first.exported, first.root) == ("x.zip", "", True, path)
        assert [first.id, second.id] == [_catalog._identifier(path, name) for name in ("x.zip", "y.zip")]
        assert third.id == found.id
    assert len({_catalog._identifier(path, "x.zip") for path in unpacked}) == 1
    assert len({_catalog._identifier(path) for path in unpacked}) == 2


def test_hunts_are_searched_to_a_depth_and_in_so_many_folders(tmp_path, monkeypatch):
    hunt(tmp_path / "1/2/3/4")
    hunt(tmp_path / "a/2/3/4/5")
    catalog = Catalog([tmp_path])
    assert [found.name for found in catalog.hunts().values()] == ["1/2/3/4"]
    assert not catalog.is_cut
    monkeypatch.setattr(_catalog, "_MAX_FOLDERS", 9)
    catalog = Catalog([tmp_path])
    assert len(catalog.hunts()) == 1
    assert not catalog.is_cut
    monkeypatch.setattr(_catalog, "_MAX_FOLDERS", 8)
    catalog = Catalog([tmp_path])
    catalog.hunts()
    assert catalog.is_cut


def test_cases_of_a_corpus_are_no_hunts(tmp_path):
    case = hunt(tmp_path / "case")
    (case / layout.CASE).write_text("{}")
    assert listed(tmp_path) == []


def test_search_is_repeated_after_a_second_or_in_a_twentieth_of_the_time(tmp_path, monkeypatch):
    clock, scans, lasts = [50.0], [], [0.0]

    def is_hunt(folder):
        if folder == tmp_path:
            scans.append(clock[0])
            clock[0] += lasts[0]
        return folder.name == "a"

    (tmp_path / "a").mkdir()
    monkeypatch.setattr(_catalog, "is_hunt", is_hunt)
    monkeypatch.setattr(_catalog, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    catalog = Catalog([tmp_path])
    for now in (50.0, 50.9, 51.0, 51.5):
        clock[0] = now
        (name,) = catalog.hunts()
    assert scans == [50.0, 51.0]
    lasts[0] = 2.0
    for now in (52.0, 54.0 + 39.9, 54.0 + 40.0):
        clock[0] = now
        catalog.hunts()
    assert scans[2:] == [52.0, 94.0]
    assert catalog.find(name).name == "a"
    assert catalog.find("nothing") is None
    (tmp_path / "a").rmdir()
    assert catalog.find(name) is None  # at once


def test_links_to_folders_are_followed_inside_the_named_folders_only(tmp_path):
    hunt(tmp_path / "outside/h")
    inside = hunt(tmp_path / "roots/a")
    other = tmp_path / "more"
    other.mkdir()
    for name, target in (("out", tmp_path / "outside"), ("loop", tmp_path / "roots"), ("same", inside)):
        (other / name).symlink_to(target)
    assert listed(other) == []
    assert [name for name, _ in listed(tmp_path / "roots")] == ["a"]
    assert is_inside(Path("/a/b"), [Path("/x"), Path("/a")])
    assert is_inside(Path("/a"), [Path("/a")])
    assert not is_inside(Path("/ab"), [Path("/a")])
    assert not is_inside(Path("/a"), [Path("/a/b")])


def test_file_is_opened_where_it_is_a_small_file_inside(tmp_path):
    folder, outside = tmp_path / "in", tmp_path / "outside"
    folder.mkdir()
    outside.write_text("secret")
    (folder / "folder").mkdir()
    (folder / "file").write_text("x")
    (folder / "inner").symlink_to(folder / "file")
    (folder / "broken").symlink_to(folder / "nothing")
    (folder / "loop").symlink_to(folder / "loop")
    usual = ["folder", "file", "inner", "broken", "loop", "missing"]
    assert unreadable(folder, folder, usual) == ""
    (folder / "out").symlink_to(outside)
    said = f"out is a symbolic link to a place outside {folder}"
    assert unreadable(folder, folder, [*usual, "out"]) == said
    assert unreadable(folder, tmp_path, ["out"]) == ""
    os.mkfifo(folder / "pipe")
    (folder / "to_pipe").symlink_to(folder / "pipe")
    for name in ("pipe", "to_pipe"):
        assert unreadable(folder, folder, [name]) == f"{name} is neither a file nor a folder"
    said = unreadable_below(tmp_path, tmp_path)
    assert said.startswith("in in, ")
    assert said.endswith("neither a file nor a folder")  # of a link out of it, the root may be inside
    (folder / "out").unlink()
    assert "neither a file nor a folder" in unreadable_below(tmp_path, tmp_path)
    (folder / "pipe").unlink()
    assert unreadable_below(tmp_path, tmp_path) == ""
    assert unreadable_below(tmp_path / "nothing", tmp_path) == ""
    deep = folder / "folder" / "deep"
    deep.mkdir()
    (deep / "out").symlink_to("/etc/hostname")
    assert unreadable_below(folder, folder) == f"in folder/deep, out is a symbolic link to a place outside {folder}"
    (deep / "out").unlink()
    (deep / "out").symlink_to("/etc")  # a link to a folder is a link
    assert unreadable_below(folder, folder).startswith("in folder/deep, out is a symbolic link")


@pytest.mark.parametrize(("name", "most"), [(layout.HUNT, 4 << 20), (layout.CRASH, 16 << 20)])
def test_file_that_is_read_as_a_whole_has_a_largest_size(tmp_path, name, most):
    for size, said in ((most, ""), (most + 1, f"{name} has {most + 1:,} bytes (allowed: {most:,})")):
        (tmp_path / name).write_bytes(b"")
        os.truncate(tmp_path / name, size)
        os.truncate(tmp_path / name, size)
        assert unreadable(tmp_path, tmp_path, [name]) == said
    (tmp_path / "other").write_bytes(b"")
    os.truncate(tmp_path / "other", 32 << 20)
    assert unreadable(tmp_path, tmp_path, ["other"]) == ""


# What is known of a hunt.


def trial(number, outcome=Outcome.SURVIVED):
    spec = TrialSpec(number=number, seed=1, arguments={"ego": {"speed": 2.0}}, scenario_arguments={}, max_steps=9)
    return TrialResult(spec, outcome, steps=7)


@pytest.fixture
def view(tmp_path, monkeypatch):
    """The view of a hunt with two trials, whose settings are simple."""
    settings = SimpleNamespace(crash_on=(Outcome.COLLISION,), scenario="toy", sampler="guided", max_steps=9,
                               agents={"ego": SimpleNamespace(agent="m:A")})  # fmt: skip
    hunt(tmp_path / "h")
    made = HuntView(FoundHunt(id="i", path=tmp_path / "h", root=tmp_path, name="h", suite="s", exported=False))
    made.reads = []
    monkeypatch.setattr(_hunt, "read_settings", lambda path: made.reads.append(path.name) or settings)
    with closing(Ledger(made.path / layout.LEDGER, writable=True)) as ledger:
        for number in range(2):
            ledger.record(trial(number), snapshot="s")
    return made


def add(view, *results):
    with closing(Ledger(view.path / layout.LEDGER, writable=True)) as ledger:
        for result in results:
            ledger.record(result, snapshot="s")


def test_ledger_is_read_when_it_has_changed_and_points_when_they_are_shown(view, monkeypatch):
    read, ledger = [], _hunt.Ledger
    monkeypatch.setattr(
        _hunt, "Ledger", lambda path, *, read_only: read.append(path) or ledger(path, read_only=read_only)
    )
    assert view.refresh().trials_run == 2
    view.refresh()
    assert (len(read), view.sample, view.counts.trials) == (1, None, 2)
    view.refresh(points=True)
    view.refresh(points=True)
    view.refresh()
    assert (len(read), len(view.sample.points)) == (2, 2)
    add(view, trial(2, Outcome.COLLISION))
    assert view.refresh().crashes == 1
    assert (len(read), [point["number"] for point in view.sample.points]) == (3, [0, 1, 2])
    assert view.reads == [layout.HUNT]
    (view.path / layout.HUNT).write_text("# crashhunt run again\n")
    view.refresh()
    assert (len(view.reads), view.sample) == (2, None)


def test_crashes_of_a_hunt_are_those_with_and_without_a_bundle(view, monkeypatch):
    def state(finished="finished"):
        monkeypatch.setattr(_hunt, "state_of_facts", lambda path, facts, outcomes, last: _hunt.HuntState(
            str(path), finished, trials_run=sum(outcomes.values())
        ))  # fmt: skip
        found = view.refresh()
        return found.state, found.crashes, found.crashes_saved

    assert state() == ("finished", 0, None)
    (view.path / layout.CRASHES / "000001-collision").mkdir(parents=True)
    assert state() == ("crashed", 1, None)  # written before its row
    assert state("killed") == ("killed", 1, None)
    add(view, trial(2, Outcome.COLLISION), trial(3, Outcome.COLLISION))
    assert state() == ("crashed", 2, 1)
    view.refresh()
    view.facts = {"dropped": {"a": [1, 2], "b": [3]}}
    assert state() == ("crashed", 4, 1)


def test_hunt_that_cannot_be_read_is_an_error_of_its_own_row(view, monkeypatch):
    view.refresh(points=True)
    for error, said in (
        (HuntDirectoryError("odd", fix="see check"), "odd; see check"),
        (KeyError("state"), "a fact cannot be read: KeyError: 'state'"),
        (ValueError("x" * 9_000), "a fact cannot be read: ValueError: xxx"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(_hunt, "state_of_facts", lambda *_, error=error: (_ for _ in ()).throw(error))
            found = view.refresh()
        assert (found.state, found.damaged) == ("error", True)
        assert said in found.detail
        assert len(found.detail) <= 2_000
        assert view.counts is view.sample is None
    assert not view.refresh().damaged
    (view.path / layout.HUNT).unlink()
    assert "has no hunt.toml" in view.refresh().detail
    (view.path / layout.HUNT).symlink_to("/etc/hostname")
    assert "hunt.toml is a symbolic link to a place outside" in view.refresh().detail


def test_hunt_that_has_not_begun_has_the_state_of_its_folder(tmp_path):
    for exported, state in ((True, "finished"), (False, "queued")):
        path = hunt(tmp_path / str(exported))
        (path / layout.HUNT).unlink()
        found = FoundHunt(id="i", path=path, root=tmp_path, name="h", suite="", exported=exported)
        made = HuntView(found)
        assert made.refresh().state == state or not exported
        assert made.row()["curve"] == []
        assert made.row()["rate"] is None


def test_row_of_a_hunt_has_the_data_of_its_state_and_of_its_settings(view, monkeypatch):
    add(view, trial(2, Outcome.COLLISION))
    monkeypatch.setattr(HuntView, "rate", lambda self, state: {"estimate": 0.5})
    view.refresh()
    row = view.row()
    expected = {
        "id": "i", "name": "h", "suite": "s", "exported": False, "scenario": "toy", "agents": {"ego": "m:A"},
        "sampler": "guided", "max_steps": 9, "crashed_trials": 1, "kinds_count": None, "rate": {"estimate": 0.5},
        "curve": [[0, 0], [1, 0], [2, 0], [3, 1]], "newest_kind_at": None, "kind_firsts": [], "trials_run": 3,
    }  # fmt: skip
    assert {name: row[name] for name in expected} == expected
    monkeypatch.setattr(HuntView, "refresh", lambda self, **_: _hunt.HuntState("d", "crashed"))
    view.facts = {"kinds": [{"words": "rear end", "first": "000002-collision"}], "newest_kind": 5.0}
    row = view.row()
    assert (row["kinds_count"], row["newest_kind_at"], row["kind_firsts"]) == (1, 5.0, [2])
    view.counts = view.settings = None
    row = view.row()
    assert (row["kinds_count"], row["newest_kind_at"], row["scenario"], row["agents"], row["max_steps"]) == (
        None, None, "", {}, 0,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "dropped", "firsts"),
    [
        ({"words": "a", "first": "000007-x"}, {}, [7]), ({"words": "a", "first": ""}, {}, []), ({}, {}, []),
        ({"words": "a", "first": "000007-x"}, {"a": [9, 8]}, [7]), ({"words": "a", "first": "x"}, {"a": [9, 8]}, [8]),
        ({"words": "a", "first": "\u0663-x"}, {"b": [1]}, []), ({"words": "a", "first": "-1"}, {}, []),
    ],
)  # fmt: skip
def test_first_trial_of_a_crash_type_is_the_smallest_number(kind, dropped, firsts):
    view = HuntView(SimpleNamespace(path=None))
    view.counts, view.facts = object(), {"kinds": [kind], "dropped": dropped}
    assert view.kind_firsts() == firsts
    view.counts = None
    assert view.kind_firsts() == []


def test_rate_is_computed_again_when_the_counts_have_changed(view, monkeypatch):
    computed, rules = [], []
    data = dict.fromkeys(
        ("per", "confidence", "method", "units", "crashes", "estimate", "certain", "why_not", "left_out", "more"), 1
    )

    def rate(path, settings, facts, **counts):
        computed.append(counts)
        return SimpleNamespace(to_json=lambda: data)

    monkeypatch.setattr(_hunt, "rate_of_counts", rate)
    monkeypatch.setattr(_hunt, "held_out_traffics", lambda *given: rules.append(given[1]) or HeldOutTraffics(0))
    monkeypatch.setattr(_hunt, "counts_suffice", lambda settings, facts, held_out: held_out == HeldOutTraffics(0))
    state = view.refresh()
    assert set(view.rate(state)) == data.keys() - {"more"}
    view.rate(state)
    assert computed == [{"valid": 2, "invalid": 0, "crashes": 0, "steps": 14, "excluded": 0}]
    add(view, trial(2, Outcome.COLLISION))
    view.rate(view.refresh())
    assert [counts["crashes"] for counts in computed] == [0, 1]
    assert rules == [[view.path]]
    (view.path / layout.SNAPSHOTS).mkdir()
    view.rate(state)
    assert len(rules) == 2

    def fails(*_):
        raise CrashhuntError("x" * 3_000)

    monkeypatch.setattr(_hunt, "held_out_traffics", fails)
    (view.path / layout.SNAPSHOTS / "s").mkdir()
    assert view.rate(state) == {"why_not": "x" * 2_000}


def test_rate_of_all_trials_is_that_of_the_ledger_and_of_the_traffics_that_count(view, monkeypatch):
    given = []

    def rate(*words):
        given.append((*words[:3], [result["spec"]["number"] for result in words[3]], *words[4:]))
        raise HuntDirectoryError("odd")

    monkeypatch.setattr(_hunt, "rate_of_trials", rate)
    monkeypatch.setattr(_hunt, "counts_suffice", lambda *_: False)
    monkeypatch.setattr(_hunt, "held_out_traffics", lambda settings, paths: "held out")
    assert view.rate(view.refresh()) == {"why_not": "odd"}
    assert given == [(view.path, view.settings, view.facts, [0, 1], "held out")]


def test_snapshots_are_examined_again_when_their_folder_has_changed(view, monkeypatch):
    examined = []
    monkeypatch.setattr(_hunt, "unreadable_below", lambda path, root: examined.append((path, root)) or "odd")
    assert [view.unreadable(), view.unreadable()] == ["odd", "odd"]
    assert examined == [(view.path / layout.SNAPSHOTS, view.found.root)]
    (view.path / layout.SNAPSHOTS).mkdir()
    view.unreadable()
    assert len(examined) == 2


def test_other_ledger_of_the_same_name_is_read_from_its_beginning(view):
    view.refresh(points=True)
    sample = view.sample
    add(view, trial(2))
    view.refresh()
    assert view.sample is sample
    (view.path / layout.LEDGER).rename(view.path / "old")
    with closing(Ledger(view.path / layout.LEDGER, writable=True)) as ledger:
        ledger.record(trial(0, Outcome.COLLISION), snapshot="s")
    view.refresh(points=True)
    assert (view.counts.trials, view.counts.crashes, len(view.sample.points)) == (1, 1, 1)
    assert view.sample is not sample


def test_page_of_a_crash_has_the_data_of_its_bundle(tmp_path, monkeypatch):
    folder = tmp_path / layout.CRASHES / "000003-collision"
    small = folder.with_name(f"{folder.name}{layout.SMALL}")
    folder.mkdir(parents=True)
    (folder / layout.RUN_LOG).write_text("out\n")
    (folder / layout.ERROR_LOG).write_text("err\n")
    spec = SimpleNamespace(number=3, arguments={"ego": {"speed": 2}}, scenario_arguments={"cars": 3})
    bundle = SimpleNamespace(result=SimpleNamespace(spec=spec), is_near_miss=False, path=folder)
    story = SimpleNamespace(judgement=None, fault=SimpleNamespace(to_json=lambda: {"verdict": "ego"}))
    made = _crashes.CrashList(SimpleNamespace(path=tmp_path))
    monkeypatch.setattr(made, "_read", lambda path: bundle)
    monkeypatch.setattr(made, "_lineage", lambda number: [[number, "", None]])
    monkeypatch.setattr(_crashes, "Story", lambda found: story)
    monkeypatch.setattr(_crashes, "player_data", lambda found, told: {"player": (found, told)})
    found = made.detail(folder.name)
    commands = found.pop("commands")
    assert [name for name, _ in commands] == [
        "show",
        "replay",
        "replay with your present code",
        "judge",
        "minimize",
        "note",
        "export",
        "add to corpus",
    ]
    assert found == {
        "player": (bundle, story), "near_miss": False, "minimized": "", "minimized_from": "",
        "parameters": {"ego": {"speed": 2}}, "scenario_parameters": {"cars": 3}, "judged": None,
        "fault": {"verdict": "ego"}, "run_log": "out\n", "error_log": "err\n", "lineage": [[3, "", None]],
        "path": str(folder), "previous": "", "next": "",
    }  # fmt: skip
    small.mkdir()
    story.judgement = SimpleNamespace(to_json=lambda: {"cause": "late"})
    found = made.detail(folder.name)
    assert (found["minimized"], found["judged"]) == (small.name, {"cause": "late"})
    assert made.detail(small.name)["minimized_from"] == folder.name
    for name in ("000001-collision", "000009-hang"):
        folder.with_name(name).mkdir()
    for name in (folder.name, small.name):
        found = made.detail(name)
        assert (found["previous"], found["next"]) == ("000001-collision", "000009-hang")
    assert made.detail("000001-collision")["previous"] == made.detail("000009-hang")["next"] == ""


# Where it listens.


def test_paths_are_folders_or_exported_files(tmp_path, monkeypatch):
    (tmp_path / "folder").mkdir()
    (tmp_path / "x.zip").write_bytes(b"PK")
    left = []

    @contextmanager
    def open_archive(path):
        yield SimpleNamespace(directory=tmp_path / "unpacked" / path.name)
        left.append(path.name)

    monkeypatch.setattr("crashhunt.crashes.open_archive", open_archive)
    with ExitStack() as opened:
        found = _server._roots([tmp_path / "x.zip", tmp_path / "folder"], opened)
        assert found == ([tmp_path / "folder"], {"x.zip": tmp_path / "unpacked" / "x.zip"})
        assert left == []
    assert left == ["x.zip"]
    with ExitStack() as opened, pytest.raises(UsageError, match="'nothing' does not exist"):
        _server._roots([Path("nothing")], opened)


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (errno.EADDRINUSE, "port 80 of localhost is taken; give --port 81, which is free"),
        (errno.EACCES, "port 80 needs the rights of an administrator; give a --port from 1024 to 65535"),
        (errno.EADDRNOTAVAIL, "cannot listen on localhost port 80: Cannot assign"),
    ],
)
def test_port_that_cannot_be_had_is_one_sentence(number, said, monkeypatch):
    def bound(family, target):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(_server, "_bound", bound)
    monkeypatch.setattr(_server, "_next_free", lambda family, target: 81)
    with pytest.raises(UsageError) as caught:
        _server._listen("localhost", 80)
    assert str(caught.value).startswith(said)
    if number == errno.EADDRINUSE:
        monkeypatch.setattr(_server, "_next_free", lambda family, target: 0)
        with pytest.raises(UsageError, match=r"is taken; give another --port$"):
            _server._listen("localhost", 80)


def test_port_is_of_its_range_and_the_host_of_this_machine(monkeypatch):
    bound = []
    monkeypatch.setattr(_server, "_bound", lambda family, target: bound.append(target[1]) or "socket")
    for port in (0, 65_535):
        assert _server._listen("127.0.0.1", port) == "socket"
    assert bound == [0, 65_535]
    for port in (-1, 65_536):
        with pytest.raises(UsageError, match=f"--port is {port}"):
            _server._listen("127.0.0.1", port)
    with pytest.raises(UsageError, match="is not known"):
        _server._listen("a" * 300, 80)


def test_socket_listens_and_is_closed_when_it_cannot(monkeypatch):
    made = []

    class Socket:
        def __init__(self, *given):
            made.append(self)
            self.calls = [given]

        def __getattr__(self, name):
            return lambda *given: self.calls.append((name, *given))

    monkeypatch.setattr(_server.socket, "socket", Socket)
    assert _server._bound(socket.AF_INET, ("h", 1)) is made[0]
    assert made[0].calls == [
        (socket.AF_INET, socket.SOCK_STREAM), ("setsockopt", socket.SOL_SOCKET, socket.SO_REUSEADDR, 1),
        ("bind", ("h", 1)), ("listen", 128),
    ]  # fmt: skip
    Socket.bind = lambda self, target: (_ for _ in ()).throw(OSError)
    with pytest.raises(OSError):  # noqa: PT011
        _server._bound(socket.AF_INET, ("h", 1))
    assert made[1].calls[-1] == ("close",)


def test_next_free_port_is_one_of_the_next_hundred(monkeypatch):
    tried = []

    def bound(family, target):
        tried.append((family, *target))
        raise OSError

    monkeypatch.setattr(_server, "_bound", bound)
    assert _server._next_free(socket.AF_INET6, ("::", 8642, 3, 4)) == 0
    assert tried == [(socket.AF_INET6, "::", port, 3, 4) for port in range(8643, 8742)]
    tried.clear()
    assert _server._next_free(socket.AF_INET, ("h", 65_530)) == 0
    assert [target[2] for target in tried] == list(range(65_531, 65_536))


def test_missing_libraries_are_named_in_the_order_of_the_extra(monkeypatch):
    monkeypatch.setattr(_server.importlib.util, "find_spec", lambda name: None if name != "uvicorn" else name)
    assert _server._missing() == ["starlette", "plotly"]
    assert not _server.has_dashboard()
    with pytest.raises(UsageError, match="the dashboard needs starlette, plotly"):
        _server.serve([], announce=print)
    monkeypatch.setattr(_server.importlib.util, "find_spec", lambda name: name)
    assert _server.has_dashboard()


def test_server_sends_no_header_of_its_own_and_ignores_those_of_proxies():
    """Of the headers of a proxy, a client could make up its address."""
    config = _serving.make_server("app", print).config
    expected = {
        "app": "app", "log_level": "critical", "access_log": False, "server_header": False, "date_header": False,
        "proxy_headers": False, "limit_concurrency": 200, "timeout_keep_alive": 15, "timeout_graceful_shutdown": 1,
        "h11_max_incomplete_event_size": 16_384, "ws": "none", "lifespan": "off", "loop": "asyncio",
        "http": _serving._Protocol,
    }  # fmt: skip
    assert {name: getattr(config, name) for name in expected} == expected


@pytest.fixture
def connection(monkeypatch):
    """A connection on a clock of the test: no part of a request has been read."""
    made = _serving._Protocol.__new__(_serving._Protocol)
    made.timers, made.closed, made.cycle = [], [], None
    for name in ("connection_made", "data_received", "connection_lost"):
        monkeypatch.setattr(_serving.H11Protocol, name, lambda self, *given: None)

    def call_later(seconds, function):
        assert seconds == 10
        timer = SimpleNamespace(run=function, cancelled=False)
        timer.cancel = lambda: setattr(timer, "cancelled", True)
        made.timers.append(timer)
        return timer

    made.loop = SimpleNamespace(call_later=call_later)
    made.transport = SimpleNamespace(close=lambda: made.closed.append(1))
    return made


def test_request_has_a_time_limit_until_its_headers_are_complete(connection):
    connection.connection_made(connection.transport)
    connection.data_received(b"GET")
    (timer,) = connection.timers  # which the parts of a request do not prolong
    connection.cycle = SimpleNamespace(response_complete=False)
    connection.data_received(b" / HTTP/1.1\r\n\r\n")
    assert timer.cancelled
    connection.data_received(b"")
    assert len(connection.timers) == 1
    connection.cycle.response_complete = True
    connection.data_received(b"GET")  # the next one
    assert len(connection.timers) == 2
    connection.timers[1].run()
    assert connection.closed == [1]
    connection.data_received(b"")
    assert len(connection.timers) == 3
    connection.cycle.response_complete = False
    connection.timers[2].run()
    assert connection.closed == [1]  # its headers were complete in the same moment
    connection.cycle.response_complete = True
    connection.data_received(b"")
    connection.connection_lost(None)
    assert connection.timers[3].cancelled
