"""Which plausible slips the nearest tests do not notice. Run it as ``scripts/mutate``.

A slip is put into a copy of the repository, and of the tests nearest to its module those run that reach its line, the
fastest first, and then those that start processes, which may reach it unseen, up to the first that fails. Nearest are
the tests that lie as the module does: those of ``crashhunt/world/_scene.py`` are ``tests/world/test_scene*.py``, and
where there are none all of ``tests/world``. Tests that import a module by its name are near to it too, those of a
private one wherever they lie. `_TESTS_ELSEWHERE` lists tests that use it under another name, or as a command.

Each run is a fork of this process, which has imported everything that is not crashhunt: about a second a slip, where a
process of its own would take four. mutmut and cosmic-ray were looked at: the former chooses among all tests by what it
has traced, and works inside the tree; the latter starts a process a slip, and changes the files in place.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import importlib
import json
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from copies import ROOT, Slot, Watcher
from slips import Slip, find_slips

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

ENOUGH = 0.2  # the share of survivors that is tolerated
EQUIVALENT = ROOT / "scripts" / "tools" / "equivalent_slips.json"
_SURVEY_S = 900  # of the processor, for all nearest tests of a package
_TESTS_ELSEWHERE = {
    # Tests of the accelerator compare it with highway-env through the simulator.
    "highway/accelerator": ("on_highway/accelerator/test_*.py", "on_highway/test_dynamic_*.py"),
    "agents/_program_logs.py": ("agents/test_programs.py",),
    "agents/_fmu_agents.py": ("agents/test_fmu_agents.py", "agents/test_library_agents.py"),
    "agents/_reference_models.py": ("agents/test_competent_drivers.py", "testing/test_r157.py"),
    "agents/planners": ("agents/test_planner_adapters.py",),
    "api.py": ("test_python_calls.py", "e2e/test_api.py"),
    "crash_api.py": ("test_python_calls.py", "e2e/test_api.py"),
    "base/codec.py": ("base/test_codec.py", "trial/test_result.py"),
    "base/doors.py": ("test_public_face.py",),
    "base/errors.py": ("base/test_exception_text.py", "requirements/test_language.py"),
    "base/library_probe.py": ("agents/test_library_agents.py", "base/test_binaries.py"),
    "base/process_owners.py": ("base/test_temporary.py",),
    "base/shared_memory.py": ("base/test_temporary.py",),
    "base/text.py": ("base/test_text.py", "report/test_table.py"),
    "base/foreign_code.py": ("base/test_scalars.py", "episode/test_blame.py", "episode/test_probes_of_a_trial.py"),
    "base/exceptions.py": ("base/test_exception_text.py", "episode/test_episode_cases.py"),
    "base/isolation.py": ("base/test_isolated_work.py",),
    "base/opened_files.py": ("snapshots/test_sources.py", "snapshots/test_unsaved.py"),
    "base/agent_locators.py": (
        "agents/test_fmu_agents.py",
        "agents/test_library_agents.py",
        "agents/test_programs.py",
        "base/test_binaries.py",
        "snapshots/test_projects.py",
    ),
    "base/progress.py": ("base/test_calls.py",),
    "base/resources.py": ("base/test_limits.py", "base/test_memory.py"),
    "base/forks.py": ("base/test_reaper.py", "episode/test_fork.py", "episode/test_forks.py"),
    "base/git.py": ("base/test_builds.py", "base/test_git.py"),
    "base/integrity.py": ("base/test_integrity.py", "base/test_authentication.py"),
    "native/_generators.py": ("native/test_generator_seeds.py",),
    "panels": ("render/test_panels*.py", "render/test_pictures.py"),
    # These are tested as users run them: as commands.
    "cli/__init__.py": ("cli/test_answers.py", "e2e/test_commands.py"),
    "cli/_bisect.py": ("cli/test_answers_on_crashes.py",),
    "cli/_check.py": ("e2e/test_check.py",),
    "cli/_common.py": ("cli/test_answers.py", "e2e/test_commands.py"),
    "cli/_compare.py": (
        "cli/test_answers_on_crashes.py",
        "e2e/test_manage.py",
    ),
    "cli/_completion.py": ("e2e/test_completion.py",),
    "cli/_corpus.py": ("e2e/test_corpus.py",),
    "cli/_crashes.py": ("cli/test_answers_on_crashes.py",),
    "cli/_dashboard.py": ("dashboard/test_command.py",),
    "cli/_export.py": ("e2e/test_export.py",),
    "cli/_gate.py": ("e2e/test_gate.py",),
    "cli/_guide.py": ("e2e/test_guide.py",),
    "cli/_init.py": ("e2e/test_init.py",),
    "cli/_judge.py": ("e2e/test_judging.py",),
    "cli/_list.py": ("e2e/test_listing.py",),
    "cli/_logs.py": (
        "cli/test_answers_on_crashes.py",
        "e2e/test_manage.py",
    ),
    "cli/_rate.py": ("e2e/test_crash_rates.py",),
    "cli/_replay.py": ("e2e/test_replay.py",),
    "cli/_report.py": ("report/test_page.py",),
    "cli/_run.py": ("e2e/test_run_help.py", "e2e/test_commands.py", "e2e/test_stops.py"),
    "cli/_show.py": ("cli/test_answers_on_crashes.py",),
    "cli/_shrink.py": ("cli/test_answers_on_crashes.py",),
    "cli/_split.py": (
        "cli/test_answers.py",
        "training/test_held_out_traffics.py",
    ),
    "cli/_status.py": ("cli/test_status.py",),
    "cli/_suite.py": ("e2e/test_suite.py",),
    "cli/_trials.py": (
        "cli/test_answers.py",
        "e2e/test_manage.py",
    ),
    "cli/_trust.py": ("cli/test_common.py", "e2e/test_foreign_hunts.py"),
    "cli/_whatif.py": ("e2e/test_what_if.py",),
    "corpus": ("corpus/test_*.py", "e2e/test_corpus.py"),
    "corpus/_bisection.py": ("corpus/test_bisection.py",),
    "crashes/_before_contact.py": ("crashes/test_contact_record.py", "crashes/test_fault.py"),
    "crashes/_bundle_trust.py": ("e2e/test_foreign_hunts.py",),
    "crashes/_saved_crashes.py": ("crashes/test_archive.py", "crashes/test_bundle.py"),
    "crashes/_encounter.py": ("crashes/test_danger_course.py",),
    "envs": ("envs/test_*.py",),
    "episode/_reference_driver_correction.py": ("episode/test_reference_driver.py",),
    "episode/_episode.py": ("episode/test_episode*.py", "episode/test_fork.py", "native/test_usual_steps.py"),
    "episode/_fast_path.py": ("native/test_usual_steps.py", "episode/test_episode*.py"),
    "episode/_branches.py": ("episode/test_branching.py",),
    "guide": ("e2e/test_guide.py", "base/test_json_schema.py"),
    "statistics/_hunt_pairs.py": ("suites/test_gate_of_hunts.py", "e2e/test_gate.py"),
    # Processes of trials are seen by what is left of trials that harm them.
    "executors/_fork_server.py": (
        "executors/test_harms.py",
        "executors/test_lost_processes.py",
        "executors/test_warm_traffics.py",
    ),
    "executors/_fresh.py": ("executors/test_harms.py", "executors/test_new_processes.py"),
    "executors/_pool.py": ("executors/test_lost_processes.py",),
    "executors/_trial_attempts.py": ("executors/test_what_is_left.py",),
    "executors/_trial_report.py": ("executors/test_evidence.py",),
    "executors/_protocol.py": ("executors/test_pool_of_trials.py",),
    "executors/_supervisor.py": ("executors/test_killed_trials.py", "executors/test_warm_traffics.py"),
    "executors/_trial_folder.py": ("executors/test_supervisors.py", "executors/test_killed_trials.py"),
    "executors/_time_limits.py": ("executors/test_last_words.py",),
    "executors/_worker_environment.py": ("executors/test_new_processes.py",),
    "executors/_trial_process.py": ("executors/test_harms.py", "executors/test_warm_traffics.py"),
    "executors/ray": (
        "executors/test_ray_address.py",
        "executors/test_ray_bridge.py",
        "executors/test_ray_connection.py",
        "executors/test_ray_store.py",
    ),
    # What a hunt does is seen by whole hunts.
    "hunts/_hunt_file_check.py": ("e2e/test_check.py",),
    "hunts/_salvage.py": ("e2e/test_check.py",),
    "results/_found_crashes.py": ("hunts/test_whole_hunts.py",),
    "hunts/_fork_results.py": ("hunts/test_from_the_start.py", "hunts/test_whole_hunts.py"),
    "hunts/_hunt.py": (
        "hunts/test_rare_hunts.py",
        "hunts/test_states_and_reports.py",
        "hunts/test_whole_hunts.py",
        "e2e/test_hunt.py",
    ),
    "hunts/_hunt_setup.py": ("hunts/test_states_and_reports.py", "e2e/test_hunt.py"),
    "hunts/_next_trials.py": ("hunts/test_verified_runs.py", "hunts/test_whole_hunts.py"),
    "statistics/_gate_verdict.py": ("statistics/test_paired_test.py",),
    "statistics/_rate_of_running_hunt.py": ("e2e/test_crash_rates.py",),
    "hunts/_reports.py": ("hunts/test_states_and_reports.py", "hunts/test_whole_hunts.py"),
    "results/_trial_table.py": ("hunts/test_hunt_parts.py", "results/test_results.py"),
    "results/_hunt_results.py": ("results/test_*.py", "e2e/test_manage.py"),
    "results/_hunt_state.py": ("results/test_directory.py", "hunts/test_hunt_parts.py"),
    "hunts/_audits.py": ("hunts/test_states_and_reports.py", "hunts/test_verified_runs.py"),
    "hunts/_verification.py": ("hunts/test_whole_hunts.py", "hunts/test_from_the_start.py"),
    "oracles/_requirement_oracle.py": (
        "episode/test_trial_signals.py",
        "native/test_usual_steps.py",
        "oracles/test_choice.py",
    ),
    # These are fast, and their tests lie by what a user does, not by module.
    "sumo/maps": ("on_sumo/maps/test_*.py",),
    "recording": ("recording/test_*.py",),
    "render": ("render/test_*.py",),
    "report": ("report/test_*.py",),
    "scenario": ("scenario/test_*.py",),
    "plans/_arguments.py": ("agents/test_programs.py", "plans/test_argument_names.py"),
    "replays/_debugger.py": ("e2e/test_debugger.py",),
    "replays/_prepare.py": ("e2e/test_foreign_hunts.py", "e2e/test_replay.py"),
    "replays/_replaying.py": ("e2e/test_replay.py",),
    # Tests of simulators lie by what a user does; these are the ones that drive on the simulator of the module.
    "simulators/_any_space.py": ("simulators/test_actions.py", "on_gym/test_gym.py"),
    "simulators/_kinematics_observation.py": (
        "on_sumo/test_left_hand.py",
        "on_sumo/test_sumo.py",
        "on_highway/test_highway.py",
    ),
    "simulators/_standstill.py": ("on_sumo/test_events.py",),
    "gym": ("on_gym/test_*.py", "simulators/test_any_space.py"),
    "highway": (
        "on_highway/test_*.py",
        "on_sumo/test_events.py",
        "simulators/test_left_out.py",
        "simulators/test_scripted.py",
    ),
    "sumo": (
        "on_sumo/test_erring.py",
        "on_sumo/test_events.py",
        "on_sumo/test_left_hand.py",
        "on_sumo/test_places_around_sumo.py",
        "on_sumo/test_right_of_way.py",
        "on_sumo/test_stepping_out.py",
        "on_sumo/test_sumo*.py",
        "on_sumo/test_surroundings.py",
        "on_sumo/test_world.py",
        "simulators/test_left_out.py",
        "simulators/test_scripted.py",
    ),
    "sumo/_ego_and_actors.py": ("on_sumo/test_lights.py", "on_sumo/test_observed_parts.py"),
    "sumo/_fleet.py": ("testing/test_r157.py",),
    "sumo/_lane_graph.py": ("on_sumo/test_observed_parts.py", "on_sumo/test_right_of_way.py"),
    "sumo/_observing.py": ("on_sumo/test_observed_parts.py",),
    "sumo/_reader_protocol.py": ("on_sumo/test_observed_parts.py",),
    "sumo/_lane_paths.py": ("on_sumo/test_observed_parts.py", "on_sumo/test_road_readers.py"),
    "sumo/_right_of_way_readers.py": ("on_sumo/test_observed_parts.py", "on_sumo/test_road_readers.py"),
    "sumo/_scene_readers.py": ("on_sumo/test_observed_parts.py", "on_sumo/test_road_readers.py"),
    "sumo/_scripted.py": ("on_sumo/test_manoeuvres.py", "simulators/test_scripted.py"),
    "sumo/_fast_step.py": ("native/test_usual_steps.py",),
    "sumo/_traffic_survey.py": ("hunts/test_traffic_survey.py",),
    "simulators/toy.py": (
        "simulators/test_toy.py",
        "episode/test_disturbed.py",
        "episode/test_episode*.py",
        "testing/test_broken_contracts.py",
    ),
    "snapshots": ("snapshots/test_*.py", "e2e/test_snapshot.py"),
    "snapshots/_differences.py": ("snapshots/test_changes.py", "base/test_binaries.py", "e2e/test_snapshot.py"),
    "suites": ("suites/test_*.py", "e2e/test_suite.py", "e2e/test_gate.py"),
    "testing/_backend_contract.py": ("scenario/test_backends.py",),
    "testing/_disturbance_contract.py": ("disturbances/test_rates.py",),
    "testing/_last_avoidable_step_check.py": ("e2e/test_escapes.py",),
    "testing/_survives.py": ("e2e/test_survives.py",),
    "executors/_preparation.py": ("executors/test_zygotes.py",),
    "analysis/_avoidability.py": ("analysis/test_judged_crash.py", "test_python_calls.py", "e2e/test_judging.py"),
    "analysis/_causes.py": ("analysis/test_judged_crash.py", "e2e/test_judging.py"),
    "analysis/_omissions.py": ("analysis/test_judged_crash.py",),
    "analysis/_whatif_runs.py": ("e2e/test_what_if.py",),
    "analysis/_delta_debugging.py": ("analysis/test_what_is_tried.py",),
    "analysis/_driver_runs.py": ("analysis/test_judged_crash.py", "e2e/test_preventability.py"),
    "analysis/_minimization.py": ("analysis/test_what_is_tried.py",),
    "analysis/_interventions.py": ("analysis/test_what_is_counted.py", "e2e/test_what_if.py"),
    "analysis/_types_by_cause.py": ("analysis/test_division_by_cause.py",),
    "world": ("world/test_*.py",),
    "world/_events.py": ("on_sumo/test_events.py",),
    "world/_manoeuvre_motions.py": ("world/test_manoeuvre_motions.py",),
}
"""Module or package to its nearest tests, as patterns below `tests`."""


@dataclass(slots=True)
class Target:
    """A module to put slips into, as it was when this began.

    Args:
        package: what it was asked for by.
        file: relative to the repository.
        source: its text.
        tests: the nearest test files, likewise.
        reached: test to the lines that it runs; those that run at import have no test.
        seconds: test to how long it takes.
        forked: tests that start processes, which may reach any line: a slip survives only if these pass too.
    """

    package: str
    file: Path
    source: str
    tests: Sequence[Path]
    reached: dict[str, set[int]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    forked: set[str] = field(default_factory=set)

    def tests_of(self, slip: Slip) -> list[str]:
        """Return the tests that reach a slip, the fastest first, and then those that may, as they start processes."""
        lines = range(slip.span[0], slip.span[1] + 1)
        imported = not self.reached.get("", set()).isdisjoint(lines)
        found = [test for test, reached in self.reached.items() if test and not reached.isdisjoint(lines)]
        if imported and not found:
            found = [test for test, reached in self.reached.items() if test and reached] or [*self.seconds]
        last = self.forked.difference(found)
        return sorted((*found, *last), key=lambda test: (test in last, self.seconds[test], test))


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of a slip.

    Args:
        target: where it was.
        slip: which.
        noticed: ``failed`` or ``timeout``; empty where no test noticed it.
        reached: whether any of the tests runs its line.
        reason: why no test can notice it, where `EQUIVALENT` lists it; empty else.
    """

    target: Target
    slip: Slip
    noticed: str
    reached: bool = True
    reason: str = ""


def all_packages() -> list[str]:
    """Return the packages of crashhunt, and its modules that are in none."""
    folder = ROOT / "crashhunt"
    packages = [path.parent.name for path in folder.glob("*/__init__.py")]
    modules = [path.stem for path in folder.glob("*.py") if not path.stem.startswith("__")]
    return sorted(packages) + sorted(modules)


def equivalents() -> dict[tuple[str, str], str]:
    """Return the slips that change nothing that a test could see: module and diff to the reason.

    A person has looked at each. The diff names the slip, as the report prints it: line numbers change too often.
    """
    listed = json.loads(EQUIVALENT.read_text(encoding="utf-8"))
    return {(one["module"], "\n".join(one["diff"])): one["reason"] for one in listed}


def stale_equivalents(listed: dict[tuple[str, str], str]) -> list[str]:
    """Return the modules of listed slips that cannot be made any more, because the code has changed."""
    found: set[tuple[str, str]] = set()
    for module in {module for module, _ in listed}:
        source = (ROOT / module).read_text(encoding="utf-8") if (ROOT / module).is_file() else ""
        # A diff is slow to make, so it is made of lines that are listed only.
        removed = {line[1:] for of, diff in listed if of == module for line in diff.split("\n") if line.startswith("-")}
        slips = (slip for slip in find_slips(source) if not removed.isdisjoint(slip.lines(source)))
        found |= {(module, slip.diff(source)) for slip in slips}
    return sorted(module for module, diff in listed if (module, diff) not in found)


def without_equivalents(
    slips: list[tuple[Target, Slip]], listed: dict[tuple[str, str], str]
) -> tuple[list[tuple[Target, Slip]], list[Verdict]]:
    """Divide slips into those that are tried and those that are listed, which no test could notice."""
    tried, known = [], []
    for target, slip in slips:
        reason = listed.get((str(target.file), slip.diff(target.source)), "")
        if reason:
            known.append(Verdict(target, slip, "", reason=reason))
        else:
            tried.append((target, slip))
    return tried, known


def modules_of(name: str) -> list[Path]:
    """Return the files that a package or a module of crashhunt has; of a module also its private neighbours."""
    path = ROOT / "crashhunt" / name.replace(".", "/").removesuffix("/py")
    if path.is_dir():
        return sorted(file.relative_to(ROOT) for file in path.rglob("*.py"))
    found = [file for file in path.parent.glob("*.py") if file.stem.lstrip("_").startswith(path.name.lstrip("_"))]
    if not found:
        raise SystemExit(f"there is no module {name!r} in crashhunt: give a package or a module such as world.scene")
    return sorted(file.relative_to(ROOT) for file in found)


def nearest_tests(file: Path) -> tuple[Path, ...]:
    """Return the test files that lie as a module does, that import it, or that run its examples.

    Of a public module, only tests of its package count: all others import the foundations, too.
    """
    module = ".".join(file.with_suffix("").parts)
    found = [path for path, names in _imported_by_tests().items() if module in names]
    if not file.stem.startswith("_"):
        found = [path for path in found if path.parts[1] == file.parts[1]]
    if ">>> " in (ROOT / file).read_text(encoding="utf-8"):
        found.append(Path("tests/test_examples.py"))
    return tuple(dict.fromkeys((*_tests_in_place(file), *found)))


_FROM = re.compile(r"^ *from (\S+) import (?:\(([^)]*)\)|(.+))", re.MULTILINE)


@functools.cache
def _imported_by_tests() -> dict[Path, set[str]]:
    """Return what each test file imports, also in code that it writes for another Python.

    Tests of whole commands import only what they need to begin. The text is searched: to parse all tests takes 2 s.
    """
    found: dict[Path, set[str]] = {}
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        if path.parent.name != "e2e":
            names = found[path.relative_to(ROOT)] = set()
            for module, several, one in _FROM.findall(path.read_text(encoding="utf-8")):
                listed = " ".join(line.partition("#")[0] for line in (several or one).split("\n"))
                names |= {module, *(f"{module}.{name.split()[0]}" for name in listed.split(",") if name.strip())}
    return found


def _tests_in_place(file: Path) -> tuple[Path, ...]:
    """Return the test files of a module's name, or of its folder, or of the folder above that."""
    inside = file.relative_to("crashhunt")
    module, *packages = (str(inside), *map(str, [*inside.parents][:-1]))
    # Tests of simulators lie in `on_sumo` and its like.
    of_simulator = f"on_{inside.parts[0]}/**/test_{file.stem.strip('_')}*.py"
    for patterns in (
        _TESTS_ELSEWHERE.get(module, ()),
        (of_simulator,),
        *(_TESTS_ELSEWHERE.get(name, ()) for name in packages),
    ):
        found = [path for pattern in patterns for path in sorted((ROOT / "tests").glob(pattern))]
        if found:
            return tuple(path.relative_to(ROOT) for path in found)
    words = file.stem.strip("_").split("_")
    inner = ROOT / "tests" / file.parent.relative_to("crashhunt")
    end_to_end = ROOT / "tests" / "e2e"
    for folder in (inner, *inner.parents):
        if folder == ROOT / "tests":
            break
        if not folder.is_dir():
            continue
        for count in range(len(words), 0, -1):  # of `_ledger_file`, those of `ledger` are better than none
            found = sorted(folder.glob(f"test_{'_'.join(words[:count])}*.py"))
            if found:
                return tuple(path.relative_to(ROOT) for path in found)
        return tuple(sorted(path.relative_to(ROOT) for path in folder.glob("test_*.py")))
    # Commands, and what is in no package, have tests that run the command line.
    own = end_to_end / f"test_{'_'.join(words)}.py"
    return ((own if own.is_file() else end_to_end / "test_commands.py").relative_to(ROOT),)


def targets_of(name: str, tests: Sequence[Path] | None = None) -> list[Target]:
    """Return the modules of a package with the tests nearest to each, or with those that are given."""
    return [
        Target(
            package=name,
            file=file,
            source=(ROOT / file).read_text(encoding="utf-8"),
            tests=tests or nearest_tests(file),
        )
        for file in modules_of(name)
    ]


def say(line: str) -> None:
    """Tell whoever waits how far it is."""
    if sys.stderr.isatty():
        print(f"\r\033[K{line}", end="", file=sys.stderr, flush=True)


def survey(slot: Slot, targets: list[Target]) -> str:
    """Run the tests of some modules without a slip, and note what they reach.

    Returns:
        What pytest prints, where they fail; else empty.
    """
    files = sorted({str(path) for target in targets for path in target.tests})
    if not files:
        return ""
    watcher = Watcher([str(slot.tree / target.file) for target in targets])
    slot.start(files, seconds=_SURVEY_S, watcher=watcher)
    if slot.wait() != "passed":
        return slot.said() or "it took too long"
    facts = json.loads((slot.tree / ".facts").read_text(encoding="utf-8"))
    for target in targets:
        mine = {test for test in facts["seconds"] if test.partition("::")[0] in map(str, target.tests)}
        found = facts["reached"][str(slot.tree / target.file)]
        target.seconds = {test: facts["seconds"][test] for test in mine}
        target.forked = mine.intersection(facts["forked"])
        target.reached = {test: set(lines) for test, lines in found.items() if not test or test in mine}
    for name in facts["modules"]:  # so that the forks have them
        with contextlib.suppress(Exception):
            importlib.import_module(name)
    return ""


def judge(slots: list[Slot], name: str, chosen: list[tuple[Target, Slip]]) -> list[Verdict]:
    """Put in one slip after another, as many at a time as there are slots, and return what became of each."""
    verdicts: list[Verdict] = []
    waiting = chosen[::-1]
    running: dict[int, tuple[Target, Slip]] = {}
    while waiting or running:
        for number, slot in enumerate(slots):
            if number in running:
                ended = slot.poll()
                if ended is None:
                    continue
                target, slip = running.pop(number)
                slot.put(target.file, target.source)
                verdicts.append(Verdict(target, slip, "" if ended == "passed" else ended))
            while waiting and number not in running:
                target, slip = waiting.pop()
                tests = target.tests_of(slip)
                if tests:
                    slot.put(target.file, slip.apply(target.source))
                    slot.start(tests, seconds=10 + 4 * sum(target.seconds[test] for test in tests))
                    running[number] = target, slip
                else:
                    verdicts.append(Verdict(target, slip, "", reached=False))
        survivors = sum(not verdict.noticed for verdict in verdicts)
        say(f"{name}: {len(verdicts)} of {len(chosen)} slips, {survivors} not noticed")
        time.sleep(0.02)
    return verdicts


def counted(name: str, verdicts: list[Verdict]) -> dict[str, Any]:
    """Return the figures of a package or a module; slips that are equivalent are counted apart."""
    tried = [verdict for verdict in verdicts if not verdict.reason]
    equivalent, verdicts = len(verdicts) - len(tried), tried
    survived = sum(not verdict.noticed for verdict in verdicts)
    return {
        "name": name,
        "slips": len(verdicts),
        "equivalent": equivalent,
        "survived": survived,
        "unreached": sum(not verdict.reached for verdict in verdicts),
        "timeouts": sum(verdict.noticed == "timeout" for verdict in verdicts),
        "share": round(survived / len(verdicts), 3) if verdicts else 0.0,
    }


def described(verdict: Verdict) -> dict[str, Any]:
    """Return a slip that nobody noticed."""
    target, slip = verdict.target, verdict.slip
    diff = slip.diff(target.source)
    where = f"{target.file}:{slip.line}"
    return {"where": where, "what": slip.what, "reached": verdict.reached, "diff": diff}


def shown(facts: dict[str, Any]) -> str:
    """Return the report in words."""
    lines = []
    for slip in facts["survivors"]:
        reached = "" if slip["reached"] else " (no test reaches it)"
        lines += [f"{slip['where']}: {slip['what']}{reached}", slip["diff"], ""]
    lines += [f"{slip['where']}: {slip['what']}: equivalent: {slip['reason']}" for slip in facts["equivalent"]]
    lines += [f"{EQUIVALENT.name} lists a slip of {module} that its code does not have" for module in facts["stale"]]
    lines.append(f"{'not noticed by the nearest tests':<44}{'slips':>7}{'not':>7}{'share':>8}{'equivalent':>12}")
    for kind in ("modules", "packages"):
        for row in facts[kind]:
            figures = f"{row['slips']:>7}{row['survived']:>7}{row['share']:>8.0%}{row['equivalent']:>12}"
            lines.append(f"{row['name']:<44}{figures}")
        lines.append("")
    return "\n".join(lines)


def parsed() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(prog="scripts/mutate", description=__doc__.splitlines()[0])
    parser.add_argument("--module", action="append", help="a package or module; may be given again (default: all)")
    parser.add_argument(
        "--part", type=_part, default=(1, 1), metavar="I/N", help="the I-th of N shares of all packages"
    )
    parser.add_argument("--tests", action="append", type=Path, metavar="FILE", help="these, instead of the nearest")
    parser.add_argument("--sample", type=int, metavar="N", help="so many slips of each package, instead of all")
    parser.add_argument("--seed", type=int, default=0, help="of the sample (default: 0)")
    parser.add_argument("--parallel", type=int, default=2, metavar="N", help="how many run at once (default: 2)")
    parser.add_argument("--at-most", type=float, default=ENOUGH, metavar="SHARE", help="exit with 1 above (0.2)")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    return parser.parse_args()


def _part(text: str) -> tuple[int, int]:
    part, parts = map(int, text.split("/"))
    if not 1 <= part <= parts:
        raise ValueError
    return part, parts


@contextlib.contextmanager
def _folder() -> Iterator[Path]:
    """Make a folder that only this process removes: a test may fork, and a fork may end as a whole Python does."""
    folder = Path(tempfile.mkdtemp(prefix="crashhunt-mutate-"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def main() -> int:
    """Run, and return 1 where too many slips of a package survive."""
    options = parsed()
    os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    for number in (signal.SIGINT, signal.SIGTERM):  # also where a shell has started it in the background
        signal.signal(number, signal.default_int_handler)
    verdicts: list[Verdict] = []
    part, parts = options.part
    asked = options.module or all_packages()[part - 1 :: parts]
    failed: list[str] = []
    listed = equivalents()
    everything = {name: targets_of(name, options.tests) for name in asked}
    with _folder() as folder:
        slots = [Slot(folder / str(number)) for number in range(options.parallel)]
        try:
            for name, targets in everything.items():
                slips = [(target, slip) for target in targets for slip in find_slips(target.source)]
                slips, known = without_equivalents(slips, listed)
                if options.sample is not None and options.sample < len(slips):
                    slips = random.Random(f"{options.seed} {name}").sample(slips, options.sample)
                slips.sort(key=lambda found: (found[0].file, found[1].start))
                say(f"{name}: the tests without any slip")
                chosen = {target.file for target, _ in slips}
                failure = survey(slots[0], [target for target in targets if target.file in chosen])
                if failure:  # the other packages can still be measured
                    failed.append(name)
                    print(f"{name}: the tests fail without any slip:\n{failure}", file=sys.stderr)
                    continue
                verdicts += known + judge(slots, name, slips)
        except KeyboardInterrupt:
            return 130
        finally:
            for slot in slots:
                slot.kill()
            say("")
    verdicts.sort(key=lambda verdict: (verdict.target.file, verdict.slip.start))
    files = dict.fromkeys(verdict.target.file for verdict in verdicts)
    facts: dict[str, Any] = {
        "modules": [counted(str(file), [each for each in verdicts if each.target.file == file]) for file in files],
        "packages": [
            counted(name, [each for each in verdicts if each.target.package == name])
            for name in asked
            if name not in failed
        ],
        "failed": failed,
        "survivors": [described(verdict) for verdict in verdicts if not verdict.noticed and not verdict.reason],
        "equivalent": [described(verdict) | {"reason": verdict.reason} for verdict in verdicts if verdict.reason],
        "stale": stale_equivalents(listed),
    }
    print(json.dumps(facts, indent=1) if options.json else shown(facts))
    return int(bool(failed or facts["stale"]) or any(row["share"] > options.at_most for row in facts["packages"]))


if __name__ == "__main__":
    sys.exit(main())
