"""Attacks on the dashboard: each must be refused, and the page must go on."""

from __future__ import annotations

import json
import os
import shutil
import socket
import sqlite3
from contextlib import closing, suppress

import pytest
from conftest import crashes_on_loop, mostly_nightly
from dashboard_hunts import written
from served import served

from crashhunt.dashboard import _serving


@pytest.fixture
def hunt(shell, made_once):
    """A real hunt of the toy simulator with crashes, in ``runs/one``."""
    return made_once(crashes_on_loop, shell).folder / "runs"


def test_every_answer_forbids_what_is_not_ours(hunt):
    with served(hunt) as dashboard:
        for target, host in (("/", "localhost"), ("/nothing", "localhost"), ("/api/hunts", "localhost"), ("/", "evil")):
            headers = dashboard.ask(target, {"Host": host}).headers
            policy = dict(part.strip().partition(" ")[::2] for part in headers["content-security-policy"].split(";"))
            assert policy["default-src"] == "'none'"
            assert policy["script-src"] == "'self'"
            assert policy["frame-ancestors"] == "'none'"
            assert headers["x-content-type-options"] == "nosniff"
            assert headers["x-frame-options"] == "DENY"
            assert "access-control-allow-origin" not in headers


def test_pages_have_no_inline_script_and_no_foreign_address(hunt):
    with served(hunt) as dashboard:
        for page in ("/", "/hunts/x", "/hunts/x/crashes/y", "/compare"):
            text = dashboard.ask(page).body.decode()
            assert text.count("<script") == text.count(' src="/static/')
            assert "http://" not in text
            assert "https://" not in text
            assert " onclick=" not in text


def test_no_path_leads_out_of_the_folders(hunt, tmp_path):
    (tmp_path / "secret.txt").write_text("a secret")
    with served(hunt) as dashboard:
        one = f"/api/hunts/{dashboard.hunts()['one']['id']}"
        paths = [
            "/../secret.txt", "/static/../../secret.txt", "/static/..%2f..%2fsecret.txt", "/static/%2e%2e/secret.txt",
            f"{one}/crashes/../../secret.txt", f"{one}/crashes/..%2f..%2fsecret/log", f"{one}/crashes/%2e%2e/log",
            f"{one}/crashes/%00/log", "/api/hunts/..%2fone", f"/api/hunts/{hunt}/one", "/static//etc/passwd",
            "/api/hunts/..\\..\\x",
        ]  # fmt: skip
        for path in paths:
            reply = dashboard.ask(path)
            assert reply.status == 404, path
            assert b"a secret" not in reply.body


def test_links_out_of_the_folders_are_not_followed(hunt, tmp_path):
    outside = tmp_path / "outside"
    shutil.copytree(hunt / "one", outside)
    (hunt / "linked").symlink_to(outside)
    shutil.copytree(hunt / "one", hunt / "ledger")
    (hunt / "ledger" / "ledger.sqlite").unlink()
    (hunt / "ledger" / "ledger.sqlite").symlink_to(outside / "ledger.sqlite")
    crash = sorted((hunt / "one" / "crashes").iterdir())[0]
    secret = tmp_path / "secret.txt"
    secret.write_text("a secret")
    (crash / "log.mcap").unlink()
    (crash / "log.mcap").symlink_to(secret)
    (crash / "run.log").unlink(missing_ok=True)
    (crash / "run.log").symlink_to(secret)
    (hunt / "one" / "crashes" / "999999-collision").symlink_to(outside / "crashes" / crash.name)
    with served(hunt) as dashboard:
        rows = dashboard.hunts()
        assert "linked" not in rows
        assert rows["ledger"]["state"] == "error"
        assert "ledger.sqlite is a symbolic link to a place outside" in rows["ledger"]["detail"]
        assert rows["one"]["state"] == "crashed"  # the others are as they were
        one = f"/api/hunts/{rows['one']['id']}"
        listed = {row["id"]: row for row in dashboard.get(f"{one}/crashes")["crashes"]}
        for name in (crash.name, "999999-collision"):
            assert "is a symbolic link to a place outside" in listed[name]["damaged"]
            for what in ("", "/log", "/export"):
                reply = dashboard.ask(f"{one}/crashes/{name}{what}")
                assert reply.status in (404, 422)
                assert b"a secret" not in reply.body


@pytest.mark.parametrize("name", ["hunt.toml", "run.log", "ledger.sqlite", "manifest.json", "crash.json", "huge"])
def test_files_without_an_end_are_not_opened(hunt, name):
    crash = sorted((hunt / "one" / "crashes").iterdir())[0]
    folders = {"manifest.json": next((hunt / "one" / "snapshots").iterdir()), "crash.json": crash}
    path = folders.get(name, hunt / "one") / name
    if name == "huge":
        path = hunt / "one" / "hunt.toml"
        os.truncate(path, 1 << 30)  # more than is read, and no more than a process may write
    else:
        path.unlink(missing_ok=True)
        os.mkfifo(path)
    with served(hunt) as dashboard:
        try:
            row = dashboard.hunts()["one"]
            one = f"/api/hunts/{row['id']}"
            for target in ("", "/trials", "/importance", "/crashes", "/map"):
                assert dashboard.ask(one + target).status == 200
            refused = [dashboard.ask(f"{one}/crashes/{crash.name}{what}") for what in ("", "/export")]
            assert {reply.status for reply in refused} == {422}
            said = refused[0].json["error"]["message"] if name == "crash.json" else row["detail"]
            assert ("(allowed: 4,194,304)" if name == "huge" else f"{name} is neither a file nor a folder") in said
        finally:  # a thread that waits for the other end would outlive the test
            with suppress(OSError):
                os.close(os.open(path, os.O_WRONLY | os.O_NONBLOCK))


def test_a_request_that_does_not_end_loses_its_connection(hunt, monkeypatch):
    monkeypatch.setattr(_serving, "_REQUEST_S", 0.2)
    monkeypatch.setattr(_serving, "_KEEP_ALIVE_S", 1)  # of a second request that came with the first
    with served(hunt) as dashboard:
        for begun in (
            b"",
            b"GET /api HTTP/1.1\r\nHost: local",
            b"GET /api HTTP/1.1\r\nHost: localhost\r\n\r\nGET /api",
        ):
            with socket.create_connection(("127.0.0.1", dashboard.port), timeout=30) as connection:
                connection.sendall(begun)
                received = b""
                while part := connection.recv(65536):  # it ends, although this side goes on
                    received += part
                assert received.count(b"HTTP/1.1 200") == (b"\r\n\r\n" in begun)


@pytest.mark.parametrize(  # by day, ledger/test_ledger_damage.py finds each kind
    "damage", mostly_nightly(["garbage", "truncated", "a fact", "a row", "no table"], always=["garbage", "a row"])
)
def test_a_damaged_ledger_costs_its_own_row(hunt, shell, damage):
    shutil.copytree(hunt / "one", hunt / "two")
    ledger = hunt / "two" / "ledger.sqlite"
    if damage == "garbage":
        ledger.write_bytes(os.urandom(20_000))
    elif damage == "truncated":
        ledger.write_bytes(ledger.read_bytes()[: ledger.stat().st_size // 2])
    else:
        with closing(sqlite3.connect(ledger)) as database, database:
            if damage == "a fact":
                database.execute("UPDATE hunt SET value = '[1' WHERE key = 'state'")
            elif damage == "a row":
                database.execute("UPDATE trials SET result = '<img src=x onerror=alert(1)>' WHERE number = 1")
            else:
                database.execute("DROP TABLE trials")
    with served(hunt) as dashboard:
        rows = dashboard.hunts()
        assert rows["one"]["state"] == "crashed"
        two = f"/api/hunts/{rows['two']['id']}"
        for target in ("", "/trials", "/importance", "/crashes", "/map"):
            assert dashboard.ask(two + target).status == 200
        said = [rows["two"]["detail"], *dashboard.get(two)["problems"]]
        assert any("crashhunt check" in line or "not a ledger" in line for line in said), said
        if damage in ("a fact", "a row"):
            checked = shell.crashhunt("check", str(hunt / "two"), expect=None)
            told = (
                "a fact has changed since it was written"
                if damage == "a fact"
                else "trial 1 has changed since it was written"
            )
            assert told in " ".join(said)
            assert told in checked.out + checked.err or damage == "a row"


def test_nothing_is_written_into_the_folder_of_a_hunt(hunt):
    before = {path: written(path) for path in sorted(hunt.rglob("*"))}
    hunt.joinpath("one").chmod(0o555)
    try:
        with served(hunt) as dashboard:
            one = f"/api/hunts/{dashboard.hunts()['one']['id']}"
            crash = dashboard.get(f"{one}/crashes")["crashes"][0]["id"]
            for target in ("", "/trials", "/importance", "/map", f"/crashes/{crash}", f"/crashes/{crash}/log"):
                assert dashboard.ask(one + target).status == 200
            assert dashboard.ask(f"{one}/crashes/{crash}/export").body[:2] == b"PK"
            names = ",".join(row["id"] for row in dashboard.hunts().values())
            assert dashboard.ask(f"/api/compare?hunts={names}").status == 200
    finally:
        hunt.joinpath("one").chmod(0o755)
    assert {path: written(path) for path in sorted(hunt.rglob("*"))} == before


def test_json_of_a_strange_hunt_is_json(hunt):
    settings = hunt / "one" / "hunt.toml"
    settings.write_text(
        settings.read_text().replace("# crashhunt", "# \u2028<script>alert(1)</script>\x7f crashhunt", 1)
    )
    with served(hunt) as dashboard:
        row = dashboard.get(f"/api/hunts/{dashboard.hunts()['one']['id']}")
        assert "<script>" in row["command"]  # as text, which the page shows as text
        reply = dashboard.ask("/api/hunts")
        assert reply.headers["content-type"] == "application/json"
        json.loads(reply.body)


def test_a_folder_that_only_looks_like_a_hunt_costs_its_own_row(hunt):
    for name, text in (("empty", ""), ("not-toml", "= ="), ("other", "a = 1")):
        folder = hunt / name
        folder.mkdir()
        (folder / "hunt.toml").write_text(text)
    (hunt / "folder" / "ledger.sqlite").mkdir(parents=True)
    with served(hunt) as dashboard:
        rows = dashboard.hunts()
        assert rows["one"]["state"] == "crashed"
        for name in ("empty", "not-toml", "other", "folder"):
            assert rows[name]["state"] in ("error", "queued"), rows[name]
