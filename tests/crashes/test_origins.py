"""Whose code a crash runs: that of this user alone, unless the user trusts another origin."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
from repositories import git

import crashhunt
from crashhunt.base.integrity import describe_files, digest_of_data
from crashhunt.cli import main
from crashhunt.crashes import (
    add_trusted,
    authenticate_bundle,
    export_crash,
    find_bundle,
    is_bundle_made_here,
    is_bundle_trusted,
    is_hunt_trusted,
    list_trusted,
    open_archive,
    refuse_untrusted,
    snapshot_of,
    trust_repositories,
    trust_repository,
    trust_snapshot,
)
from crashhunt.errors import UntrustedError
from crashhunt.replays import ReplayOptions, prepare
from crashhunt.scenario import digest_of_described
from crashhunt.snapshots import _take, latest_snapshot

AGENT = """
class Agent:
    def __init__(self, weights: str = "none", speed: float = 8.0): self.step = 0
    def reset(self, seed): pass
    def act(self, observation):
        self.step += 1
        assert self.step < 5
        return 6.0, 0
"""


def hunted(shell):
    """Hunt as this user, with two crashes, in ``mine``, and as another one in ``theirs``.

    crashhunt's own files, of which there are hundreds, are not in the snapshots: any file of them is one as any other.
    """
    take = _take._take_module
    for user in ("mine", "theirs"):
        (shell.folder / f"{user}_agents.py").write_text(AGENT)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(_take, "_take_module", lambda name, *more: name == "crashhunt" or take(name, *more))
            patch.setenv("XDG_STATE_HOME", str(shell.folder / f"state of {user}"))
            patch.chdir(shell.folder)
            patch.syspath_prepend(shell.folder)
            arguments = {"weights": "a.npz|b.npz", "speed": "5:9"}
            options = {"scenario": "toy", "keep_going": True, "seed": 1, "arguments": arguments}
            crashhunt.run(user, 1, 2, 99, agent=f"{user}_agents:Agent", **options)


@pytest.fixture
def place(toy, made_once, tmp_path, monkeypatch):
    """Both hunts, at which this user looks from an empty folder."""
    made_once(hunted, toy)
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state of mine"))
    monkeypatch.delenv("CI", raising=False)
    return tmp_path


def rewrite_crash(folder, **changes):
    """Change a crash.json as somebody would who has read how it is checked."""
    data = json.loads((folder / "crash.json").read_text())
    del data["integrity"]
    data |= changes
    (folder / "crash.json").write_text(json.dumps({**data, "integrity": digest_of_data(data)}))


def rewrite_snapshot(snapshot, *, keep_name=False):
    """Make a snapshot whole again after a change; return its digest."""
    manifest = json.loads((snapshot / "manifest.json").read_text())
    del manifest["integrity"]
    for name in manifest["files"]:
        manifest["files"][name] = describe_files((snapshot / name).parent)[Path(name).name]
    manifest["described"] = {name: describe_files(snapshot)[name] for name in manifest["described"]}
    (snapshot / "manifest.json").write_text(json.dumps({**manifest, "integrity": digest_of_data(manifest)}))
    digest = digest_of_described(manifest["files"], plain_data=[manifest["paths"], manifest["argument_files"]])
    if not keep_name:
        snapshot.rename(snapshot.with_name(digest))
    return digest


def crash_of(hunt, number=0):
    return find_bundle(hunt, str(number))


def test_what_was_made_here_is_trusted_wherever_it_is_now(place):
    assert is_bundle_trusted(crash_of(place / "mine"))
    assert is_bundle_made_here(crash_of(place / "mine", 1))
    assert is_hunt_trusted(place / "mine", latest_snapshot(place / "mine"))
    (place / "mine").rename(place / "moved")
    assert is_bundle_trusted(crash_of(place / "moved"))
    prepare(crash_of(place / "moved"), ReplayOptions())


@pytest.mark.parametrize("code", ["snapshot", "current"])
def test_what_another_user_made_is_refused_and_states_what_would_run(place, code):
    bundle = crash_of(place / "theirs")
    assert not is_bundle_trusted(bundle)
    assert not is_hunt_trusted(place / "theirs", latest_snapshot(place / "theirs"))
    for force in (False, True):
        with pytest.raises(UntrustedError) as caught:
            prepare(bundle, ReplayOptions(code=code, force=force))
        assert "theirs_agents:Agent and crashhunt" in caught.value.message
        assert bundle.snapshot in caught.value.message
        assert "crashhunt trust" in caught.value.fix
        assert "\n" not in str(caught.value)
    assert prepare(bundle, ReplayOptions(code=code, trusted=True)).worker.sealed is None
    assert prepare(bundle, ReplayOptions(code="log")).worker.sealed == (str(bundle.path),)


def test_judging_and_rewriting_keep_the_proof_and_make_none(place):
    for hunt, is_mine in (("mine", True), ("theirs", False)):
        crash_of(place / hunt).write()
        assert is_bundle_trusted(crash_of(place / hunt)) is is_mine
        assert bool(authenticate_bundle(crash_of(place / hunt))) is is_mine


ATTACKS = {}


def attack(function):
    ATTACKS[function.__name__] = function
    return function


@attack
def edited_module(place):
    module = next((place / "mine" / "snapshots").rglob("mine_agents.py"))
    module.write_text(module.read_text() + "\n")


@attack
def added_module(place):
    (next((place / "mine" / "snapshots").rglob("mine_agents.py")).parent / "numpy.py").touch()


@attack
def module_that_is_a_link(place):
    module = next((place / "mine" / "snapshots").rglob("mine_agents.py"))
    module.rename(place / "elsewhere.py")
    module.symlink_to(place / "elsewhere.py")


@attack
def edited_snapshot_with_new_digests_under_the_old_name(place):
    edited_module(place)
    rewrite_snapshot(next((place / "mine" / "snapshots").iterdir()), keep_name=True)


@attack
def edited_snapshot_with_new_digests_and_a_crash_that_names_it(place):
    edited_module(place)
    digest = rewrite_snapshot(next((place / "mine" / "snapshots").iterdir()))
    rewrite_crash(crash_of(place / "mine").path, snapshot=digest)


@attack
def edited_settings_in_the_snapshot(place):
    snapshot = next((place / "mine" / "snapshots").iterdir())
    for file in (snapshot / "hunt.toml", place / "mine" / "hunt.toml"):
        file.write_text(file.read_text().replace("mine_agents:Agent", "subprocess:Popen"))
    rewrite_snapshot(snapshot)


@attack
def swapped_snapshot(place):
    shutil.rmtree(place / "mine" / "snapshots")
    shutil.copytree(place / "theirs" / "snapshots", place / "mine" / "snapshots")
    shutil.copyfile(place / "theirs" / "hunt.toml", place / "mine" / "hunt.toml")
    rewrite_crash(crash_of(place / "mine").path, snapshot=crash_of(place / "theirs").snapshot)


@attack
def swapped_snapshot_under_the_name_of_the_old_one(place):
    name = crash_of(place / "mine").snapshot
    shutil.rmtree(place / "mine" / "snapshots")
    (place / "mine" / "snapshots").mkdir()
    shutil.copytree(next((place / "theirs" / "snapshots").iterdir()), place / "mine" / "snapshots" / name)
    shutil.copyfile(place / "theirs" / "hunt.toml", place / "mine" / "hunt.toml")


@attack
def crash_of_another_user_among_own_ones(place):
    shutil.rmtree(crash_of(place / "mine").path)
    shutil.copytree(crash_of(place / "theirs").path, place / "mine" / "crashes" / crash_of(place / "theirs").id)
    shutil.copytree(place / "theirs" / "snapshots", place / "mine" / "snapshots", dirs_exist_ok=True)


@attack
def crash_of_another_user_that_names_the_own_snapshot(place):
    crash_of_another_user_among_own_ones(place)
    rewrite_crash(crash_of(place / "mine").path, snapshot=crash_of(place / "mine", 1).snapshot)


@attack
def crash_of_another_user_with_a_copied_proof(place):
    code = crash_of(place / "mine").authentication_code
    crash_of_another_user_that_names_the_own_snapshot(place)
    rewrite_crash(crash_of(place / "mine").path, authentication_code=code, max_steps=98)


@attack
def link_to_a_crash_of_another_user(place):
    mine, theirs = crash_of(place / "mine"), crash_of(place / "theirs")
    shutil.rmtree(mine.path)
    mine.path.symlink_to(theirs.path)
    shutil.copytree(place / "theirs" / "snapshots", place / "mine" / "snapshots", dirs_exist_ok=True)


REWRITTEN = {  # of a crash.json
    "edited_arguments": lambda place: {"arguments": {"ego": {"weights": "/tmp/evil.npz", "speed": 6.0}}},
    "edited_seed": lambda place: {"seed": 77},
    "proof_of_another_own_crash": lambda at: {"authentication_code": crash_of(at / "mine", 1).authentication_code},
}  # fmt: skip
for name, changes in REWRITTEN.items():
    ATTACKS[name] = lambda place, of=changes: rewrite_crash(crash_of(place / "mine").path, **of(place))


def edit_settings(place, before, after):
    file = place / "mine" / "hunt.toml"
    assert before in file.read_text()
    file.write_text(file.read_text().replace(before, after))


for name, *edit in (("agent", "mine_agents:Agent", "subprocess:Popen"), ("oracle", '"overlap"', '"evil:Oracle"'),
                    ("text", "a.npz|b.npz", "a.npz|/tmp/evil.npz")):  # fmt: skip
    ATTACKS[f"{name}_in_hunt_toml"] = lambda place, edit=edit: edit_settings(place, *edit)


@attack
def proof_of_an_earlier_version_is_missing(place):
    data = json.loads((crash_of(place / "mine").path / "crash.json").read_text())
    del data["authentication_code"], data["integrity"]
    text = json.dumps({**data, "integrity": digest_of_data(data)})
    (crash_of(place / "mine").path / "crash.json").write_text(text)


@pytest.mark.parametrize("name", ATTACKS)
def test_what_is_not_as_it_was_made_here_is_not_trusted(place, name):
    before = crash_of(place / "mine").id
    ATTACKS[name](place)
    bundle = find_bundle(place / "mine", before)
    assert not is_bundle_trusted(bundle)
    with pytest.raises(UntrustedError):
        prepare(bundle, ReplayOptions(force=True))


def test_numbers_in_hunt_toml_may_be_edited(place):
    edit_settings(place, "max_steps = 99", "max_steps = 3")
    edit_settings(place, "5.0:9.0", "7.0:9.0")
    assert is_bundle_trusted(crash_of(place / "mine"))


def test_trust_holds_for_all_crashes_of_the_same_code_and_ends_with_it(place):
    theirs = place / "theirs"
    origin = trust_snapshot(latest_snapshot(theirs), theirs)
    assert "theirs_agents:Agent and crashhunt" in origin.runs
    assert is_bundle_trusted(crash_of(theirs))
    assert is_bundle_trusted(crash_of(theirs, 1))
    assert is_hunt_trusted(theirs, latest_snapshot(theirs))
    assert not is_bundle_made_here(crash_of(theirs))
    rewrite_crash(crash_of(theirs, 1).path, seed=77)  # numbers of trusted code
    assert is_bundle_trusted(crash_of(theirs, 1))
    rewrite_crash(crash_of(theirs, 1).path, arguments={"ego": {"weights": "/tmp/evil.npz", "speed": 6.0}})
    with pytest.raises(UntrustedError, match="texts that its hunt does not name"):
        prepare(crash_of(theirs, 1), ReplayOptions())
    file = theirs / "hunt.toml"
    whole = file.read_text()
    file.write_text(whole.replace("theirs_agents:Agent", "subprocess:Popen"))
    with pytest.raises(UntrustedError, match=r"hunt\.toml names 'subprocess:Popen'"):
        prepare(crash_of(theirs), ReplayOptions())
    file.write_text(whole)
    module = next((theirs / "snapshots").rglob("theirs_agents.py"))
    module.write_text(module.read_text() + "\n")
    digest = rewrite_snapshot(latest_snapshot(theirs).path)
    rewrite_crash(crash_of(theirs).path, snapshot=digest)
    assert not is_bundle_trusted(crash_of(theirs))


def test_archive_is_signed_only_where_the_crash_was_made_here(place):
    for hunt, is_mine in (("mine", True), ("theirs", False)):
        export_crash(crash_of(place / hunt), place / f"{hunt}.zip")
        with open_archive(place / f"{hunt}.zip") as archive:
            assert archive.made_here is is_mine
            assert is_bundle_trusted(find_bundle(archive.directory)) is is_mine
    trust_snapshot(latest_snapshot(place / "theirs"), place / "theirs")
    with open_archive(place / "theirs.zip") as archive:
        assert is_bundle_trusted(find_bundle(archive.directory))


def test_damaged_entries_are_not_listed(place):
    entry = add_trusted("ab" * 32, path="x", runs="x")
    folder = place / "state of mine" / "crashhunt" / "trusted"
    (folder / "empty.json").touch()
    add_trusted("ef" * 32, path="y", runs="y")
    (folder / f"{'ef' * 32}.json").rename(folder / f"{'cd' * 32}.json")
    (folder / "list.json").write_text("[]")
    assert list_trusted() == [entry]


def test_what_the_repository_of_the_current_folder_tracks_is_trusted(place, monkeypatch):
    repository = place / "repository"
    repository.mkdir()
    git(repository, "init", "--quiet")
    git(repository, "config", "core.fsmonitor", f"touch '{place / 'ran'}'; false")
    shutil.copytree(place / "theirs", repository / "kept")
    bundle = crash_of(repository / "kept")
    monkeypatch.chdir(repository)
    assert not is_bundle_trusted(bundle)  # unpacked there, and not committed
    git(repository, "-c", "core.fsmonitor=false", "add", "--all")
    assert not is_bundle_trusted(bundle)  # the .git may have come with the folder
    assert f"run crashhunt trust {repository} once" in refuse_untrusted(bundle).fix
    monkeypatch.setenv("CI", "true")
    assert is_bundle_trusted(bundle)
    monkeypatch.delenv("CI")
    assert trust_repository(repository).path == str(repository)
    assert is_bundle_trusted(bundle)
    assert is_hunt_trusted(repository / "kept", snapshot_of(bundle))
    (repository / "below").mkdir()
    monkeypatch.chdir(repository / "below")
    assert is_bundle_trusted(bundle)
    monkeypatch.chdir(place)  # a folder that came with a .git of its own
    assert not is_bundle_trusted(bundle)
    monkeypatch.chdir(repository)
    shutil.copytree(place / "theirs", place / "outside")
    (repository / "link").symlink_to(place / "outside")
    assert not is_bundle_trusted(crash_of(repository / "link"))
    git(repository, "-c", "core.fsmonitor=false", "rm", "-r", "--cached", "--quiet", "kept/crashes")
    assert not is_bundle_trusted(bundle)
    assert not (place / "ran").exists()


def test_repository_is_known_by_its_place_and_not_by_what_it_contains(place, monkeypatch):
    mine, other = place / "repository", place / "repository" / "unpacked"
    mine.mkdir()
    git(mine, "init", "--quiet")
    trust_repositories([str(mine)])
    shutil.copytree(place / "theirs", other / "kept")
    bundle = crash_of(other / "kept")
    git(other, "init", "--quiet")
    git(other, "add", "--all")
    monkeypatch.chdir(other)
    assert not is_bundle_trusted(bundle)
    (other / ".git").rename(other / "its-git")
    git(other, "--git-dir", "its-git", "config", "core.worktree", str(mine))  # claims the work tree of this user
    git(mine, "--git-dir", str(other / "its-git"), "--work-tree", ".", "add", "--all")
    (other / "its-git").rename(other / ".git")
    assert not is_bundle_trusted(bundle)
    (other / ".git").rename(other / "its-git")
    (other / ".git").write_text(f"gitdir: {mine}/.git\n")  # uses the repository of this user
    git(mine, "--work-tree", "unpacked", "add", "--all")
    assert not is_bundle_trusted(bundle)
    (other / ".git").unlink()
    git(mine, "add", "--all", "--force")
    assert is_bundle_trusted(bundle)


def test_job_of_a_ci_trusts_its_folder_where_there_is_no_repository(place, monkeypatch):
    bundle = crash_of(place / "theirs")
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(place.parent))
    monkeypatch.setenv("CI", "true")
    assert not is_bundle_trusted(bundle)
    monkeypatch.chdir(place)
    assert is_bundle_trusted(bundle)
    git(place, "init", "--quiet")
    assert not is_bundle_trusted(bundle)


def test_command_lists_and_removes(place, capsys):
    def crashhunt(*words):
        with pytest.raises(SystemExit) as left:
            main(["trust", *map(str, words)])
        said = capsys.readouterr()
        return left.value.code, said.out, said.err

    assert "You trust no code" in crashhunt()[1]
    code, out, _ = crashhunt(place / "theirs", "--json")
    (entry,) = json.loads(out)["trusted"]
    assert (code, entry["path"]) == (0, str(place / "theirs"))
    assert "theirs_agents:Agent" in entry["runs"]
    assert json.loads(crashhunt("--json")[1])["trusted"] == [entry]
    assert entry["fingerprint"][:12] in crashhunt()[1]
    assert json.loads(crashhunt("--remove", place / "theirs", "--json")[1])["removed"] == [entry]
    assert json.loads(crashhunt("--json")[1]) == {"trusted": []}
    export_crash(crash_of(place / "theirs"), place / "x.zip")
    for named in (place / "x.zip", crash_of(place / "theirs").path, place):
        code, out, _ = crashhunt(named, "--json")
        fingerprints = {one["fingerprint"] for one in json.loads(out)["trusted"]}
        assert entry["fingerprint"] in fingerprints, named
        crashhunt(*(word for fingerprint in fingerprints for word in ("--remove", fingerprint)))
    os.mkfifo(place / "pipe")
    for words, says in (
        ((place / "thiers",), "does not exist"),
        ((place / "pipe",), "is a device or a pipe"),
        ((place / "toy",), "has no code that could run"),
        ((place / "theirs", "--remove", "x"), "cannot be combined"),
        (("--remove", "x"), "no trusted origin has this name"),
    ):
        code, _, err = crashhunt(*words)
        assert (code, says in err, len(err.splitlines())) == (2, True, 1), err
    next((place / "theirs" / "snapshots").rglob("theirs_agents.py")).write_text("evil")
    code, _, err = crashhunt(place / "theirs")
    assert (code, "has changed" in err) == (2, True)
    assert list_trusted() == []
    crash = crash_of(place / "theirs")
    (place / "theirs" / "hunt.toml").unlink()
    assert "would run its code, which cannot be described: " in refuse_untrusted(crash).message
