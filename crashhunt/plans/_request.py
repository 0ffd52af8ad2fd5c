"""The request of a user for a hunt, from Python, the command line or a file, before it is resolved."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

from crashhunt.base.calls import clear_constructor
from crashhunt.base.errors import UsageError
from crashhunt.plans._declaration import at_least
from crashhunt.plans._run_options import Driver, HuntOptions, RunOptions, Spec, Subject, hunt_options
from crashhunt.plans._settings import RunSettings, fields_of

if TYPE_CHECKING:
    from collections.abc import Mapping


_REQUIRED_NUMBERS = {  # the numbers of a hunt that are no options: everybody has to give them
    "TRIALS": at_least(0),
    "MAX_STEPS": at_least(1),
    "PARALLEL": at_least(0, zero="one per core"),
}


@clear_constructor
@dataclass(frozen=True, kw_only=True)
class Request(HuntOptions):
    """The user's request for a hunt: all options as the user gave them. `plan` determines all further settings.

    The agents are their locators, and values of arguments are texts in the syntax of the command line.

    Raises:
        UsageError: the agent is not in a module that workers can import, or a table is no dictionary.
    """

    parallel: int = 1  # number of trials at a time; 0 for one per core
    trials: int  # maximum number of trials; 0 for no limit
    max_steps: int  # maximum number of steps of a trial

    def __post_init__(self) -> None:
        """Write the only agent, and values that are not texts, in the form of the command line."""
        super().__post_init__()
        for known in hunt_options(Subject):
            if known.form == "table":
                known.checked(getattr(self, known.name))
        drivers = {} if self.agent in (None, "") else {"": self.agent}
        locators = {name: _locator(who) for name, who in {**(self.agents or {}), **drivers}.items() if who is not None}
        words = {"arguments": spec_words(self.arguments), "scenario_arguments": spec_words(self.scenario_arguments)}
        for name, value in {"agents": locators, "agent": None, **words}.items():
            object.__setattr__(self, name, value)

    @property
    def locators(self) -> dict[str, str]:
        """Locator of each agent, by agent id; the id may be empty if the scenario has one controlled vehicle."""
        return {name: str(locator) for name, locator in (self.agents or {}).items()}

    @property
    def run(self) -> RunSettings:
        """The options that determine how the hunt runs."""
        return RunSettings(parallel=self.parallel, **{name: getattr(self, name) for name in fields_of(RunOptions)})

    def checked(self) -> Self:
        """Return the same request after validation, with plain Python values.

        Raises:
            UsageError: a value is invalid.
        """
        for (name, check), value in zip(
            _REQUIRED_NUMBERS.items(), (self.trials, self.max_steps, self.parallel), strict=True
        ):
            if not isinstance(value, int) or isinstance(value, bool):
                raise UsageError(f"{name} is {value!r}", fix="give a whole number")
            if fix := check(value):
                raise UsageError(f"{name} is {value}", fix=fix)
        if not self.trials and not self.duration and not self.until_rate:
            raise UsageError("TRIALS is 0", fix="give at least 1, or 0 (no limit) with --for or --until-rate")
        checked = super(Request, replace(self, keep_going=True) if self.rare else self).checked()
        if checked.until_rate and (checked.sampler != "random" or checked.seeds):
            option = "--seeds" if checked.seeds else f"--sampler {checked.sampler}"
            raise UsageError(
                f"--until-rate needs independent trials, but {option} draws dependent trials",
                fix=f"omit {option}",
            )
        limits = [limit for limit in (self.trials, checked.most) if limit]
        return replace(checked, trials=min(limits, default=0))


def _locator(who: Driver) -> str:
    if isinstance(who, str):
        return who
    if not callable(who):
        kind = type(who).__qualname__
        raise UsageError(
            f"the agent is an object of class {kind}, but each trial creates its own agent",
            fix=f"give the class {kind} itself, or a function that returns the agent",
        )
    module, name = getattr(who, "__module__", ""), getattr(who, "__qualname__", "")
    if module in ("", "__main__") or not name or "<" in name:
        raise UsageError(
            f"{name or who!r} is not in a module that workers can import",
            fix="move it to its own file, and import it from there or name it 'module:attribute'",
        )
    return f"{module}:{name}"


def spec_words(given: Mapping[str, Spec] | None) -> dict[str, str]:
    """Return specifications of arguments as texts in the syntax of the command line."""
    return {name: str(spec).lower() if isinstance(spec, bool) else str(spec) for name, spec in (given or {}).items()}
