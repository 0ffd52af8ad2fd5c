"""What travels to nodes, what they keep of it, and who gets which trial; without Ray."""

from __future__ import annotations

import contextlib
import fcntl
import importlib.util
import io
import os
import re
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from ray_node import Pool, node_works, submissions

from crashhunt.base import layout
from crashhunt.base.errors import BundleError
from crashhunt.episode import WorkerSettings, scratch_of
from crashhunt.executors.ray import RayExecutor
from crashhunt.executors.ray._code_archive import CodeArchive, Folder, settings_in, unpack
from crashhunt.executors.ray._node_actor import Site, code_digest
from crashhunt.executors.ray._node_scheduler import Node, NodeScheduler, Trial
from crashhunt.executors.ray._node_worker import Work
from crashhunt.recording import BlackBox, Tag, read_black_box
from crashhunt.scenario import Scenario
from crashhunt.snapshots import versions
from crashhunt.trial import CRASHES, Outcome, TrialResult, TrialSpec


@pytest.fixture
def settings(tmp_path):
    for name, text in (("code/mine/agent.py", "x = 1"), ("code/mine/agent.pyc", "?"), ("files/w.npz", "w")):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return WorkerSettings(
        scenario=Scenario(simulator="toy", folder=tmp_path),
        oracles=(),
        crash_on=CRASHES,
        scratch=tmp_path / "scratch",
        code=(str(tmp_path / "code"),),
        argument_files={"weights": str(tmp_path / "files" / "w.npz")},
    )


def test_a_parcel_arrives_as_it_was_sent(settings, tmp_path):
    parcel = CodeArchive.of(settings)
    unpack(parcel.packed(), parcel.digest(), tmp_path / "there")
    there = settings_in(settings, parcel.folders, tmp_path / "there", tmp_path / "scratch there")
    assert [path.read_text() for path in (tmp_path / "there").rglob("*.py")] == ["x = 1"]
    assert not list((tmp_path / "there").rglob("*.pyc"))
    assert there.code == (str(tmp_path / "there" / "code" / "0"),)
    assert Path(there.argument_files["weights"]).read_text() == "w"
    assert there.scenario.folder.is_dir()
    assert there.scratch == tmp_path / "scratch there"


def test_what_can_be_run_can_be_run_there(settings, tmp_path):
    """And a parcel that was sent before somebody thought of that is not taken for it."""
    before = CodeArchive.of(settings).digest()
    (tmp_path / "code" / "mine" / "agent.py").chmod(0o700)
    parcel = CodeArchive.of(settings)
    assert parcel.digest() != before
    unpack(parcel.packed(), parcel.digest(), tmp_path / "there")
    assert os.access(tmp_path / "there" / "code" / "0" / "mine" / "agent.py", os.X_OK)
    assert not os.access(tmp_path / "there" / "files" / "0-w.npz", os.X_OK)


def test_a_name_is_any_that_a_file_can_have(settings, tmp_path):
    names = [os.fsdecode(name) for name in (b"not Unicode \xff", "übung".encode(), b"two\nlines", b"back\\slash")]
    for name in names:
        (tmp_path / "code" / "mine" / name).write_text(name, errors="surrogateescape")
    parcel = CodeArchive.of(settings)
    unpack(parcel.packed(), parcel.digest(), tmp_path / "there")
    there = (tmp_path / "there" / "code" / "0" / "mine").iterdir()
    assert {path.name for path in there} == {*names, "agent.py"}


def test_what_represents_the_current_folder_is_that_of_the_other_machine(settings, tmp_path, monkeypatch):
    """Where a snapshot has it: agents open their files by names that count from there."""
    for name in ("proj/agents/weights.txt", "else/agents/other.txt", "code/@proj/agents/weights.txt"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text("w")
    tree = tmp_path / "code" / "@proj"
    settings = replace(settings, code=(str(tmp_path / "code"), str(tree), str(tree / "agents")))
    homes = {}
    for folder in ("proj", "proj/agents", "else/agents", "."):
        monkeypatch.chdir(tmp_path / folder)
        homes[folder] = CodeArchive.of(settings).home
    assert homes == {"proj": "code/0/@proj", "proj/agents": "code/0/@proj/agents", "else/agents": "", ".": ""}


def test_a_folder_of_code_that_is_in_another_one_travels_once(settings, tmp_path):
    (tmp_path / "code" / "@proj" / "mine").mkdir(parents=True)
    (tmp_path / "code" / "@proj" / "mine" / "of.py").write_text("y = 1")
    inner = tmp_path / "code" / "@proj" / "mine"
    settings = replace(settings, code=(str(inner), str(tmp_path / "code"), str(tmp_path / "code" / "@proj")))
    parcel = CodeArchive.of(settings)
    assert len({*map(str, parcel.files.values())}) == len(parcel.files) == 3
    unpack(parcel.packed(), parcel.digest(), tmp_path / "there")
    there = settings_in(settings, parcel.folders, tmp_path / "there", tmp_path)
    for here, folder in zip(settings.code, there.code, strict=True):
        names = [sorted(path.relative_to(root) for path in Path(root).rglob("*.py")) for root in (here, folder)]
        assert names[0] == names[1] != []


def test_a_parcel_that_is_not_what_was_sent_is_refused(settings, tmp_path):
    parcel = CodeArchive.of(settings)
    packed, digest = parcel.packed(), parcel.digest()
    (tmp_path / "code" / "mine" / "agent.py").write_text("x = 2")
    assert CodeArchive.of(settings).digest() != digest
    changed = CodeArchive.of(settings).packed()
    leading_out = io.BytesIO()
    with zipfile.ZipFile(leading_out, "w") as archive:
        archive.writestr("../out.py", "x = 3")
    for number, bad in enumerate((changed, packed[:-30], b"", leading_out.getvalue())):
        with pytest.raises(BundleError, match="is damaged"):
            unpack(bad, digest, tmp_path / str(number))
    assert not (tmp_path / "out.py").exists()
    for at in range(0, len(packed), 3):  # some of which say nothing about what is in it
        with contextlib.suppress(BundleError):
            unpack(packed[:at] + bytes([packed[at] ^ 64]) + packed[at + 1 :], digest, tmp_path / f"flipped {at}")
            assert (tmp_path / f"flipped {at}" / "code" / "0" / "mine" / "agent.py").read_text() == "x = 1"


def test_a_folder_that_is_being_made_is_not_taken_for_one_that_was_left(tmp_path, monkeypatch):
    """Two hunts begin at once: one looks for what was left while the other one makes its folder, whenever that is."""
    (tmp_path / "store").mkdir()
    others, lock = [], fcntl.flock

    def late(file, operation):
        if not others:
            others.append(None)
            others[0] = Folder(tmp_path / "store")
        lock(file, operation)

    monkeypatch.setattr(fcntl, "flock", late)
    mine = Folder(tmp_path / "store")
    last = Folder(tmp_path / "store")
    for place in (mine, *others, last):
        assert place.path.exists()
        place.remove()


def test_a_node_states_what_differs(monkeypatch):
    here = versions()
    assert {"python", "crashhunt", "numpy"} <= {*here}
    assert Site().differs(here, code_digest()) == ""
    said = Site().differs({**here, "python": "3.0.0", "gone": "2"}, code_digest())
    assert re.fullmatch(r"python is [\d.]+ there and 3.0.0 here, gone is not installed there and 2 here", said)
    lacks = {**here, "_crashhunt_link_order": "installed"}
    find = importlib.util.find_spec
    for name, said in (
        ("os", ""),
        ("no_such_module", "_crashhunt_link_order is not installed there and installed here"),
    ):
        with monkeypatch.context() as context:
            context.setattr(
                "crashhunt.executors.ray._node_actor.importlib.util.find_spec",
                lambda asked, name=name: find(name if asked == "_crashhunt_link_order" else asked),
            )
            assert Site().differs(lacks, code_digest()) == said
    assert Site().differs(here, "other") == "crashhunt has the same version and other code there"
    monkeypatch.setattr("crashhunt.executors.ray._node_actor.importlib.util.find_spec", lambda name: None)
    assert Site().differs(here, code_digest.__name__) == "crashhunt cannot be found there (no such package)"


@pytest.mark.parametrize(
    ("order", "wanted"),
    [("fixed", {"_crashhunt_link_order": "installed"}), ("not fixed: the scenario says so", {}), (None, {})],
)
def test_a_node_needs_the_library_that_fixes_an_order(monkeypatch, order, wanted):
    monkeypatch.setattr("crashhunt.executors.ray._executor.load_order_of", lambda _: order)
    made = RayExecutor.__new__(RayExecutor)
    made._settings = SimpleNamespace(scenario=None)
    assert made._load_order() == wanted


def test_of_a_black_box_only_what_is_in_it_travels(settings, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "")  # which is set
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    box = BlackBox(tmp_path / layout.BLACK_BOX)
    box.begin(pid=1, trial=0, started=0.0)
    box.append(Tag.ROSTER, 0, bytes(range(1, 200)))
    job = {"settings": settings.to_json(), "digest": "", "folders": {}, "home": "", "slots": 1}
    content = Work(job)._content(tmp_path / layout.BLACK_BOX)
    assert len(content) < 1000
    (tmp_path / "there").write_bytes(content)
    assert list(read_black_box(tmp_path / "there")) == list(read_black_box(tmp_path / layout.BLACK_BOX)) != []


@pytest.fixture
def work(settings, tmp_path, monkeypatch):
    """Makes what runs trials on a node, four at a time; each call of its pool ends one of the trials."""
    monkeypatch.setattr("crashhunt.executors.ray._node_worker._GATHER_S", 60.0)

    def result(number, kept):
        return TrialResult(TrialSpec(number, number, {}, {}, max_steps=3), Outcome.SURVIVED, wall_s=0.0, kept=kept)

    with node_works(settings, tmp_path, monkeypatch) as make:
        yield lambda *ending: make(*([result(*one)] for one in ending), slots=4)


def test_a_node_prepares_only_with_code_that_arrived_whole(settings, tmp_path, monkeypatch):
    made = []
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "")
    monkeypatch.setattr(
        "crashhunt.executors.ray._node_worker.PoolExecutor", lambda given, **more: made.append((given, more)) or Pool()
    )
    parcel = CodeArchive.of(settings)
    job = {"settings": settings.to_json(), "digest": parcel.digest(), "folders": parcel.folders,
           "home": "", "slots": 4}  # fmt: skip
    node = Work(job)
    assert node.begin(parcel.packed()[:-30]) == "the parcel was damaged on its way"
    assert made == []
    assert node.begin(parcel.packed()) == "ready"
    [(given, more)] = made
    assert more == {"parallel": 4}
    assert (Path(given.code[0]) / "mine" / "agent.py").read_text() == "x = 1"
    assert given.scratch != settings.scratch
    node.close()


def test_whatever_an_agent_has_put_where_its_trial_is_recorded_the_node_continues(work):
    node = work((0, True))
    folder = scratch_of(node._place.scratch, 0)
    (folder / "deep" / "er").mkdir(parents=True)
    (folder / "link").symlink_to("nowhere")
    (folder / layout.RUN_LOG).write_text("said")
    news = node.take(0.0, submissions(0))
    assert {name: zlib.decompress(content) for name, content in news.ended[0].files.items()} == {"run.log": b"said"}
    assert not folder.exists()


def test_what_was_given_up_on_its_way_is_not_run(work):
    node = work()
    node.submit(submissions(1, 5))
    node.cancel(2, 107)
    node.take(0.0, submissions(2, 6))
    assert node._pool.submitted == [1, 2]
    node.submit(submissions(7))
    assert node._pool.submitted == [1, 2, 7], "which came later, and is meant"


def test_the_folder_of_a_cluster_is_removed_by_the_one_that_comes_after_its_owner(tmp_path):
    mine, left = Folder(tmp_path), Folder(tmp_path)
    heir = os.dup(left.fileno())  # as a process has it that was started
    left._lock.close()  # as when its process is killed
    (tmp_path / "chr-other").mkdir()
    Folder(tmp_path).remove()
    assert left.path.exists(), "somebody still uses it"
    os.close(heir)
    Folder(tmp_path).remove()
    mine.remove()
    assert [path.name for path in tmp_path.iterdir()] == ["chr-other"], "which is not of ours"


@pytest.mark.parametrize("usual", ["/größer", "/a-name-that-is-too-long-for-the-sockets-of-ray"])
def test_a_folder_in_which_ray_cannot_work_is_not_used(usual, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", usual)
    folder = Folder()
    folder.remove()
    assert folder.path.parent == Path("/tmp")


def roster(**slots):
    found = NodeScheduler()
    found.nodes = {name: Node(name, name, name, count, None, ready=True) for name, count in slots.items()}
    return found


def numbers(given):
    return {node.name: [trial.number for trial in trials] for node, trials in given.items()}


def test_trials_go_to_the_one_that_has_least_to_do_in_their_order():
    found = roster(a=2, b=1)
    found.waiting += [Trial(number, {"number": number}) for number in range(9)]
    assert numbers(found.assign()) == {"a": [0, 2, 3, 5], "b": [1, 4]}
    assert [trial.number for trial in found.waiting] == [6, 7, 8]
    assert found.ended(found.nodes["b"], 1)
    assert not found.ended(found.nodes["b"], 1), "it has ended"
    assert numbers(found.assign()) == {"b": [6]}
    found.cancel(4)
    assert not found.ended(found.nodes["b"], 6), "it was given up"
    assert not found.waiting
    assert not found.idle


def test_what_was_on_a_lost_node_runs_again_and_what_ends_every_node_in_the_end_alone():
    found = roster(a=1, b=1)
    found.waiting += [Trial(number, {"number": number}) for number in range(5)]
    given = numbers(found.assign())
    assert given == {"a": [0, 2], "b": [1, 3]}
    assert found.lose(found.nodes["a"]) == []
    assert [trial.number for trial in found.waiting] == [0, 2, 4]
    found.nodes["a"] = Node("a", "a", "a", 1, None, ready=True)
    assert numbers(found.assign()) == {"a": [0, 2]}
    assert found.lose(found.nodes["a"]) == []
    found.nodes["a"] = Node("a", "a", "a", 1, None, ready=True)
    assert numbers(found.assign()) == {"a": [0]}, "0 has been lost twice, and is alone now"
    assert numbers(found.assign()) == {}, "nobody joins it, and 2 waits for a node of its own"
    (culprit,) = found.lose(found.nodes["a"])
    assert culprit.number == 0
    assert 0 not in [trial.number for trial in found.waiting]


def test_who_is_alone_has_the_whole_machine():
    found = roster(a=2, b=2)
    found.nodes["b"].machine = "a"  # another part of it
    found.waiting += [Trial(0, {"number": 0}, losses=2), Trial(1, {"number": 1})]
    assert numbers(found.assign()) == {"a": [0]}
    assert numbers(found.assign()) == {}
    found.ended(found.nodes["a"], 0)
    assert [*numbers(found.assign()).values()] == [[1]]
