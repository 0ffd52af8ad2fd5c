"""The contract suite for descriptors of simulators."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import fields, is_dataclass, replace
from importlib import metadata
from typing import TYPE_CHECKING

import pytest
import tomli_w

from crashhunt.base import layout
from crashhunt.base.errors import ScenarioError
from crashhunt.base.plugins import registered
from crashhunt.episode import WorkerSettings
from crashhunt.plans import Request, plan
from crashhunt.scenario import Backend, Scenario, as_plain_data, backend_of, load_scenario, scenario_digest, with_action
from crashhunt.world import EVENT_WORDS

if TYPE_CHECKING:
    from pathlib import Path

# The name of a simulator goes in, and whether its module was imported comes out.
_IMPORTED = """
import sys
from crashhunt.base.plugins import registered
from crashhunt.scenario import backend_of, load_scenario
load_scenario(sys.argv[2]).backend
imported = set(sys.modules)
print(registered("simulators")[sys.argv[1]].load().__module__ in imported)
"""


class BackendContract:
    """Checks a descriptor against `crashhunt.scenario.Backend`.

    The fixture ``name`` returns the name under which the simulator and its descriptor are registered. ``scenario``
    returns the folder of a valid scenario that uses all features of the simulator's table: files, texts and options.
    """

    @pytest.fixture
    def name(self) -> str:
        """Return the name of the simulator."""
        raise NotImplementedError("the test class must define the fixture 'name'")

    @pytest.fixture
    def scenario(self) -> Path:
        """Return the folder of a scenario."""
        raise NotImplementedError("the test class must define the fixture 'scenario'")

    def _backend(self, name: str) -> Backend:
        found = backend_of(name)
        assert found is not None, f"{name!r} is registered in neither crashhunt.backends nor crashhunt itself"
        return found

    def test_it_belongs_to_a_registered_simulator(self, name: str, scenario: Path) -> None:
        """A scenario that names the simulator uses this descriptor."""
        assert name in registered("simulators")
        loaded = load_scenario(scenario)
        assert loaded.simulator == name
        assert loaded.backends == {name: self._backend(name)}

    def test_it_is_known_without_the_simulator(self, name: str, scenario: Path) -> None:
        """Commands that only read a scenario import neither slow libraries nor libraries that run once per process."""
        command = [sys.executable, "-P", "-c", _IMPORTED, name, str(scenario)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.stdout.strip() == "False", done.stderr

    def test_a_wrong_key_in_its_table_is_named(self, name: str, scenario: Path, tmp_path: Path) -> None:
        """The error message contains the most similar key."""
        backend = self._backend(name)
        if backend.table is None:
            with pytest.raises(ScenarioError, match=f"unknown key '{name}'"):
                self._loaded_with(scenario, tmp_path, {name: {}})
            return
        assert is_dataclass(backend.table)
        key = fields(backend.table)[0].name
        table = as_plain_data(load_scenario(scenario))[name]
        assert isinstance(table, dict)
        with pytest.raises(ScenarioError) as caught:
            self._loaded_with(scenario, tmp_path, {name: {**table, f"{key}x": 1}})
        assert f"unknown key '{name}.{key}x'" in str(caught.value)
        assert f"did you mean '{key}'?" in str(caught.value)
        assert "\n" not in str(caught.value)

    def _loaded_with(self, scenario: Path, folder: Path, changes: dict[str, object]) -> Scenario:
        copy = shutil.copytree(scenario, folder / "changed")
        data = {**as_plain_data(load_scenario(scenario)), **changes}
        (copy / layout.SCENARIO).write_text(tomli_w.dumps(data), encoding="utf-8")
        return load_scenario(copy)

    def test_its_files_are_all_that_an_episode_reads(self, name: str, scenario: Path, tmp_path: Path) -> None:
        """All files lie in the folder; together with scenario.toml they are the complete scenario."""
        loaded = load_scenario(scenario)
        files = list(loaded.files())
        assert len(files) == len(set(files))
        assert set(loaded.texts()) <= set(files)
        copy = tmp_path / "only-the-files"
        copy.mkdir()
        for file in (layout.SCENARIO, *files):
            (copy / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(scenario / file, copy / file)
        moved = load_scenario(copy)
        assert list(moved.files()) == files
        assert scenario_digest(replace(moved, name=loaded.name)) == scenario_digest(loaded)
        for file in loaded.texts():
            relocated = self._backend(name).relocated
            assert relocated is None or isinstance(relocated(loaded.folder / file), bytes | None)

    def test_the_digest_is_that_of_every_file(self, scenario: Path, tmp_path: Path) -> None:
        """Other contents of a file result in another digest."""
        loaded = load_scenario(shutil.copytree(scenario, tmp_path / "copied" / scenario.name))
        before = scenario_digest(loaded)
        assert scenario_digest(load_scenario(scenario)) == before
        for file in list(loaded.files()):
            path = loaded.folder / file
            content = path.read_bytes()
            path.write_bytes(content + b"\n")
            assert scenario_digest(loaded) != before
            path.write_bytes(content)
        assert scenario_digest(loaded) == before

    def test_it_crosses_to_workers_and_to_snapshots(self, scenario: Path, tmp_path: Path) -> None:
        """Reading a written scenario returns the same scenario; the table keeps its name."""
        loaded = load_scenario(scenario)
        settings = WorkerSettings(scenario=loaded, oracles=(), crash_on=(), scratch=tmp_path)
        sent = json.loads(json.dumps(settings.to_json()))
        assert WorkerSettings.from_json(sent).scenario == replace(loaded, file=layout.SCENARIO)
        assert set(loaded.tables) <= set(sent["scenario"])
        resolved = shutil.copytree(scenario, tmp_path / "resolved")
        (resolved / layout.SCENARIO).write_text(tomli_w.dumps(as_plain_data(loaded)), encoding="utf-8")
        kept = load_scenario(resolved, kept=True)
        assert kept.tables == loaded.tables
        assert scenario_digest(kept) == scenario_digest(loaded)

    def test_what_it_states_of_the_simulator_can_be_used(self, name: str, scenario: Path) -> None:
        """Versions belong to installed packages, times are numbers of seconds, and descriptions are texts."""
        backend, loaded = self._backend(name), load_scenario(scenario)
        assert backend.title
        for distribution in backend.versions:
            # As it spells itself: so it is written down, and looked up in what was.
            assert metadata.metadata(distribution)["Name"] == distribution
        assert 0 < backend.step_length_s(loaded) < float("inf")
        assert set(backend.reported_events or ()) <= EVENT_WORDS.keys()
        assert all(note and "\n" not in note for note in backend.notes(loaded))
        assert all(module and ":" not in module for module in loaded.modules())
        assert all(ending.startswith(".") for found in backend.configurations for ending in found.endings)
        for form in backend.actions:
            for agent in loaded.agents:
                assert with_action(loaded, agent, form).agents[agent].action == form

    def test_without_its_accelerator_it_is_the_same_scenario(self, name: str, scenario: Path) -> None:
        """Disabling the accelerator twice has the same result as once, and results in no note."""
        accelerator, loaded = self._backend(name).accelerator, load_scenario(scenario)
        if accelerator is not None:
            plain = accelerator.switched_off(loaded)
            assert accelerator.switched_off(plain) == plain
            assert accelerator.note(plain) == ""

    def test_it_answers_for_strangers_or_not_at_all(self, name: str, scenario: Path) -> None:
        """The side effects of an untrusted scenario are reported in one line."""
        backend = self._backend(name)
        loaded, settings = plan(Request(trials=1, max_steps=1, scenario=scenario, seed=1))
        values = {argument: setup.default for argument, setup in loaded.arguments.items() if setup.default is not None}
        if backend.side_effect is not None:
            found = backend.side_effect(loaded, values, [spec.spec for spec in settings.scenario_arguments.values()])
            assert isinstance(found, str)
            assert "\n" not in found
