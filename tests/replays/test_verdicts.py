"""Which verdict a replay has, from how it ended and where it first differs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest

from crashhunt.base.errors import CrashhuntError, UntrustedError, UsageError
from crashhunt.recording import AgentChannel, Divergence, Prologue, Tag
from crashhunt.replays import Look, ReplayOptions, ReplayReport, _debugger, _replaying as _replay
from crashhunt.trial import KILLED, Collision, Failure, Outcome, TrialResult, TrialSpec
from crashhunt.trial_reruns import EndedRun, StoppedError

EGO = AgentChannel("ego", "float32", (8, 7), "float64", (2,))
PROLOGUE = Prologue((EGO,), 0.1)
HIT = Collision("ego", "collider", "ego", "x", ("overlap",), "overlap", 1.0, 2.0)
CRASH = TrialResult(TrialSpec(4, 1, {}, {}, 90), Outcome.COLLISION, steps=30, collision=HIT)
FINE = replace(CRASH, outcome=Outcome.SURVIVED, steps=90, collision=None)
THERE = Divergence(step=5, agent="", field="x", recorded=1, replayed=2)


@pytest.fixture
def judge(monkeypatch):
    monkeypatch.setattr(_replay, "load_order_change", lambda scenario, recorded: "")
    monkeypatch.setattr(_replay, "environment_changes", lambda environment: {"numpy": ("1", "2")})

    def judge(result, divergence=THERE, *, whole=True, now=PROLOGUE, versions=(), near_miss=False, **given):
        backend = SimpleNamespace(versions=versions)
        rerun = SimpleNamespace(**{
            "recorded": SimpleNamespace(prologue=PROLOGUE), "code": "snapshot", "edits": (), "other_traffic": (),
            "snapshot": SimpleNamespace(environment={}), "bundle": SimpleNamespace(is_near_miss=near_miss),
            "worker": SimpleNamespace(crash_on=("collision",), scenario=SimpleNamespace(backend=backend)), **given,
        })  # fmt: skip
        return _replay._judge(rerun, SimpleNamespace(prologue=now), result, divergence, whole=whole)

    return judge


def test_without_a_difference_it_is_reproduced(judge):
    assert judge(CRASH, None) == ("reproduced", "")
    assert judge(FINE, None, code="current") == ("reproduced", "")


def test_the_code_of_the_hunt_diverges_and_other_code_is_fixed_or_changed(judge):
    assert judge(CRASH) == judge(FINE) == ("diverged", "")
    for given in ({"code": "current"}, {"edits": ("speed",)}):
        assert judge(CRASH, **given) == ("changed", "")
        assert judge(FINE, **given) == ("fixed", "")
        assert judge(FINE, whole=False, **given) == ("diverged", "")  # it may crash later
        assert judge(FINE, near_miss=True, **given) == ("diverged", "")
        verdict, why = judge(FINE, other_traffic=("the seed is 5",), **given)
        assert verdict == "not_comparable"
        assert why.startswith("no crash, but the seed is 5, ")


def test_another_simulator_cannot_be_compared(judge, monkeypatch):
    assert judge(FINE, code="current", versions=("libsumo",)) == ("fixed", "")  # of which numpy is no part
    assert judge(FINE, versions=("numpy",)) == ("not_comparable", "the simulator differs: numpy was 1 and is 2")
    monkeypatch.setattr(_replay, "load_order_change", lambda scenario, recorded: "another order")
    assert judge(FINE) == ("not_comparable", "the simulator differs: another order")


@pytest.mark.parametrize(
    ("now", "says"),
    [
        (Prologue((EGO,), 0.5), "the step length was 0.1 s and is 0.5 s"),
        (Prologue((EGO, EGO), 0.1), "the agents were ego and are ego, ego"),
        (
            Prologue((AgentChannel("ego", "float32", (5, 5), "int64", ()),), 0.1),
            "ego's channel was (8, 7) float32 → (2,) float64 and is (5, 5) float32 → () int64",
        ),
    ],
)
def test_other_channels_cannot_be_compared(judge, now, says):
    assert judge(CRASH, now=now) == ("not_comparable", f"what is recorded is another: {says}")


def test_equal_recordings_may_end_differently():
    def ends(now, code="snapshot", was=CRASH):
        found = _replay._end_divergence(was, now, code)
        assert found is None or (found.step, found.agent) == (now.steps, "ego" if "." in found.field else "")
        return found and (found.field, found.recorded, found.replayed)

    assert ends(CRASH) is None
    assert ends(FINE) == ("outcome", "collision", "survived")
    assert ends(replace(CRASH, steps=31)) == ("steps", 30, 31)
    other = replace(CRASH, collision=replace(HIT, victim="y"))
    assert ends(other) == ends(other, "current") == ("collision.victim", "x", "y")
    words = replace(CRASH, collision=replace(HIT, x=1.5))
    assert ends(words) == ("collision.x", 1.0, 1.5)
    assert ends(words, "current") is None  # another version may describe it otherwise
    assert ends(FINE, "log", was=replace(CRASH, outcome=Outcome.HANG, collision=None)) is None


def test_elsewhere_a_crash_is_another_one_and_none_is_no_fix():
    rerun = SimpleNamespace(elsewhere=True, worker=SimpleNamespace(crash_on=("collision",)), other_traffic=("the map",))
    there = _replay.judged(rerun, None, None, CRASH)
    assert (there.verdict, there.replayed) == ("changed", CRASH)
    fine = _replay.judged(rerun, None, None, FINE)
    assert fine.verdict == "not_comparable"
    assert fine.reason.startswith("no crash, but the map, ")


def test_a_replay_that_cannot_be_set_up_is_an_error_with_the_reason(monkeypatch):
    failure = Failure("invalid", "the agent needs a map")
    result = replace(FINE, outcome=Outcome.INVALID, steps=0, failure=failure)
    monkeypatch.setattr(_debugger, "debug", lambda rerun, look: (result, None))
    with pytest.raises(CrashhuntError, match="as far as the first step: the agent needs a map") as caught:
        _replay._look_into(SimpleNamespace(bundle=SimpleNamespace(id="000004-collision")), Look(until=3))
    assert caught.value.where == "000004-collision"


def report(verdict, result=CRASH, divergence=None):
    rerun = SimpleNamespace(
        code_differences=None,
        bundle=BUNDLE,
        code="snapshot",
        edits=("speed was 5",),
        warnings=("numpy",),
        recorded=SimpleNamespace(steps=30),
        snapshot=SimpleNamespace(environment={}),
    )
    recording = SimpleNamespace(steps=29)
    return ReplayReport(rerun=rerun, verdict=verdict, replayed=result, recording=recording, divergence=divergence)


@dataclass(frozen=True)
class Bundle:
    """In place of the bundle of a crash."""

    id: str = "000004-collision"
    result: TrialResult = CRASH
    confirmed: bool | None = None
    divergence: object = None
    why_unconfirmed: str = "it was stopped"


BUNDLE = Bundle()


@pytest.fixture
def replays(monkeypatch):
    """Each replay ends as the next of `ends`; `options` and `runs` are what it was asked for."""
    found = SimpleNamespace(ends=[], options=[], runs=[])

    def prepare(bundle, options):
        found.options.append(options)
        return Prepared()

    def run(rerun, stopped=lambda: False, executors=None):
        found.runs.append((rerun.worker.find_escapes, stopped, executors))
        end = found.ends.pop(0)
        if isinstance(end, Exception):
            raise end
        return end

    monkeypatch.setattr(_replay, "prepare", prepare)
    monkeypatch.setattr(_replay, "_run", run)
    return found


@dataclass(frozen=True)
class Worker:
    find_escapes: bool = False
    scratch: object = None


@dataclass(frozen=True)
class Prepared:
    worker: Worker = Worker()


def test_of_several_replays_the_first_that_deviates_is_shown(replays):
    replays.ends = [report("reproduced"), report("diverged"), report("fixed"), report("reproduced")]
    shown = _replay.replay(BUNDLE, ReplayOptions(times=4))
    assert shown.verdict == "diverged"
    assert shown.verdicts == {"reproduced": 2, "diverged": 1, "fixed": 1}
    replays.ends = [report("fixed")]
    assert (shown.agreed, _replay.replay(BUNDLE).agreed) == (2, 0)
    replays.ends = [report("reproduced")]
    written = _replay.replay(BUNDLE).to_json()
    assert [run[0] for run in replays.runs] == [False] * 6
    assert replays.options[-1] == ReplayOptions()
    assert written == {
        "crash": "000004-collision", "verdict": "reproduced", "code": "snapshot", "steps_recorded": 30,
        "steps_replayed": 29, "digest_recorded": CRASH.digest, "digest_replayed": CRASH.digest, "divergence": None,
        "outcome_recorded": "collision", "outcome_replayed": "collision", "reason": "", "edits": ["speed was 5"],
        "code_differences": None, "warnings": ["numpy"], "times": 1, "agreed": 1, "verdicts": {"reproduced": 1},
    }  # fmt: skip
    with pytest.raises(UsageError, match="--times is 0"):
        _replay.replay(BUNDLE, ReplayOptions(times=0))


def test_stopped_replays_are_those_that_finished(replays):
    stop = lambda: False  # noqa: E731
    replays.ends = [report("reproduced"), report("diverged"), StoppedError(), report("reproduced")]
    shown = _replay.replay(BUNDLE, ReplayOptions(times=4), stop)
    assert (shown.verdict, shown.times) == ("diverged", 2)
    assert [run[1] for run in replays.runs] == [stop] * 3
    replays.ends = [StoppedError()]
    with pytest.raises(StoppedError):
        _replay.replay(BUNDLE, ReplayOptions(times=4), stop)


def test_confirmation_keeps_what_the_replay_shows(replays):
    braked = replace(CRASH, escape=12, why_no_escape="the search was killed")
    stopped, executors, failed = (lambda: False), object(), []
    replays.ends = [report("reproduced", braked)]
    found = _replay.confirm(BUNDLE, stopped, failed=failed, executors=executors, trusted=True)
    assert found == Bundle(result=braked, confirmed=True, why_unconfirmed="")
    assert replays.runs == [(True, stopped, executors)]
    assert replays.options == [ReplayOptions(force=True, trusted=True)]
    replays.ends = [report("diverged", braked, THERE)] * 2
    found = _replay.confirm(BUNDLE, failed=failed)
    assert found == Bundle(confirmed=False, divergence=THERE.to_json(), why_unconfirmed="")
    assert failed == [braked]
    assert _replay.confirm(BUNDLE) == found
    replays.ends = [_replay._NotSetUpError("no map")]
    found = _replay.confirm(BUNDLE, failed=failed)
    divergence = {"step": 0, "agent": "", "field": "replay", "recorded": None, "replayed": "no map"}
    assert found == Bundle(confirmed=False, divergence=divergence, why_unconfirmed="")
    replays.ends = [CrashhuntError("it was killed")]
    found = _replay.confirm(replace(BUNDLE, confirmed=True, divergence=THERE))
    assert found == Bundle(confirmed=None, divergence=None, why_unconfirmed="it was killed")
    hang = replace(CRASH, outcome=Outcome.HANG, failure=Failure("timeout", "still running after 60 s"))
    too_early = [replace(THERE, field=field) for field in ("outcome", "length", "x")]
    replays.ends = [report("diverged", hang, end) for end in too_early]
    late = Bundle(confirmed=None, why_unconfirmed="the replay was still running after 60 s")
    assert [_replay.confirm(BUNDLE) for _ in range(2)] == [late] * 2
    assert _replay.confirm(BUNDLE).confirmed is False
    replays.ends = [report("diverged", hang, replace(THERE, field="length"))]
    assert _replay.confirm(replace(BUNDLE, result=hang)).confirmed is False  # it hangs elsewhere
    replays.ends = [StoppedError()]
    assert _replay.confirm(BUNDLE) is None
    replays.ends = [UntrustedError("it is not yours")]
    with pytest.raises(UntrustedError):
        _replay.confirm(BUNDLE)
    assert failed == [braked]


class Recorded(SimpleNamespace):
    """In place of a recording: one number for each record."""

    def beginning(self, count):
        return Recorded(records=self.records[:count])


def records(*steps):
    """Records of a prologue, of steps that are complete, and of one that is not."""
    found = [SimpleNamespace(tag=Tag.PROLOGUE, number=-1)]
    for number in steps:
        found += [SimpleNamespace(tag=Tag.ACTION, number=number), SimpleNamespace(tag=Tag.STEP, number=number)]
    return Recorded(records=[*found, SimpleNamespace(tag=Tag.ACTION, number=99)], steps=len(steps) - 1)


def test_beginning_of_a_recording_ends_with_a_whole_step():
    recording = records(0, 1, 2)
    ends = [_replay.up_to(recording, step).records[-1] for step in range(4)]
    assert [(end.tag, end.number) for end in ends] == [
        (Tag.STEP, 0), (Tag.STEP, 1), (Tag.STEP, 2), (Tag.ACTION, 99),
    ]  # fmt: skip


@pytest.mark.parametrize("code", ["snapshot", "log"])
@pytest.mark.parametrize("shared", [True, False])
def test_run_of_a_replay_is_compared_with_its_recording(monkeypatch, tmp_path, code, shared):
    ends = {"result": CRASH, "recording": records(0, 1)}
    stopped, worker = (lambda: False), Worker()

    def run(given, spec, asked):
        assert (given, spec, asked) == (worker, CRASH.spec, stopped)
        if ends["result"] is None:
            raise StoppedError
        ended = EndedRun(0, ends["result"], ends["recording"], tmp_path)
        return ended if shared else iter([ended])

    monkeypatch.setattr(_replay, "run_alone", run)
    monkeypatch.setattr(_replay, "judged", lambda *compared: compared)
    rerun = SimpleNamespace(worker=worker, spec=CRASH.spec, code=code, bundle=BUNDLE, recorded=records(0, 1))
    executors = SimpleNamespace(run=run) if shared else None
    first, recorded, replayed, result = _replay._run(rerun, stopped, executors)
    assert (first, result) == (rerun, CRASH)
    last = 99 if code == "snapshot" else 1
    assert [found.records[-1].number for found in (recorded, replayed)] == [last, last]

    def fails(result, says, recording=ends["recording"]):
        ends.update(result=result, recording=recording)
        with pytest.raises(CrashhuntError, match=says) as caught:
            _replay._run(rerun, stopped, executors)
        assert caught.value.where == BUNDLE.id
        return type(caught.value)

    killed = replace(FINE, outcome=Outcome.INVALID, failure=Failure(KILLED, "killed 3 times", exit_code=-9))
    assert fails(killed, "collision: the replay was killed 3 times") is CrashhuntError
    invalid = replace(FINE, outcome=Outcome.INVALID, steps=0, failure=Failure("invalid", "the agent needs a map"))
    assert fails(invalid, "as far as the first step: the agent needs a map") is _replay._NotSetUpError
    assert fails(CRASH, "it left no recording", None) is _replay._NotSetUpError
    ends.update(result=None)
    with pytest.raises(StoppedError):
        _replay._run(rerun, stopped, executors)
