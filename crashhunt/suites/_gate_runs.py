"""A gate: compares two versions by hunts in the same traffic, and returns a verdict on the change.

BASE and HEAD are two commits of a Git repository, each built and imported in a temporary work tree, or two agents.
Their hunts run at the same time, each in its own process, with the same seed. The traffic and the disturbances of a
trial follow from the seed and the number of the trial, not from the agent's actions. The hunts end as soon as
`PairWatch` decides.

The hunts of a suite run one pair after another, because the order of all pairs must not depend on results.
"""

from __future__ import annotations

import fcntl
import json
import math
import secrets
import time
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from crashhunt.base import layout
from crashhunt.base.agent_locators import is_program
from crashhunt.base.errors import BusyError, CrashhuntError, HuntDirectoryError, NoValidTrialError, UsageError
from crashhunt.base.files import whole_file
from crashhunt.base.git import (
    files_outside,
    git,
)
from crashhunt.base.plugins import registered
from crashhunt.base.temporary import temporary_folder
from crashhunt.ledger import Ledger
from crashhunt.plans import read_settings
from crashhunt.results import HuntDirectory, hunt_state, is_hunt
from crashhunt.scenario import load_scenario
from crashhunt.statistics import GateCase, GateReport, PairedHunts, PairWatch, check_confidence, measure_rates
from crashhunt.suites._gate_corpus import run_corpus
from crashhunt.suites._gate_preventable_crashes import PreventableCrashes
from crashhunt.suites._gate_versions import GateVersion, WorkTrees
from crashhunt.suites._processes import run_all, slots_of
from crashhunt.suites._request_file import REQUEST, RunRequest, refuse_untrusted_hunt, write_request
from crashhunt.training import held_out_traffics

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from crashhunt.plans import Given
    from crashhunt.statistics import CrashRate, PairVerdict

GATE: Final = "gate.json"
"""What a gate compares, in the folder with its hunts."""
_LOCK = ".lock"
BASE, HEAD = "base", "head"
_BUNDLES_PER_TYPE = 3  # kept of each crash type: a gate counts crashes, and shows some
_BUSY_S, _LOOK_EVERY_S = 15.0, 0.1
_MIN_SLOTS = 2  # trials at a time: BASE and HEAD run side by side


@dataclass(frozen=True, slots=True)
class GateProgress:
    """Progress of a running gate, for display."""

    name: str  # name of the running hunt
    done: int  # number of finished pairs of trials in all hunts
    most: int  # maximum number of pairs
    only_base: int  # number of pairs in which only BASE crashes
    only_head: int  # number of pairs in which only HEAD crashes
    evidence: float  # e-value against the hypothesis that both versions crash equally often


@dataclass(frozen=True, kw_only=True)
class Gate:
    """The two versions that a gate compares, and the limits of the comparison."""

    base: GateVersion  # the version before the change
    head: GateVersion  # the version that contains the change
    # name and request of each hunt that both versions run; the ``trials`` of a request are ignored
    hunts: Mapping[str, RunRequest]
    folder: Path  # folder from which the user imports agents
    most: int  # maximum number of pairs of trials in all hunts together
    duration_s: float = math.inf  # maximum wall time, in s; infinite for no limit
    # the greatest difference in crashes per trial that counts as equivalent; 0 to disable the verdict of equivalence
    margin: float = 0.0
    confidence: float = 95.0  # confidence of the verdict, in percent
    # path of HEAD's corpus, relative to the folder. If it is None, ``crashes`` is used if HEAD is a commit that
    # contains it.
    corpus: Path | None = None
    parallel: int = 0  # number of trials at a time, of both versions together; 0 for one per core
    # whether there may be several hunts; in that case, only the verdict *worse* ends the gate before the last hunt
    is_suite: bool = False
    trusted: bool = False  # whether existing hunts and the corpus may run even if they are not trusted
    machine: Given | None = None  # execution options, such as ``executor``, that apply to all hunts
    # whether a collision counts only if a model of a competent driver would have prevented it. Crashes without a
    # collision partner always count.
    only_preventable: bool = False
    build: str = ""  # command line that builds each commit in its work tree; empty for no build
    build_limit_s: float = math.inf  # maximum wall time of a build, in s

    def run(
        self,
        directory: Path | None = None,
        watch: Callable[[GateProgress], None] | None = None,
        tell: Callable[[str], None] = lambda _: None,
    ) -> GateReport:
        """Compare the two versions until the verdict is certain, the pairs or the time are used up, or an interrupt.

        Finished trials in the directory are not run again; without one, a temporary folder is used. ``watch`` is called
        about once a second with the progress, and ``tell`` with each note, such as the beginning of a build.

        Raises:
            UsageError: an agent was trained on all traffic seeds, or an option is out of range.
            CrashhuntError: a hunt cannot be run, or the directory belongs to another gate.
        """
        self._check()
        with ExitStack() as stack:
            place = directory if directory is not None else stack.enter_context(temporary_folder("gate"))
            stack.enter_context(_locked(place))
            run = _Run(self, place, stack, watch, is_kept=directory is not None, tell=tell)
            for caution in self.cautions():
                tell(caution)
            return run.report()

    def cautions(self) -> Iterator[str]:
        """Yield warnings on facts about the two commits that the user may not expect."""
        if self.base.commit and self.base.commit == self.head.commit:
            yield f"BASE and HEAD are the same commit ({self.head.commit[:10]})"
        status = ("--no-optional-locks", "status", "--porcelain", "--untracked-files=no")
        if self.head.commit and git(self.folder, *status, skipped=True):
            yield "the work tree has changes that are not committed; the gate does not compare them"

    def _check(self) -> None:
        if bool(self.base.commit) != bool(self.head.commit):
            kinds = [f"{one.word!r} is {'a commit' if one.commit else 'an agent'}" for one in (self.base, self.head)]
            raise UsageError(" and ".join(kinds), fix="give two commits, or two agents")
        if self.build and not self.base.commit:
            raise UsageError("--build is given, but BASE and HEAD are agents", fix="omit it, or give two commits")
        if self.most < 1:
            raise UsageError(f"--most is {self.most}", fix="give at least 1")
        if self.most < len(self.hunts):
            raise UsageError(
                f"--most is {self.most}, but the gate compares {len(self.hunts)} hunts",
                fix="give at least one pair for each hunt",
            )
        if not 0 <= self.margin < 1:
            raise UsageError(f"--margin is {self.margin:g}", fix="give a share from 0 to below 1, such as 0.01")
        check_confidence(self.confidence)
        slots_of(self.parallel)
        for name, run in self.hunts.items():
            _check_request(run, f"{name}: " if self.is_suite else "")


@contextmanager
def _locked(place: Path) -> Iterator[None]:
    """Create a folder and lock it against other gates; the lock ends with this process.

    Raises:
        HuntDirectoryError: another gate runs there, the folder has other contents, or the folder is not writable.
    """
    try:
        place.mkdir(exist_ok=True)
        if is_hunt(place) or (not (place / GATE).exists() and any(place.iterdir())):
            raise HuntDirectoryError(
                "the folder is not empty, and does not contain the hunts of a gate",
                fix="give --keep a new folder",
                where=str(place),
            )
        with (place / _LOCK).open("a") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                fix = "wait for it, stop it, or give --keep another folder"
                raise BusyError("another gate is running in this folder", fix=fix, where=str(place)) from None
            yield
    except OSError as error:
        fix = "choose one below a folder that exists and is writable"
        raise HuntDirectoryError(f"cannot be used: {error.strerror}", fix=fix, where=str(place)) from error


def _check_request(run: RunRequest, where: str) -> None:
    """Refuse hunts whose trials cannot be paired, or whose end depends on crashes."""
    request = run.request
    options: dict[str, object] = {
        f"the sampler {request.sampler}": request.sampler != "random", "--seeds": request.seeds, "--rare": request.rare,
        "--until-rate": request.until_rate, "--distinct": request.distinct,
        "--only-at-fault": request.only_at_fault,
    }  # fmt: skip
    if given := next((option for option, value in options.items() if value), ""):
        raise UsageError(f"{where}a gate compares single trials and does not support {given}", fix="omit it")


class _Run:
    """One run of a gate in its directory."""

    def __init__(
        self, gate: Gate, place: Path, stack: ExitStack, watch: Callable[[GateProgress], None] | None, *, is_kept: bool,
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:  # fmt: skip
        self._gate, self._place, self._watch, self._is_kept, self._tell = gate, place, watch, is_kept, tell
        self._cautions: tuple[str, ...] | None = None
        self._until = time.monotonic() + gate.duration_s
        self._pairs = PairWatch(gate.margin, 1 - gate.confidence / 100)
        self._preventable = PreventableCrashes(place, slots_of(gate.parallel)) if gate.only_preventable else None
        self._seed = self._begin()
        self._wait_for_hunts()
        self._trees = WorkTrees(gate.folder, self._versions, stack)
        if gate.build:
            self._trees.build(gate.build, place, limit_s=gate.build_limit_s, is_kept=is_kept, tell=tell)
        self._trees.check_origins({module for run in gate.hunts.values() for module in _modules_of(run)})
        self._hunts = list(self._planned())
        self._corpus: tuple[GateCase, ...] | None = None
        self._why = ""
        self._is_interrupted = False

    @property
    def _versions(self) -> dict[str, GateVersion]:
        return {BASE: self._gate.base, HEAD: self._gate.head}

    def report(self) -> GateReport:
        """Run the corpus and the hunts, and return the result."""
        try:
            self._corpus = self._run_corpus()
            if any(case.has_come_back for case in self._corpus or ()):
                self._why = "a crash of the corpus that was fixed has come back"
                return self._gate_report(verdict="worse")
            self._run_hunts()
        except KeyboardInterrupt:
            self._is_interrupted = True
            self._why = "interrupted"
        return self._gate_report()

    # What is compared.

    def _begin(self) -> int:
        """Write the description of the gate, or check that the folder belongs to the same gate; return its seed."""
        gate, file = self._gate, self._place / GATE
        given = next(iter(gate.hunts.values())).request.seed
        asked = {
            side: version.commit or dict(version.agents) for side, version in self._versions.items()
        } | {"hunts": list(gate.hunts)} | ({"build": gate.build} if gate.build else {})  # fmt: skip
        try:
            before = json.loads(file.read_text(encoding="utf-8")) if file.exists() else None
            is_other = before is not None and (
                any(before.get(name) != value for name, value in {"build": None, **asked}.items())
                or given not in (None, before["seed"])
            )
            if is_other:
                raise HuntDirectoryError(
                    "the directory contains a gate with other versions, hunts or seeds, or with another --build",
                    fix="give --keep another directory", where=str(self._place),
                )  # fmt: skip
            seed = before["seed"] if before is not None and given is None else given
            seed = secrets.randbits(32) if seed is None else int(seed)
            with whole_file(file) as temporary:
                temporary.write_text(json.dumps({**asked, "seed": seed, "schema": 1}), encoding="utf-8")
        except OSError as error:
            raise HuntDirectoryError(
                f"cannot be written: {error.strerror}", fix="choose another directory", where=str(file)
            ) from error
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise HuntDirectoryError(f"is damaged: {error}", fix="remove it", where=str(file)) from None
        return seed

    def _planned(self) -> Iterator[PairedHunts]:
        gate = self._gate
        for number, (name, run) in enumerate(gate.hunts.items()):
            most = gate.most // len(gate.hunts) + (number < gate.most % len(gate.hunts))
            folder = self._folder(name)
            counts = self._preventable.counts if self._preventable is not None else None
            paired = PairedHunts(name, folder / BASE, folder / HEAD, most, counts=counts)
            for side, place in zip((BASE, HEAD), paired.folders, strict=True):
                self._plan(place, self._request(run, side, most, number))
            yield paired

    def _wait_for_hunts(self) -> None:
        """Wait until no hunt of an earlier, killed run of this gate runs.

        These hunts run in the work trees of the killed run, which the check-out of new work trees removes. A hunt that
        loses its current folder fails, and its failure would count as one of the new run.
        """
        for name in self._gate.hunts:
            for side in (BASE, HEAD):
                hunt = self._folder(name) / side
                if (hunt / REQUEST).exists():
                    _wait_until_free(hunt)

    def _folder(self, name: str) -> Path:
        """Return the folder that contains both hunts of a name."""
        return self._place / name if self._gate.is_suite else self._place

    def _request(self, run: RunRequest, side: str, most: int, number: int) -> RunRequest:
        """Return the request of the hunt of one version; ``number`` is its position among the hunts."""
        asked = run.request
        kept = 0 if self._gate.only_preventable else _BUNDLES_PER_TYPE  # 0 keeps all: each crash is judged
        seed = asked.seed
        if seed is None and not self._gate.is_suite:
            seed = self._seed
        elif seed is None:  # each hunt of a suite has its own
            seed = int(np.random.SeedSequence(self._seed, spawn_key=(number,)).generate_state(1)[0])
        agents = {**asked.locators, **self._versions[side].agents}
        request = replace(asked, agents=agents, seed=seed, trials=most, keep_going=True, keep=kept, parallel=1)
        folder = self._trees.folder_of(side, Path(run.folder))
        return replace(run, request=request, folder=str(folder))

    def _plan(self, place: Path, request: RunRequest) -> None:
        """Write the request of a hunt, or check that the existing request is the same; its folder may have moved."""
        try:
            if (place / REQUEST).exists():
                before = RunRequest.read(place / REQUEST)
                same = replace(request, folder=before.folder, request=replace(request.request, trials=0))
                if replace(before, request=replace(before.request, trials=0)).to_plain() != same.to_plain():
                    raise HuntDirectoryError(
                        "the gate in this directory was begun with other options",
                        fix="give --keep another directory", where=str(place),
                    )  # fmt: skip
                if not self._gate.trusted:
                    refuse_untrusted_hunt(place)
            place.mkdir(parents=True, exist_ok=True)
            write_request(place, request)
        except OSError as error:
            raise HuntDirectoryError(
                f"cannot be created: {error.strerror}", fix="choose another directory", where=str(place)
            ) from error

    def _find_same_files(self, paired: PairedHunts) -> None:
        """Tell which arguments name one file for both commits, as soon as the settings of both hunts are known."""
        if self._cautions is not None or not all((folder / layout.HUNT).exists() for folder in paired.folders):
            return
        folders = self._trees.folders
        self._cautions = tuple(
            f"BASE and HEAD use the same file: {path} ({name}); name it on the command line by a path relative to the "
            "current folder, as a file that each commit contains or builds"
            for name, values in read_settings(paired.folders[1] / layout.HUNT).texts.items()
            for path in (files_outside(values, folders) if folders else ())
        )
        for caution in self._cautions:
            self._tell(caution)

    def _run_corpus(self) -> tuple[GateCase, ...] | None:
        gate, trees = self._gate, self._trees
        return run_corpus(
            gate.corpus, trees.folder_of(HEAD, gate.folder), gate.head, environment=trees.environment_of(HEAD),
            parallel=slots_of(gate.parallel), trusted=gate.trusted,
        )  # fmt: skip

    def _run_hunts(self) -> None:
        slots = max(_MIN_SLOTS, slots_of(self._gate.parallel))
        for number, paired in enumerate(self._hunts):
            is_last = number == len(self._hunts) - 1
            self._count_pairs(paired, is_last=is_last)
            if not self._is_enough(paired):
                waiting = [folder for folder in paired.folders if not self._is_done(folder, paired.most)]
                environments = {
                    folder: environment
                    for side, folder in zip((BASE, HEAD), paired.folders, strict=True)
                    if (environment := self._trees.environment_of(side)) is not None
                }
                run_all(
                    waiting, slots, watch=lambda: self._count_pairs(paired, is_last=is_last),  # noqa: B023 - called here
                    machine={**(self._gate.machine or {}), "trials": paired.most},
                    is_enough=lambda: self._is_enough(paired), environments=environments,  # noqa: B023
                    partners=dict(zip(paired.folders, reversed(paired.folders), strict=True)),
                )  # fmt: skip
                self._count_pairs(paired, is_last=is_last, has_ended=True)
            if self._refuse_failed(paired) or self._pairs.verdict != "undecided" or time.monotonic() > self._until:
                break
        if self._pairs.verdict == "undecided" and not self._why:
            self._why = self._why_undecided()

    @staticmethod
    def _is_done(folder: Path, most: int) -> bool:
        """Return whether a hunt has run all its trials, and none of them was killed from outside."""
        state = hunt_state(folder)
        if state.state not in ("finished", "crashed") or state.trials_run < most:
            return False
        with closing(Ledger(folder / layout.LEDGER)) as ledger:
            return not ledger.killed_numbers()

    def _count_pairs(self, paired: PairedHunts, *, is_last: bool, has_ended: bool = False) -> None:
        self._find_same_files(paired)
        paired.take(self._pairs, may_end=is_last, has_ended=has_ended)
        if self._watch is not None:
            test = self._pairs.test
            done = sum(one.counts.pairs for one in self._hunts)
            evidence = math.exp(min(test.log_evidence, 700.0))
            self._watch(
                GateProgress(
                    name=paired.name,
                    done=done,
                    most=self._gate.most,
                    only_base=test.only_first,
                    only_head=test.only_second,
                    evidence=evidence,
                )
            )

    def _is_enough(self, paired: PairedHunts) -> bool:
        return (
            self._pairs.verdict != "undecided"
            or paired.is_complete
            or paired.is_hopeless
            or time.monotonic() > self._until
            or paired.cannot_continue
        )

    def _refuse_failed(self, paired: PairedHunts) -> bool:
        """Raise the error of a hunt that could not run; return whether the gate must start no more hunts.

        If HEAD starts in no trial and BASE does, the pairs usually decide before.

        Raises:
            NoValidTrialError: no trial of the hunt was valid.
            HuntDirectoryError: the hunt failed for any other reason.
        """
        if paired.is_hopeless:
            self._why = f"{paired.name}: {paired.why_not}"
            return True
        counts, failure = paired.counts, paired.failure()
        if 0 < counts.pairs == counts.sides[0].not_started:
            failure = BASE, "no_valid_trial", counts.sides[0].example
        elif failure is None or self._pairs.verdict != "undecided":
            return False
        side, state, why = failure
        where = f"{side.upper()} ({self._versions[side]})"
        needs = "if the agent needs files that Git does not track, give --build COMMAND"
        fix = needs if self._trees.folders and not self._gate.build else ""
        if state == "no_valid_trial":
            raise NoValidTrialError(f"no trial can be set up: {why}", fix=fix, where=where)
        raise HuntDirectoryError(f"the hunt cannot run: {why}", fix=fix, where=where)

    def _why_undecided(self) -> str:
        invalid = next((f"{one.name}: {one.why_not}" for one in self._hunts if one.why_not), "")
        if invalid:
            return invalid
        if time.monotonic() > self._until:
            return "the time is up; give --for more, or --most fewer pairs with a greater --margin"
        if ended := next((said for one in self._hunts if not one.is_complete and (said := _ended_early(one))), ""):
            return ended
        if not self._pairs.test.pairs and (trained_on := sum(one.trained_on for one in self._hunts)):
            raise UsageError(
                f"an agent was trained on all {trained_on} traffics of this gate",
                fix="give another --seed, or train with a test share",
            )
        lost = sum(side.lost for one in self._hunts for side in one.counts.sides)
        without = f", of which {lost} have no result; find out why" if lost else ""
        return f"all {self._gate.most} pairs have ended{without}; give more with --most, or a greater --margin"

    # What came of it.

    def _gate_report(self, *, verdict: PairVerdict | None = None) -> GateReport:
        gate, test = self._gate, self._pairs.test
        found: PairVerdict = verdict or self._pairs.verdict
        why = self._why
        unable = [case.name for case in self._corpus or () if case.got == "cannot_run"]
        if unable and found in ("better", "no_difference"):
            found, why = "undecided", f"HEAD cannot run {len(unable)} of the corpus: {', '.join(unable[:3])}"
        alpha = 1 - gate.confidence / 100
        is_valid = not any(one.why_not for one in self._hunts)
        report = GateReport(
            verdict=found,
            base=str(gate.base),
            head=str(gate.head),
            pairs=test.pairs,
            only_base=test.only_first,
            only_head=test.only_second,
            both=test.both,
            evidence=math.exp(min(test.log_evidence, 700.0)),
            difference=test.difference(alpha) if is_valid else None,
            margin=gate.margin,
            confidence=gate.confidence,
            seed=self._seed,
            scenarios=tuple(replace(one.counts, types=one.crash_types()) for one in self._hunts),
            rates=self._rates(),
            corpus=self._corpus,
            why=why,
            is_interrupted=self._is_interrupted,
            dir=str(self._place) if self._is_kept else "",
            trained_on=sum(one.trained_on for one in self._hunts),
            cautions=self._cautions or (),
            preventable=None if self._preventable is None else self._preventable.numbers,
        )
        self._write(report)
        return report

    def _rates(self) -> tuple[CrashRate, CrashRate] | None:
        """Return the rates of the only two hunts; None if there are several pairs, or if a hunt has not begun.

        If only preventable crashes count, there are no rates, because the rate of a hunt counts all its crashes.
        """
        (paired, *others) = self._hunts
        if (
            self._preventable is not None
            or others
            or not all((folder / layout.HUNT).exists() for folder in paired.folders)
            or not paired.counts.pairs
        ):
            return None
        held_out = held_out_traffics(read_settings(paired.folders[0] / layout.HUNT), paired.folders)
        base, head = (
            measure_rates(folder, per="trial", confidence=self._gate.confidence, held_out=held_out)[0]
            for folder in paired.folders
        )
        return base, head

    def _write(self, report: GateReport) -> None:
        """Add the report to the description of the gate."""
        file = self._place / GATE
        known = json.loads(file.read_text(encoding="utf-8"))
        with whole_file(file) as temporary:
            temporary.write_text(json.dumps({**known, "report": report.to_json()}), encoding="utf-8")


def _wait_until_free(hunt: Path) -> None:
    """Wait for the process of a hunt whose gate was killed. The process stops on its own, and saves finished trials.

    Raises:
        BusyError: the process still runs after some seconds.
    """
    deadline = time.monotonic() + _BUSY_S
    while True:
        try:
            with HuntDirectory(hunt).locked():
                return
        except BusyError:
            if time.monotonic() > deadline:
                raise
            time.sleep(_LOOK_EVERY_S)


def _ended_early(paired: PairedHunts) -> str:
    """Return which hunt ended before its last trial, and the last line of its output; empty if both are complete."""
    for side, folder in zip((BASE, HEAD), paired.folders, strict=True):
        state = hunt_state(folder).state
        if state not in ("finished", "crashed"):
            log = folder / layout.RUN_LOG
            lines = log.read_text(encoding="utf-8", errors="replace").split("\n") if log.exists() else []
            last = next((line.strip() for line in reversed(lines) if line.strip()), "no output")
            return f"the hunt of {side.upper()} ended early ({state}): {last}"
    return ""


def _modules_of(run: RunRequest) -> set[str]:
    """Return the modules of the agents that drive in a hunt, except crashhunt's own modules."""
    agents = run.request.locators
    if not agents:
        try:
            agents = {agent: setup.agent for agent, setup in load_scenario(run.request.scenario).agents.items()}
        except CrashhuntError:
            return set()  # the hunt reports it
    points = registered("agents")
    targets = [points[name].value if name in points else name for name in agents.values()]
    return {target.partition(":")[0] for target in targets if not is_program(target)}
