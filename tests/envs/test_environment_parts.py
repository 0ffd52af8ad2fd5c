"""The parts of the Gymnasium environment, with simple objects in place of SUMO, processes and forks."""

from __future__ import annotations

import copy
import gc
import math
import os
import pickle
import re
import signal
import sys
from multiprocessing.connection import Pipe
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

from crashhunt.agents import KeepLaneWithSpeed
from crashhunt.base.extras import install_command
from crashhunt.base.forks import CannotForkError
from crashhunt.envs import SumoEnv, _env_episodes as _episodes, _process, _sumo_env
from crashhunt.envs._env_episodes import Episodes, _Trail
from crashhunt.envs._process import RemoteEpisodes
from crashhunt.errors import ArgumentError, SimulatorError, UsageError
from crashhunt.trial import Argument, Outcome


def scene(step=0, **more):
    given = {"time_s": 0.5 * step, "events": (), "roster": SimpleNamespace(actors=["ego", "other", "x"])}
    return SimpleNamespace(**{**given, **more})


def disturbance(words, vehicle="x"):
    return SimpleNamespace(words=words, vehicle=vehicle)


class Episode:
    """An episode that is told what its next step is."""

    made: list = []  # noqa: RUF012

    def __init__(self, spec, *, simulator, make_agent, observers):
        vars(self).update(spec=spec, simulator=simulator, make_agent=make_agent, trail=observers[0])
        self.observers, self.closed, self.steps, self.error, self.result = observers, 0, 0, None, None
        self.observations, self.rewards = {"ego": "seen", "other": "far"}, {"ego": 0.0, "other": 9.0}
        self.terminations = {"ego": False, "other": True}
        self.actions, self.seeds, self.next = [], [], {}
        Episode.made.append(self)

    def start(self):
        self.trail.begin(self)
        for words in Episode.begins_with:
            self.trail.disturbance(disturbance(words))
        self.trail.scene(0, scene(), ())
        self.error = Episode.fails

    def step(self, actions):
        self.actions.append(actions)
        self.steps += 1
        given = {"scene": {}, "disturbs": [], **self.next}
        for one in given["disturbs"]:
            self.trail.disturbance(one)
        self.trail.scene(self.steps, scene(self.steps, **given["scene"]), ())
        self.observations, self.rewards["ego"] = {"ego": f"seen {self.steps}"}, 2.0 * self.steps
        self.error = given.get("error")

    def reseed(self, seed):
        self.seeds.append(seed)

    def close(self):
        self.closed += 1


class Oracle:
    finding = None

    def check(self, seen, agents):
        assert agents == ("ego",)
        return [self.finding] if self.finding is not None else []


@pytest.fixture
def parts(monkeypatch, tmp_path):
    """What episodes are made of; each note says with what."""
    notes = SimpleNamespace(loaded=[], actions=[], disturbers=[], drawn=[], simulator_closed=0, oracle=Oracle())
    form = SimpleNamespace(encode=lambda action: f"encoded {action}", space="actions")
    other = SimpleNamespace(encode=None, space=gymnasium.spaces.Discrete(5))
    chosen = SimpleNamespace(
        agents={"ego": 1, "other": 2},
        scenario_arguments=lambda: {"cars": Argument("cars", "int"), "speed": Argument("speed", "float")},
    )
    notes.simulator = SimpleNamespace(
        actions={"ego": form, "other": other}, observation_spaces={"ego": "observations", "other": "others"},
        observation_layouts={}, step_length_s=0.5, agents=["ego", "other"], why_no_reseeding="", lanes=lambda: "lanes",
        close=lambda: setattr(notes, "simulator_closed", notes.simulator_closed + 1),
    )  # fmt: skip
    sampler = SimpleNamespace(draw=lambda seed, steps: notes.drawn.append((seed, steps)) or ("drawn",))
    monkeypatch.setattr(Episode, "made", [])
    monkeypatch.setattr(Episode, "begins_with", (), raising=False)
    monkeypatch.setattr(Episode, "fails", None, raising=False)
    replaced = {
        "load_scenario": lambda name: notes.loaded.append(name) or chosen,
        "with_action": lambda *given: notes.actions.append(given[1:]) or chosen,
        "with_whole_vehicles_visible": lambda scenario: scenario,
        "argument_values": lambda scenario: {"cars": 3, "speed": 1.0},
        "disturber": lambda scenario, disturb, agents: (
            notes.disturbers.append((disturb, agents)) or (sampler if disturb else None)
        ),
        "SumoSimulator": lambda scenario, folder: notes.simulator,
        "Episode": Episode, "ReportedCollision": lambda: notes.oracle, "Overlap": Oracle, "OffRoad": Oracle,
        "merge_findings": lambda findings: findings[0] if findings else None,
    }  # fmt: skip
    for name, value in replaced.items():
        monkeypatch.setattr(_episodes, name, value)
    stages, folder = [], _episodes.TemporaryFolder
    monkeypatch.setattr(_episodes, "TemporaryFolder", lambda name: stages.append(folder(name)) or stages[-1])
    yield notes
    for stage in stages:
        stage.remove()


def test_episodes_are_those_of_the_first_agent_unless_one_is_named(parts):
    made = Episodes("toy", "", "")
    assert (made.agent, made.observation_space, made.action_space, made.step_length_s) == (
        "ego", "observations", "actions", 0.5
    )  # fmt: skip
    other = Episodes("toy", "other", "meta")
    assert (other.agent, other.observation_space, parts.actions) == ("other", "others", [("other", "meta")])
    assert parts.disturbers == [((), ("ego",)), ((), ("other",))]
    assert made._trail.scenes.maxlen == 9  # 4 s, and the present scene
    with pytest.raises(UsageError, match="there is no controlled vehicle 'egon'; did you mean 'ego'"):
        Episodes("toy", "egon", "")
    Episodes("toy", "", "", ("brake=1",), 1)
    with pytest.raises(UsageError, match="disturb needs a limit on the length of an episode; give max_steps"):
        Episodes("toy", "", "", ("brake=1",), 0)


def test_reset_begins_an_episode_of_its_seed_and_arguments_and_closes_the_one_before(parts):
    made = Episodes("toy", "", "", ("brake=1",), 30)
    assert made.reset(7, {"cars": 5}) == ("seen", {"sim_time_s": 0.0})
    (episode,) = Episode.made
    spec = episode.spec
    assert (spec.number, spec.seed, spec.arguments, spec.max_steps) == (0, 7, {}, sys.maxsize)
    assert (spec.scenario_arguments, spec.disturbances) == ({"cars": 5, "speed": 1.0}, ("drawn",))
    assert (parts.drawn, episode.simulator, episode.observers) == ([(7, 30)], parts.simulator, (made._trail,))
    with pytest.raises(ArgumentError, match="options: the scenario has no argument 'car'"):
        made.reset(8, {"car": 5})
    assert (len(Episode.made), episode.closed) == (1, 0)
    Episode.begins_with = ("a", "b")
    assert made.reset(8, {})[1] == {"sim_time_s": 0.0, "disturbances": ["a", "b"]}
    assert [one.closed for one in Episode.made] == [1, 0]
    spec = Episode.made[1].spec
    assert (spec.seed, spec.scenario_arguments) == (8, {"cars": 3, "speed": 1.0})
    Episode.fails = SimulatorError("no road")
    with pytest.raises(SimulatorError, match="no road"):
        made.reset(9, {})
    plain = Episodes("toy", "", "")
    Episode.fails = None
    plain.reset(1, {})
    assert Episode.made[-1].spec.disturbances == ()
    agent = Episode.made[-1].make_agent("other", parts.simulator, {})
    assert isinstance(agent, KeepLaneWithSpeed)
    assert vars(agent) == vars(KeepLaneWithSpeed(10.0, parts.simulator.actions["other"].space))


def test_step_reports_what_is_new_in_it(parts):
    made = Episodes("toy", "", "")
    with pytest.raises(SimulatorError, match="no episode has begun; call reset"):
        made.step(1)
    Episode.begins_with = ("first",)
    made.reset(1, {})
    (episode,) = Episode.made
    assert made.step(3) == ("seen 1", 2.0, False, {"sim_time_s": 0.5})
    assert episode.actions == [{"ego": "encoded 3"}]
    episode.next = {"disturbs": [disturbance("new"), disturbance("of nobody", "")],
                    "scene": {"events": [SimpleNamespace(kind="red light", what="ran it")]}}  # fmt: skip
    assert made.step(3)[3] == {"sim_time_s": 1.0, "events": ["red light: ran it"], "disturbances": ["new"]}
    episode.next = {}
    episode.terminations["ego"] = True
    assert made.step(3)[2:] == (True, {"sim_time_s": 1.5, "outcome": "finished"})
    assert made._crash_step == -1
    episode.terminations["ego"] = False
    parts.oracle.finding = SimpleNamespace(outcome=Outcome.COLLISION)
    assert made.step(3)[2:] == (True, {"sim_time_s": 2.0, "outcome": "collision"})
    assert made._crash_step == 4
    parts.oracle.finding = None
    made.reset(1, {})
    assert made._crash_step == -1


@pytest.mark.parametrize("why", ["result", "agents"])
def test_episode_that_has_ended_takes_no_step_and_has_no_copies(parts, why):
    made = Episodes("toy", "", "")
    with pytest.raises(SimulatorError, match="no episode is running, so there is nothing to branch"):
        made.require_branch(reseeded=False)
    made.reset(1, {})
    (episode,) = Episode.made
    made.require_branch(reseeded=True)
    made.reseed(5)
    assert episode.seeds == [5]
    if why == "result":
        episode.result = "crashed"
    else:
        parts.simulator.agents = ["other"]
    with pytest.raises(SimulatorError, match="the episode has ended; call reset"):
        made.step(1)
    with pytest.raises(SimulatorError, match="no episode is running"):
        made.require_branch(reseeded=False)
    assert episode.steps == 0


def test_copies_need_a_simulator_that_can_be_reseeded_where_they_are_and_no_error(parts):
    made = Episodes("toy", "", "")
    made.reset(1, {})
    parts.simulator.why_no_reseeding = "it is another version"
    made.require_branch(reseeded=False)
    with pytest.raises(UsageError, match="branch cannot re-seed: it is another version; omit seed"):
        made.require_branch(reseeded=True)
    Episode.made[0].next = {"error": SimulatorError("SUMO has ended")}
    for use in (lambda: made.step(1), lambda: made.step(1), lambda: made.require_branch(reseeded=False)):
        with pytest.raises(SimulatorError, match="SUMO has ended"):
            use()
    assert Episode.made[0].steps == 1


def test_picture_shows_the_last_scenes_around_the_agent(parts, monkeypatch):
    drawn, borders = [], []

    class View:
        def __init__(self, seen, lanes, **options):
            drawn.append((seen, lanes, options))

        def draw(self, step):
            return step

    monkeypatch.setattr("crashhunt.render.SceneView", View)
    monkeypatch.setattr("crashhunt.recording.lane_borders", lambda lanes: borders.append(lanes) or "borders")
    made = Episodes("toy", "other", "")
    made._trail.scenes.append(scene())
    assert made.picture() == 0
    made.reset(1, {})
    (episode,) = Episode.made
    parts.oracle.check = lambda *_: []
    for oracle in made._oracles:
        oracle.check = lambda *_: []
    for _ in range(11):
        episode.step({})
    assert made.picture() == 11
    seen, lanes, options = drawn[-1]
    assert lanes == "borders"
    assert options == {"agent": "other", "width": 960, "height": 540, "crash_step": -1}
    assert (seen.agents, seen.actors, seen.prologue.step_length_s) == (("other", "ego"), ["ego", "other", "x"], 0.5)
    assert [seen.scene(step).time_s / 0.5 for step in (11, 4, 3, 2, 0)] == [11, 4, 3, 3, 3]  # nine are kept
    assert seen.disturbances == ()
    made.picture()
    assert borders == ["lanes", "lanes"]  # once for each episode
    made._crash_step = 11
    made.picture()
    assert drawn[-1][2]["crash_step"] == 11


def test_close_ends_the_episode_the_simulator_and_the_files(parts):
    made = Episodes("toy", "", "")
    folder = Path(made._stage.path)
    assert folder.is_dir()
    made.reset(1, {})
    made.close()
    assert (Episode.made[0].closed, parts.simulator_closed, folder.exists()) == (1, 1, False)
    Episodes("toy", "", "").close()
    assert parts.simulator_closed == 2


def test_trail_has_the_scenes_of_one_episode():
    trail = _Trail(3)
    for step in range(5):
        trail.scene(step, step, ())
    assert [*trail.scenes] == [2, 3, 4]
    trail.disturbance(disturbance("a"))
    trail.disturbance(disturbance("b", ""))
    assert [one.words for one in trail.disturbances] == ["a"]
    kept = trail.disturbances
    trail.begin(None)
    trail.scene(0, 7, ())
    assert ([*trail.scenes], kept) == ([7], [])


# The process of the episodes.


def test_process_is_started_apart_from_the_users_terminal_and_with_its_modules(monkeypatch):
    started, ends = [], []

    class Popen:
        pid = 55

        def __init__(self, words, **options):
            started.append((words, options, os.fstat(options["pass_fds"][0]).st_ino))

    monkeypatch.setattr(_process, "subprocess", SimpleNamespace(Popen=Popen, DEVNULL=-3))
    monkeypatch.setattr(_process, "worker_environment", lambda: {"OMP_NUM_THREADS": "1"})
    monkeypatch.setattr(_process, "_end", lambda *given: ends.append(given))
    monkeypatch.setattr(sys, "path", ["", "/one", "/two"])
    monkeypatch.setenv("MINE", "yes")
    answer = {"observation_space": 1, "action_space": 2, "step_length_s": 3.0, "agent": "ego"}
    monkeypatch.setattr(RemoteEpisodes, "_ask", lambda self, *given: ends.append(given) or answer)
    made = RemoteEpisodes("toy", "a")
    ((words, options, there),) = started
    assert words[:4] == [sys.executable, "-P", "-m", "crashhunt.envs._process"]
    assert words[4:] == [str(options["pass_fds"][0]), str(os.getpid())]
    assert (options["stdin"], options["start_new_session"]) == (-3, True)
    environment = options["env"]
    assert environment["PYTHONPATH"] == f"/one{os.pathsep}/two"
    assert (environment["OMP_NUM_THREADS"], environment["MINE"]) == ("1", "yes")
    assert there != os.fstat(made._pipe.fileno()).st_ino
    assert ends == [("made", "crashhunt.envs._env_episodes:Episodes", "toy", "a")]
    assert (made.observation_space, made.action_space, made.step_length_s, made.agent) == (1, 2, 3.0, "ego")
    assert (made.pid, made._name) == (55, "the environment")
    process, pipe = made._process, made._pipe
    del made
    gc.collect()
    assert ends[1:] == [(process, pipe, os.getpid())]
    pipe.close()


@pytest.mark.parametrize("problem", ["", "no memory", "interrupted"])
def test_copy_has_its_own_connection_and_is_asked_whether_it_serves(monkeypatch, problem):
    """Where it cannot be made, neither end of its connection stays open."""
    made, asked, pipes = object.__new__(RemoteEpisodes), [], []

    def ask(self, name, *words, passes=-1):
        asked.append((self is made, name, words, passes >= 0))
        if problem == "interrupted":
            raise KeyboardInterrupt
        return (66, problem)

    def pipe():
        pipes.append(Pipe())
        return pipes[0]

    monkeypatch.setattr(RemoteEpisodes, "_ask", ask)
    monkeypatch.setattr(_process, "Pipe", pipe)
    monkeypatch.setattr(_process, "_Fork", lambda pid: f"fork {pid}")
    monkeypatch.setattr(_process, "_end", lambda *given: asked.append(given))
    made.agent, made._name = "ego", "the environment"
    if problem:
        with pytest.raises((SimulatorError, KeyboardInterrupt)) as caught:
            made._branch("copy 1", 5)
        assert "the environment cannot be copied: no memory" in str(caught.value) or problem == "interrupted"
        assert [end.closed for end in pipes[0]] == [True, True]
        return
    copy = made._branch("copy 1", 5)
    assert asked == [(True, "branch", (5, os.getpid()), True), (False, "agent_name", (), False)]
    assert [end.closed for end in pipes[0]] == [False, True]
    assert (copy.agent, copy.pid, copy._name, copy._process) == ("ego", 66, "copy 1 (process 66)", "fork 66")
    assert copy._pipe is pipes[0][0]
    copy._end()
    assert asked[2:] == [("fork 66", pipes[0][0], os.getpid())]
    pipes[0][0].close()


def test_process_serves_until_its_parent_is_another(monkeypatch):
    served, closed, signals, parents = [], [], [], iter([7, 1])

    def serve(pipe, is_orphan, episodes):
        served.append((pipe, is_orphan(), is_orphan(), episodes))
        return SimpleNamespace(close=lambda: closed.append(1)) if len(served) == 1 else None

    monkeypatch.setattr(_process, "_serve", serve)
    monkeypatch.setattr(_process, "Connection", lambda number: f"connection {number}")
    monkeypatch.setattr(_process, "os", SimpleNamespace(getppid=lambda: next(parents)))
    monkeypatch.setattr(_process.signal, "signal", lambda *given: signals.append(given))
    monkeypatch.setattr(sys, "argv", ["_process", "3", "7"])
    _process.main()
    assert served == [("connection 3", False, True, None)]
    assert (closed, signals) == ([1], [(signal.SIGCHLD, signal.SIG_IGN)])
    parents = iter([7, 7])
    _process.main()  # which ends before an environment was made
    assert closed == [1]


@pytest.mark.parametrize(("seed", "seeds"), [(None, []), (0, [0]), (5, [5])])
def test_fork_is_reseeded_and_serves_until_the_users_program_ends(monkeypatch, seed, seeds):
    calls, reseeded, required, closed = [], [], [], []
    episodes = SimpleNamespace(reseed=reseeded.append, require_branch=lambda *, reseeded: required.append(reseeded))

    def serve(pipe, is_orphan, given):
        calls.append((pipe, given, is_orphan()))
        gone.append(1)
        calls.append(is_orphan())

    gone = []
    watched = SimpleNamespace(getpid=os.getpid, pidfd_open=lambda pid: calls.append(pid) or 9, close=closed.append)
    polled = SimpleNamespace(select=lambda ready, *_: calls.append(_[2]) or (ready if gone else [], [], []))
    monkeypatch.setattr(_process, "recv_handle", lambda pipe: 4 if pipe == "pipe" else None)
    monkeypatch.setattr(_process, "held", lambda: "held")
    monkeypatch.setattr(_process, "outlive_parent", lambda: calls.append("outlives"))
    monkeypatch.setattr(_process, "Connection", lambda number: f"connection {number}")
    monkeypatch.setattr(_process, "_serve", serve)
    monkeypatch.setattr(_process, "os", watched)
    monkeypatch.setattr(_process, "select", polled)

    def fork(work, known, *, keeps):
        assert (known, keeps) == ("held", (4,))
        work()
        return 88

    monkeypatch.setattr(_process, "fork", fork)
    assert _process._fork("pipe", episodes, seed, 77) == (88, "")
    assert calls == ["outlives", 77, 0.0, ("connection 4", episodes, False), 0.0, True]
    assert (reseeded, required, closed) == (seeds, [seed is not None], [4])
    monkeypatch.setattr(_process, "fork", lambda *_, **__: (_ for _ in ()).throw(CannotForkError("threads")))
    assert _process._fork("pipe", episodes, seed, 77) == (0, "threads")
    assert closed == [4, 4]


def test_requests_are_answered_by_the_episodes_and_copies_by_a_fork(monkeypatch):
    class Served:
        observation_space, action_space, step_length_s, agent = 1, 2, 3.0, "ego"

        def __init__(self, *words):
            self.words = words

        def step(self, action):
            return self.words, action

    monkeypatch.setattr(_process, "load_object", lambda name: Served if name == "of:a user" else None)
    monkeypatch.setattr(_process, "_fork", lambda pipe, episodes, *words: (words, episodes.agent))
    here, there = Pipe()
    found = []

    def answered(name, *words):
        here.send((len(found), name, words))

    episodes = None
    for name, words in (("made", ("of:a user", 5, 6)), ("step", (7,)), ("branch", (8, 9)), ("agent_name", ())):
        answered(name, *words)
        looks = iter([True])
        monkeypatch.setattr(_process, "_LOOK_EVERY_S", 0.0)
        episodes = _process._serve(there, lambda looks=looks: next(looks), episodes)
        found.append(here.recv())
    assert found == [
        (0, True, {"observation_space": 1, "action_space": 2, "step_length_s": 3.0, "agent": "ego"}),
        (1, True, ((5, 6), 7)), (2, True, ((8, 9), "ego")), (3, True, "ego"),
    ]  # fmt: skip
    answered("nothing")
    looks = iter([True])
    _process._serve(there, lambda: next(looks), episodes)
    number, fine, error = here.recv()
    assert (number, fine, type(error)) == (4, False, AttributeError)
    here.close()
    there.close()


# The environment itself.


class Ours:
    """Stands for the episodes of an environment, here or in another process."""

    agent, observation_space, action_space, step_length_s = "ego", "observations", "actions", 0.5

    def __init__(self, *words):
        self.words, self.calls = words, []

    def reset(self, seed, arguments):
        self.calls.append((seed, arguments))
        return "seen", {"n": 1}

    def step(self, action):
        return f"after {action}", 1.5, action == "end", {"n": 2}

    def picture(self):
        return "picture"

    def close(self):
        self.calls.append("close")


@pytest.fixture
def environments(monkeypatch):
    here, remote = type("Here", (Ours,), {}), type("Remote", (Ours,), {})
    monkeypatch.setattr(_sumo_env, "Episodes", here)
    monkeypatch.setattr(_sumo_env, "RemoteEpisodes", remote)
    monkeypatch.setattr(_sumo_env, "_here", set())
    monkeypatch.setattr(_sumo_env, "_process", [])
    return here, remote


def test_environment_passes_on_what_it_is_given(environments):
    here, remote = environments
    env = SumoEnv(Path("toy"), agent="ego", action="meta", max_steps=4, disturb=" brake=1 ,,stop=2 ")
    assert isinstance(env._episodes, here)
    assert env._episodes.words == (Path("toy"), "ego", "meta", ("brake=1", "stop=2"), 4, ())
    other = SumoEnv(Path("toy"))
    assert isinstance(other._episodes, remote)  # the first one has this process's simulation
    assert other._episodes.words == ("toy", "", "", (), 0, ())
    assert isinstance(SumoEnv(process=False)._episodes, here)
    assert isinstance(SumoEnv(process=True)._episodes, remote)
    assert (env.agent, env.observation_space, env.action_space, env.render_mode) == ("ego", "observations", "actions",
                                                                                   None)  # fmt: skip
    assert env.metadata == {"render_modes": ["rgb_array"], "render_fps": 2}
    assert SumoEnv.metadata["render_fps"] == 10


def test_environment_without_a_process_of_its_own_gives_its_simulation_back(environments):
    here, remote = environments
    first = SumoEnv()
    first.close()
    assert first._episodes.calls == ["close"]
    assert isinstance(SumoEnv()._episodes, here)
    far = SumoEnv(process=True)
    far.close()
    assert far._episodes.calls == ["close"]
    assert isinstance(SumoEnv()._episodes, remote)


def test_seeds_of_episodes_are_drawn_from_that_of_the_environment(environments):
    env = SumoEnv(max_steps=9)
    assert env.reset(seed=5, options={"arguments": {"cars": 3}}) == ("seen", {"n": 1})
    env.reset()
    env.reset(seed=5, options={})
    first, second, again = env._episodes.calls
    assert [arguments for _, arguments in (first, second, again)] == [{"cars": 3}, {}, {}]
    rng = np.random.default_rng(np.random.SeedSequence(5))
    assert first[0] == again[0] == int(rng.integers(2**31))
    assert second[0] == int(rng.integers(2**31))
    assert type(first[0]) is int


def test_episode_is_truncated_at_its_length_unless_it_has_ended(environments):
    env = SumoEnv(max_steps=2)
    for actions, truncated in (((1, 1, 1), [False, True, True]), ((1, "end"), [False, False])):
        env.reset()
        steps = [env.step(action) for action in actions]
        assert [step[3] for step in steps] == truncated
    assert steps[1] == ("after end", 1.5, True, False, {"n": 2})
    free = SumoEnv(process=False)
    free.reset()
    assert not any(free.step(1)[3] for _ in range(50))


def test_picture_needs_its_mode_an_episode_and_pillow(environments, monkeypatch):
    env = SumoEnv(render_mode="rgb_array")
    with pytest.raises(UsageError, match="there is nothing to render yet; call reset first"):
        env.render()
    env.reset()
    assert env.render() == "picture"
    plain = SumoEnv(process=False)
    plain.reset()
    assert plain.render() is None
    monkeypatch.setattr(_sumo_env.importlib.util, "find_spec", lambda name: None if name == "PIL" else name)
    with pytest.raises(UsageError, match=re.escape(f"render_mode needs Pillow; {install_command('video')}")):
        SumoEnv(render_mode="rgb_array")
    SumoEnv(process=False)
    with pytest.raises(UsageError, match="render_mode is 'human'; give rgb_array"):
        SumoEnv(render_mode="human")


def test_environment_in_this_process_has_no_copies(environments):
    env = SumoEnv()
    for given, said in (((0,), "n is 0"), ((-1,), "n is -1"), ((1,), "only an environment with a process of its own")):
        with pytest.raises(UsageError, match=said):
            env.branch(*given)
    with pytest.raises(UsageError, match="seed is -1; give 0 or more"):
        env.branch(1, seed=-1)


def test_end_of_the_users_program_is_looked_for_every_second():
    waits = []
    pipe = SimpleNamespace(poll=lambda seconds: waits.append(seconds) or False)
    assert _process._serve(pipe, lambda: len(waits) == 3, "episodes") == "episodes"
    assert waits == [1.0] * 3


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"scenario": 3}, "scenario is 3; give the name of a shipped scenario, or a path"),
        ({"scenario": ""}, "scenario is ''; give the name of a shipped scenario, or a path"),
        ({"max_steps": 0}, "max_steps is 0; give at least 1, or None for no limit"),
        ({"max_steps": 1.5}, "max_steps is 1.5; give at least 1, or None for no limit"),
        ({"disturb": 3}, "disturb is 3; give disturb as text, or omit it"),
        ({"agent": None}, "agent is None; give agent as text, or omit it"),
    ],
)
def test_option_of_a_wrong_type_or_size_is_refused(environments, options, problem):
    with pytest.raises(UsageError) as caught:
        SumoEnv(**options)
    assert str(caught.value) == problem


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"argument": {"cars": 3}}, "options has 'argument'; give only 'arguments'"),
        ([("cars", 3)], "options is [('cars', 3)]; give {'arguments': {NAME: VALUE}}"),
        ({"arguments": None}, "options: arguments is None; give {NAME: VALUE}"),
    ],
)
def test_misspelt_option_of_a_reset_is_refused_and_draws_no_seed(environments, options, problem):
    env = SumoEnv()
    env.reset(seed=5)
    with pytest.raises(UsageError) as caught:
        env.reset(options=options)
    assert str(caught.value) == problem
    env.reset()
    again = SumoEnv(process=False)
    again.reset(seed=5)
    again.reset()
    assert env._episodes.calls == again._episodes.calls


@pytest.mark.parametrize(
    ("value", "allowed"),
    [
        ({"cars": "x"}, "cars is 'x'; give a whole number"),
        ({"cars": True}, "cars is True; give a whole number"),
        ({"cars": [3]}, "cars is [3]; give a whole number"),
        ({"speed": math.nan}, "speed is nan; give a finite number"),
        ({"speed": "fast"}, "speed is 'fast'; give a finite number"),
    ],
)
def test_value_that_an_argument_cannot_have_is_refused(parts, value, allowed):
    made = Episodes("toy", "", "")
    with pytest.raises(ArgumentError) as caught:
        made.reset(1, value)
    assert str(caught.value) == f"options: {allowed}"
    assert not Episode.made
    made.reset(1, {"cars": np.int64(4), "speed": 2})
    assert Episode.made[0].spec.scenario_arguments == {"cars": 4, "speed": 2}
    assert type(Episode.made[0].spec.scenario_arguments["cars"]) is int


def test_closed_environment_refuses_every_use(parts):
    made = Episodes("toy", "", "")
    made.reset(1, {})
    made.close()
    for use in (lambda: made.reset(1, {}), lambda: made.step(1), made.picture):
        with pytest.raises(SimulatorError, match="the environment has been closed; make a new environment"):
            use()


def test_environment_is_neither_copied_nor_pickled(environments):
    env = SumoEnv()
    for use in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(UsageError, match="cannot be copied or pickled; make another one; branch copies"):
            use(env)
