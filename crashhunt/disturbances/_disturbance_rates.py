"""Rates of disturbances, such as ``brake=0.02,cut_in=0.01``, and the disturbances that are drawn for a trial.

Each model has a separate random generator around each agent, seeded by the trial's seed and the model's name. Adding a
model therefore changes neither the draws of other models nor anything else that is drawn from the seed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base.errors import CrashhuntError, PluginError, UsageError
from crashhunt.base.exceptions import blamed
from crashhunt.base.plugins import locate, registered
from crashhunt.base.text import one_of
from crashhunt.disturbances._protocol import DisturbanceModel, Drawn, HoldsResources
from crashhunt.trial import CELLS, KINDS, SENSOR_KINDS, Disturbance, in_turn, is_signal, why_not

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from crashhunt.trial import TrialResult


# ``brake@124=ahead:4:2``: a disturbance that every trial has, in a given step.

FORM = "KIND@STEP=WHO:HOW_STRONG:HOW_LONG"
_FORM_FIX = f"write {FORM}, such as brake@124=ahead:4:2 for 4 m/s² and 2 s from step 124 on"


def is_fixed(word: str) -> bool:
    """Return whether a word describes a disturbance at a given step instead of a rate."""
    return "@" in word


def parse_fixed(words: Iterable[str], agents: Sequence[str], *, shown: str = "--disturb") -> tuple[Disturbance, ...]:
    """Return the disturbances at given steps, ``[AGENT.]KIND@STEP=WHO:HOW_STRONG:HOW_LONG``, in the order of steps.

    Words with a rate are ignored. ``shown`` names the option or key of the words in error messages.

    Raises:
        UsageError: a word is invalid, or two disturbances of a kind begin in the same step around the same agent.
    """
    found: dict[tuple[int, str, str], Disturbance] = {}
    for word in filter(is_fixed, words):
        one = _parsed(word, agents, shown)
        key = one.step, one.agent, one.what
        if key in found:
            raise UsageError(
                f"{shown} {word}: another {one.what} already begins at step {one.step}", fix="give one of the two"
            )
        found[key] = one
    return tuple(one for _, one in sorted(found.items()))


def word_of(one: Disturbance, agents: Sequence[str]) -> str:
    """Return the word that describes a disturbance at a given step; it names the agent only if there are several.

    If its strength is a signal, the word has the greatest strength.
    """
    whose = f"{one.agent}." if len(agents) > 1 else ""
    place = one.who.replace(" ", "_")  # so that no shell needs quotes
    return f"{whose}{one.what}@{one.step}={place}:{one.how_strong!r}:{one.how_long!r}"


def _parsed(word: str, agents: Sequence[str], shown: str) -> Disturbance:
    name, equals, text = word.partition("=")
    kind, _, step = name.partition("@")
    parts = _parts(text)
    agent, what = _agent_and_kind(kind, agents, f"{shown} {word}")
    if not (equals and what and len(parts) == 3 and step.isascii() and step.isdecimal() and int(step) > 0):
        raise UsageError(f"{shown} {word!r} is not a disturbance", fix=_FORM_FIX)
    who = parts[0].replace("_", " ")
    if who not in CELLS:
        raise UsageError(f"{shown} {word}: {parts[0]!r} is not a place around an agent", fix=one_of(who, CELLS))
    one = Disturbance(
        step=int(step), who=who, what=what, how_strong=_strongest(parts[1]), how_long=_number(parts[2]), agent=agent
    )
    if reason := why_not(one):
        raise UsageError(f"{shown} {word}: {reason[0]}", fix=reason[1])
    return one


def _parts(text: str) -> list[str]:
    """Return place, strength and duration; a strength that is a signal contains colons."""
    who, *strength, long = (part.strip() for part in text.split(":")) if ":" in text else (text, "")
    return [who, ":".join(strength), long] if strength else [who, long]


def _strongest(text: str) -> float:
    """Return a strength; of a signal, the upper bound. `expand_signal` reports an invalid signal."""
    if not is_signal(text):
        return _number(text)
    bounds = [_number(word) for word in text.split(":")[1:] if "=" not in word]
    if min(bounds, default=0.0) < 0:
        raise UsageError(f"{_OPTION}: the signal {text!r} is below 0", fix="give LOW of at least 0")
    return max(bounds, default=0.0)


def signals_of_fixed(words: Iterable[str], agents: Sequence[str]) -> dict[str, tuple[Disturbance, str, str]]:
    """Return the disturbances at given steps whose strength is a signal, with the signal and the word of each.

    The key is the name under which the trial's arguments of the scenario contain the signal.

    Raises:
        UsageError: a word is invalid, or two signals have the same name.
    """
    found: dict[str, tuple[Disturbance, str, str]] = {}
    for word in filter(is_fixed, words):
        strength = _parts(word.partition("=")[2])[1]
        if not is_signal(strength):
            continue
        one = _parsed(word, agents, _OPTION)
        if one.signal in found:
            fix = "give the signals different steps"
            raise UsageError(f"{_OPTION} {word}: another signal is already called {one.signal}", fix=fix)
        found[one.signal] = one, strength, word
    return found


def _agent_and_kind(name: str, agents: Sequence[str], shown: str) -> tuple[str, str]:
    """Return the agent around which the disturbance occurs, and the kind of the disturbance."""
    agent, dot, what = name.rpartition(".")
    if dot and agent not in agents:
        raise UsageError(f"{shown}: there is no controlled vehicle {agent!r}", fix=one_of(agent, agents))
    if not dot and len(agents) > 1:
        fix = f"write {agents[0]}.{name}@…"
        raise UsageError(f"{shown} names no agent, but the scenario has several: {', '.join(agents)}", fix=fix)
    return agent or agents[0], what


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


NONE = "none"
"""The word for no disturbances, whatever the scenario says."""
_TRIAL_STREAM = 0x64697374  # apart from what else is drawn of a trial's seed: agents count from 0
_BRANCH_STREAM = 0x6272616E  # and what is drawn for copies of it
_STRONGEST_STREAM = 0x73747267  # as strong as it may be
_STRONGEST_OF_DRAWS = 32  # draws of a model, of which the strongest is used: models do not report their maximum
_OPTION = "--disturb"


def parse_rates(words: Iterable[str]) -> dict[str, float]:
    """Return the rate of each disturbance in 1/s, from words such as ``NAME=RATE``; rates of 0 are omitted.

    The word ``none`` stands for no disturbances. Words that give a disturbance at a given step are ignored.

    Raises:
        UsageError: a word has no rate, or a name occurs twice.
    """
    given = tuple(words)
    rates: dict[str, float] = {}
    for word in given:
        if word == NONE:
            if len(given) > 1:
                raise UsageError(
                    f"{_OPTION} {','.join(given)}: none cannot be combined with other disturbances",
                    fix="omit none, or the other disturbances",
                )
            continue
        if is_fixed(word):
            continue
        name, equals, text = word.rpartition("=")
        if not equals or not name:
            fix = f"write NAME=RATE with a rate per second, such as brake=0.02, or {FORM}"
            raise UsageError(f"{_OPTION} {word!r} has no rate", fix=fix)
        if name in rates:
            raise UsageError(f"{_OPTION} gives {name!r} twice", fix="give it once")
        rates[name] = _rate(name, text)
    return {name: rate for name, rate in sorted(rates.items()) if rate > 0}


def _rate(name: str, text: str) -> float:
    try:
        rate = float(text)
    except ValueError:
        rate = math.nan
    if not 0 <= rate < math.inf:
        fix = "give a rate per second of at least 0, such as 0.02"
        raise UsageError(f"{_OPTION} {name}={text}: {text!r} is not a rate", fix=fix)
    return rate


def disturber_of(
    rates: Mapping[str, float], *, agents: Sequence[str], step_length_s: float, known: Sequence[str] | None = None,
    simulator: str = "the simulator", fixed: Sequence[Disturbance] = (),
    find: Callable[[str], DisturbanceModel] | None = None,
) -> DisturbanceSampler:  # fmt: skip
    """Return the sampler of a hunt's disturbances.

    Every trial has the ``fixed`` disturbances in addition. If it is not known which kinds the simulator supports,
    ``known`` is None. By default, `locate_model` finds the models.

    Raises:
        PluginError: a model does not exist.
        UsageError: a rate means more than one disturbance per step, or the simulator does not support a kind.
    """
    models: dict[str, DisturbanceModel] = {}
    for name, rate in rates.items():
        model = (find or locate_model)(name)
        if rate * step_length_s > 1:
            fix = f"give at most {1 / step_length_s:g} a second"
            raise UsageError(
                f"{_OPTION} {name}={rate:g}: the rate exceeds one disturbance per step of {step_length_s:g} s", fix=fix
            )
        _refuse_unsupported(name, model.what, known, simulator)
        twin = next((other for other, made in models.items() if made.what == model.what), None)
        if twin is not None:
            message = f"{_OPTION}: {twin} and {name} both inject disturbances of the kind {model.what!r}"
            raise UsageError(message, fix="choose one of the two")
        models[name] = model
    for one in fixed:
        if known is None and one.what not in KINDS:
            continue  # whose simulator has not said what it can do
        if one.what not in (*KINDS, *(known or ())):
            fix = one_of(one.what, sorted({*KINDS, *(known or ())}))
            raise UsageError(f"{_OPTION}: there is no kind of disturbance {one.what!r}", fix=fix)
        _refuse_unsupported(f"{one.what}@{one.step}", one.what, known, simulator)
    return DisturbanceSampler(
        models=models, rates=dict(rates), agents=tuple(agents), step_length_s=step_length_s, fixed=tuple(fixed)
    )


def _refuse_unsupported(name: str, what: str, known: Sequence[str] | None, simulator: str) -> None:
    if known is None or what in known or what in SENSOR_KINDS:
        return
    able = sorted(point for point in registered("disturbances") if point in (*known, *SENSOR_KINDS))
    message = f"{_OPTION} {name}: {simulator} does not support the disturbance {what!r}"
    raise UsageError(message, fix=f"it supports {', '.join(able)}" if able else "omit the option")


def modules_of_models(words: Iterable[str]) -> list[str]:
    """Return the modules of the models that words name as ``module:attribute``, without importing them."""
    return [name.partition(":")[0] for name in parse_rates(words) if ":" in name]


def locate_model(name: str) -> DisturbanceModel:
    """Return the model with a registered name or a ``module:attribute``.

    Raises:
        PluginError: the model does not exist.
    """
    if ":" not in name and name not in registered("disturbances"):
        fix = f"{one_of(name, registered('disturbances'), none='(none)')}, or module:attribute"
        raise UsageError(f"{_OPTION}: there is no disturbance {name!r}", fix=fix)
    try:
        made: DisturbanceModel = locate("disturbances", name)()
    except CrashhuntError:
        raise
    except Exception as error:  # of user code
        raise blamed(f"the disturbance {name!r} cannot be created", error) from error
    for part in ("what", "draw", "log_likelihood"):
        if not hasattr(made, part):
            raise PluginError(
                f"{name!r} is not a disturbance model: it has no {part}",
                fix=f"define {part}, and test the model with crashhunt.testing",
            )
    return made


def draw_checked(name: str, model: DisturbanceModel, rng: np.random.Generator) -> Drawn:
    """Return a disturbance that a model draws, after checking it.

    Raises:
        PluginError: the model failed, or did not draw a valid disturbance.
    """
    try:
        drawn = model.draw(rng)
        fine = drawn.who in CELLS and math.isfinite(drawn.how_strong) and 0 < drawn.how_long < math.inf
    except CrashhuntError:  # of a model in its own process, which has been blamed there
        raise
    except Exception as error:  # of user code
        raise blamed(f"the disturbance {name!r} cannot be drawn", error) from error
    if not fine:
        fix = f"draw one of {', '.join(CELLS)}, a finite strength, and a length above 0 s"
        raise PluginError(f"the disturbance {name!r} returned {drawn}, which is not a disturbance", fix=fix)
    return drawn


@dataclass(frozen=True, slots=True)
class DisturbanceSampler:
    """Draws the disturbances of trials, and returns their log-likelihood.

    In every step, each model begins a disturbance around each agent with a probability of rate times step length, even
    while other disturbances are active.
    """

    models: Mapping[str, DisturbanceModel]  # models by name
    rates: Mapping[str, float]  # rate of each model, in 1/s, by name
    agents: tuple[str, ...]  # the controlled vehicles, around which disturbances occur
    step_length_s: float
    fixed: tuple[Disturbance, ...] = ()  # disturbances that every trial has in addition to the drawn ones

    def draw(self, seed: int, max_steps: int) -> tuple[Disturbance, ...]:
        """Return the disturbances of a trial in order; a longer trial with the same seed begins with the same ones."""
        found: list[Disturbance] = []
        for number, agent in enumerate(self.agents):
            for name in self.models:
                key = (_TRIAL_STREAM, number, *name.encode())
                rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
                found += self.draw_between(0, max_steps, name, agent, rng)
        return self._with_fixed(found, 0, max_steps)

    def draw_another(self, seed: int, number: int, after: int, soon: int, last: int) -> tuple[Disturbance, ...]:
        """Return other disturbances after a step of a trial: at least one begins soon, the others are drawn as usual.

        The first one begins within ``soon`` steps, and none after the step ``last``. ``number`` distinguishes several
        draws.
        """
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_BRANCH_STREAM, after, number)))
        places = [(agent, name) for agent in self.agents for name in self.models]
        chances = np.array([self.chance(name) for _, name in places])
        agent, name = places[int(rng.choice(len(places), p=chances / chances.sum()))]
        first = self.draw_one(after + 1 + int(rng.integers(soon)), name, agent, rng)
        others = [one for agent, name in places for one in self.draw_between(first.step, last, name, agent, rng)]
        return self._with_fixed([first, *others], after, last)

    def draw_strongest(self, seed: int, number: int, after: int, soon: int) -> tuple[tuple[Disturbance, ...], ...]:
        """Return the strongest disturbances with which each model may soon disturb each agent, from many draws.

        All begin within ``soon`` steps. ``number`` distinguishes several draws.

        Returns:
            Several alternatives for each model and agent, because a place may have no actor that can be disturbed.
        """
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_STRONGEST_STREAM, after, number)))
        found = []
        for agent in self.agents:
            for name in self.models:
                step = after + 1 + int(rng.integers(soon))
                drawn = dict.fromkeys(self.draw_one(step, name, agent, rng) for _ in range(_STRONGEST_OF_DRAWS))
                found.append(tuple(sorted(drawn, key=_strength, reverse=True)))
        return tuple(found)

    def _with_fixed(self, drawn: Iterable[Disturbance], after: int, last: int) -> tuple[Disturbance, ...]:
        """Return the drawn and the given disturbances; a given disturbance replaces drawn ones of its kind and step."""
        given = [one for one in self.fixed if after < one.step <= last]
        taken = {_key(one) for one in given}
        return in_turn([*(one for one in drawn if _key(one) not in taken), *given])

    def draw_between(self, after: int, last: int, name: str, agent: str, rng: np.random.Generator) -> list[Disturbance]:
        """Return the disturbances that a model begins around an agent between two steps.

        A disturbance may begin after the step ``after`` and up to the step ``last``.
        """
        chance, step, found = self.chance(name), after, []
        # A waiting time can be longer than any number of steps: that of a rate near 0.
        while (step := step + int(min(rng.geometric(chance), last + 1))) <= last:
            found.append(self.draw_one(step, name, agent, rng))
        return found

    def draw_one(self, step: int, name: str, agent: str, rng: np.random.Generator) -> Disturbance:
        """Return a disturbance that a model begins around an agent in a step."""
        drawn = draw_checked(name, self.models[name], rng)
        strong, long = float(drawn.how_strong), float(drawn.how_long)
        one = Disturbance(
            step=step, who=drawn.who, what=self.models[name].what, how_strong=strong, how_long=long, agent=agent
        )
        reason = why_not(one) if one.what in KINDS else None  # only built-in kinds can be checked
        if reason is not None:
            raise PluginError(f"the disturbance {name!r} returned {drawn}: {reason[0]}", fix=reason[1])
        return one

    def log_likelihood(self, disturbances: Iterable[Disturbance], steps: int) -> float:
        """Return the natural logarithm of the probability that exactly these disturbances begin in the given steps.

        Disturbances at given steps always begin, regardless of the models' draws in these steps. Disturbances after the
        given steps are ignored.
        """
        given = {_key(one) for one in self.fixed if one.step <= steps}
        begun = [one for one in disturbances if one.step <= steps and _key(one) not in given]
        total = 0.0
        for agent in self.agents:
            for name, model in self.models.items():
                chance = self.chance(name)
                mine = [one for one in begun if one.agent == agent and one.what == model.what]
                for one in mine:
                    total += math.log(chance) + model.log_likelihood(Drawn(one.who, one.how_strong, one.how_long))
                free = steps - sum((one_agent, what) == (agent, model.what) for _, one_agent, what in given)
                if len(mine) < free:
                    total += (free - len(mine)) * (math.log1p(-chance) if chance < 1 else -math.inf)
        known = {model.what for model in self.models.values()}
        return total if all(one.what in known and one.agent in self.agents for one in begun) else -math.inf

    def log_likelihood_of(self, result: TrialResult) -> float | None:
        """Return the log-probability that exactly the disturbances of a trial begin in its steps.

        A draw without a target vehicle has no effect, so it does not lower the likelihood. The result is None if the
        hunt draws no disturbances.
        """
        if not self.models:
            return None
        there = {(one.step, one.agent, one.what) for one in result.disturbances}
        drawn = [one for one in result.spec.disturbances if (one.step, one.agent, one.what) in there]
        return self.log_likelihood(drawn, result.steps_begun)

    def close(self) -> None:
        """End the processes in which foreign models draw."""
        for model in self.models.values():
            if isinstance(model, HoldsResources):
                model.close()

    def chance(self, name: str) -> float:
        """Return the probability that a model begins a disturbance around an agent in one step."""
        return min(1.0, self.rates[name] * self.step_length_s)


def _strength(one: Disturbance) -> tuple[float, float]:
    kind = KINDS.get(one.what)
    return -one.how_strong if kind is not None and kind.less_is_worse else one.how_strong, one.how_long


def _key(one: Disturbance) -> tuple[int, str, str]:
    return one.step, one.agent, one.what
