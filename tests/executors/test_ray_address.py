"""Which cluster is meant, and what is said where there is none; without Ray."""

from __future__ import annotations

import contextlib
import importlib.metadata
import re
import socket
import sys
import threading
import time

import pytest

from crashhunt.base.errors import PluginError, UsageError
from crashhunt.base.extras import install_command
from crashhunt.episode import WorkerSettings
from crashhunt.executors.ray import RayExecutor
from crashhunt.executors.ray._cluster import OLDEST_RAY_VERSION, cluster_of, require_ray
from crashhunt.scenario import Scenario
from crashhunt.trial import CRASHES

SETTINGS = bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])  # what every HTTP/2 server says first


@pytest.fixture(autouse=True)
def _nothing_is_set(monkeypatch, tmp_path):
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("RAY_ADDRESS", "RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH", "RAY_USE_TLS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("crashhunt.executors.ray._executor.require_ray", lambda: None)


@pytest.fixture
def settings(tmp_path):
    (tmp_path / "scratch").mkdir()
    scenario = Scenario(simulator="toy", folder=tmp_path)
    return WorkerSettings(scenario=scenario, oracles=(), crash_on=CRASHES, scratch=tmp_path / "scratch")


@contextlib.contextmanager
def listener(answer):
    """Somebody who says the same to everybody, and nothing where that is None; yields the address."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve():
            with contextlib.suppress(OSError):
                while True:
                    connection, _ = server.accept()
                    if answer is None:
                        held.append(connection)
                        continue
                    with connection, contextlib.suppress(OSError):  # who has asked may be gone
                        connection.sendall(answer)

        held = []
        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"127.0.0.1:{server.getsockname()[1]}"
        server.shutdown(socket.SHUT_RDWR)
        thread.join()
        for connection in held:
            connection.close()


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("127.0.0.1:1", "--executor ray:127.0.0.1:1: no cluster answers there (Connection refused); start a cluster"),
        ("nowhere", "--executor ray:nowhere is not an address HOST:PORT; write --executor ray:nowhere:6379"),
        ("a:b", "--executor ray:a:b is not an address HOST:PORT; write --executor ray:a:6379"),
        (".x:1", "--executor ray:.x:1: no machine can have that name; start a cluster with"),
        ("ray://x:10001", "--executor ray:ray://x:10001 is an address of the Ray Client, which hunts do not support"),
        (
            "http://x:8265",
            "--executor ray:http://x:8265 is an address of a service such as Ray's dashboard, which hunts",
        ),
        ("auto", "--executor ray:auto: no Ray cluster runs on this machine; start a cluster"),
    ],
)
def test_an_address_that_leads_nowhere_is_one_line(settings, argument, message):
    began = time.monotonic()
    with pytest.raises(UsageError) as raised:
        RayExecutor(settings, argument=argument)
    assert message in str(raised.value)
    assert time.monotonic() - began < 60  # Ray itself gives up after two minutes
    assert [path.name for path in settings.scratch.iterdir()] == []


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (b"HTTP/1.0 400 Bad Request\r\n\r\n", "what answers there is not the head of a Ray cluster; start a cluster"),
        (b"", "what answers there is not the head of a Ray cluster; start a cluster"),
        (None, "a process listens there and does not answer; start a cluster"),
    ],
)
def test_the_one_that_answers_and_is_no_cluster_is_reported_from_one(monkeypatch, answer, message):
    for limit in ("_ANSWER_S", "_PROBE_TIMEOUT_S"):
        monkeypatch.setattr(f"crashhunt.executors.ray._cluster.{limit}", 0.5)
    with listener(answer) as address:
        with pytest.raises(UsageError) as raised:
            cluster_of(address)
        assert f"--executor ray:{address}: {message}" in str(raised.value)
        monkeypatch.setenv("RAY_USE_TLS", "1")
        assert cluster_of(address).address == address, "what is encrypted is left to Ray"


def test_a_hunt_that_no_one_would_run_ends_at_once(toy):
    began = time.monotonic()
    words = ("run", "h", "0", "4", "20", "--scenario", "toy", "--executor", "ray:127.0.0.1:1")
    said = toy.crashhunt(*words, expect=2).err.splitlines()
    assert said[-1].startswith(
        "crashhunt: --executor ray:127.0.0.1:1: no cluster answers there (Connection refused); start"
    )
    assert time.monotonic() - began < 60  # Ray itself gives up after two minutes
    assert not [*(toy.folder / "h").glob(".scratch*")]


def test_the_address_may_stand_in_the_environment(settings, monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    with pytest.raises(UsageError, match=r"RAY_ADDRESS=127\.0\.0\.1:1: no cluster answers there"):
        RayExecutor(settings)


def test_a_token_goes_to_no_one_but_a_cluster_that_runs_here(monkeypatch, tmp_path):
    """And there only where it is asked for."""
    assert cluster_of("").address == ""
    assert cluster_of("").environment != cluster_of("local").environment, "our own get a new one each"
    if_asked = {"RAY_AUTH_MODE": "token"}
    with listener(SETTINGS) as address:
        (tmp_path / "ray").mkdir()
        (tmp_path / "ray" / "ray_current_cluster").write_text(address)
        assert cluster_of("") == cluster_of("auto") == (address, {}, {})
        (tmp_path / ".ray").mkdir()
        (tmp_path / ".ray" / "auth_token").write_text("secret")
        assert cluster_of("") == (address, {}, if_asked)
        assert cluster_of(address) == (address, {}, if_asked)
        monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
        assert cluster_of("") == (address, {}, {})
        monkeypatch.setenv("RAY_ADDRESS", address)
        assert cluster_of("auto") == (address, {}, {})
        assert cluster_of("local").address == ""
        monkeypatch.setenv("RAY_AUTH_MODE", "token")
        assert cluster_of("") == (address, {}, {})
        (tmp_path / ".ray" / "auth_token").unlink()
        with pytest.raises(UsageError, match="RAY_AUTH_MODE is token, but there is no token; put the token with"):
            cluster_of("")
    monkeypatch.delenv("RAY_ADDRESS")
    assert cluster_of("").address == "", "one that has ended is none"
    monkeypatch.delenv("RAY_AUTH_MODE")
    monkeypatch.setenv("RAY_AUTH_TOKEN", "secret")
    monkeypatch.setattr("crashhunt.executors.ray._cluster.silent", lambda address: "")
    assert cluster_of("127.0.0.1:6379").spare == if_asked
    assert cluster_of("198.51.100.7:6379").spare == {}, "another machine"


def test_without_ray_it_states_how_to_get_it(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(PluginError, match=re.escape(f"which is not installed; {install_command('ray')}")):
        require_ray()


def test_a_folder_of_that_name_is_not_ray(monkeypatch, tmp_path):
    (tmp_path / "ray").mkdir()
    monkeypatch.setattr("sys.path", [str(tmp_path)])
    monkeypatch.delitem(sys.modules, "ray", raising=False)
    with pytest.raises(PluginError, match="which is not installed"):
        require_ray()


@pytest.mark.parametrize(
    ("version", "good"), [("2.9.3", False), ("1.13.0", False), ("2.10.0", True), ("3.0.0.dev0", True)]
)
def test_a_ray_that_is_too_old_is_named(version, good, monkeypatch, tmp_path):
    (tmp_path / "ray").mkdir()
    (tmp_path / "ray" / "__init__.py").write_text("raise ImportError('of something else')")
    (tmp_path / f"ray-{version}.dist-info").mkdir()
    (tmp_path / f"ray-{version}.dist-info" / "METADATA").write_text(f"Name: ray\nVersion: {version}\n")
    monkeypatch.delitem(sys.modules, "ray", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    if good:
        require_ray()
        return
    said = f"needs Ray 2.10 or newer, and {version} is installed; pip install 'ray>=2.10', on every machine"
    with pytest.raises(PluginError, match=re.escape(said)):
        require_ray()


def test_the_oldest_ray_is_the_one_that_is_installed_with_crashhunt():
    wanted = [line for line in importlib.metadata.requires("crashhunt") if line.startswith("ray")]
    assert {line.partition(";")[0].strip() for line in wanted} == {f"ray>={'.'.join(map(str, OLDEST_RAY_VERSION))}"}
