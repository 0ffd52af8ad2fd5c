"""The settings of a hunt, which result from the request (``hunt.toml``)."""

from __future__ import annotations

import sys
import tomllib
from contextlib import suppress
from dataclasses import MISSING, Field, asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from crashhunt.base.calls import clear_constructor
from crashhunt.base.codec import known_part, merged, slip
from crashhunt.base.errors import HuntDirectoryError, UsageError
from crashhunt.base.files import whole_file
from crashhunt.base.integrity import read_bounded
from crashhunt.base.text import command_line, near_path
from crashhunt.oracles import DEFAULT_ORACLES
from crashhunt.plans._durations_and_rates import seconds_of
from crashhunt.plans._run_options import RunOptions, TrialOptions
from crashhunt.trial import CRASHES, Distribution, Kind, Outcome, parse_spec

if TYPE_CHECKING:
    from collections.abc import Iterator

    from crashhunt.base.json_types import Plain
    from crashhunt.samplers import Space


# What hunt.toml has had from the beginning, in the order in which it is written.
_FIRST_KEYS = (
    "scenario", "scenario_digest", "trials", "max_steps", "seed", "sampler", "points", "crash_on", "oracles", "agents",
    "scenario_arguments", "events", "run", "schema",
)  # fmt: skip
_RUN_KEYS = (
    "parallel", "keep_going", "deterministic", "keep_trials", "timeout_s", "audit", "accelerate",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ArgumentSpec:
    """The values that a hunt tries for one argument."""

    spec: str  # specification of the values, as in ``--arg NAME=SPEC``
    kind: Kind | None = None  # the type of the values

    @property
    def distribution(self) -> Distribution:
        """The probability distribution that the specification describes."""
        return parse_spec(self.spec, self.kind)


@dataclass(frozen=True, kw_only=True)
class AgentSettings:
    """The table ``[agents.ID]``: the agent of a vehicle and its argument values."""

    agent: str  # the agent, as in ``--agent``
    # the values that the hunt tries for the agent's arguments
    arguments: dict[str, ArgumentSpec] = field(default_factory=dict)
    action: str | None = None  # the form of the actions, if requested
    # the parts that the agent observes, if the command line or the agent's class names parts
    observation: tuple[str, ...] | None = None


@clear_constructor
@dataclass(frozen=True, kw_only=True)
class RunSettings(RunOptions):
    """The table ``[run]``: how the hunt runs.

    These options do not change trials, so a resumed hunt may have other values.
    """

    parallel: int = 1  # number of trials at a time

    @property
    def duration_s(self) -> float:
        """Time limit of the hunt, in s of wall time."""
        return seconds_of(self.duration)


@clear_constructor
@dataclass(frozen=True, kw_only=True)
class HuntSettings(TrialOptions):
    """The contents of ``hunt.toml``: all options that determine trials."""

    scenario: str  # name or path of the scenario, as the user gave it
    scenario_digest: str  # digest of the scenario's files and settings
    trials: int  # maximum number of trials; 0 if only the time is limited
    max_steps: int  # maximum number of steps of a trial
    seed: int  # seed of the hunt; a trial is determined by this seed and its number
    crash_on: tuple[Outcome, ...] = CRASHES  # the outcomes that count as a crash
    oracles: tuple[str, ...] = DEFAULT_ORACLES  # the oracles that detect crashes, each as in ``--oracle``
    # agent of each controlled vehicle with its arguments, by agent id
    agents: dict[str, AgentSettings] = field(default_factory=dict)
    # the values that the hunt tries for the scenario's arguments
    scenario_arguments: dict[str, ArgumentSpec] = field(default_factory=dict)
    # limits of traffic events that the user requested, such as ``not_moving`` in s
    events: dict[str, float] = field(default_factory=dict)
    run: RunSettings = field(default_factory=RunSettings)  # options that determine how the hunt runs
    schema: Literal[1] = 1  # version of the file format

    @property
    def probe_s(self) -> float:
        """Time between two robustness probes, in s of simulation time; 0 for no probes."""
        return seconds_of(self.probe) if self.probe else 0.0

    @property
    def most_trials(self) -> int:
        """The maximum number of trials; without a limit, a number that no hunt reaches."""
        return self.trials or sys.maxsize

    @property
    def crash_on_words(self) -> tuple[str, ...]:
        """The values of ``--crash-on``, including limits."""
        return tuple(f"{kind}:{self.events[kind]:g}" if kind in self.events else str(kind) for kind in self.crash_on)

    @property
    def space(self) -> Space:
        """The space of all arguments: those that vary, and the constants."""
        found = {("", name): spec.distribution for name, spec in self.scenario_arguments.items()}
        for agent, settings in self.agents.items():
            found |= {(agent, name): spec.distribution for name, spec in settings.arguments.items()}
        return found

    @property
    def texts(self) -> dict[str, list[str]]:
        """The texts that each argument may have, and the words of each agent's command, by name."""
        found = {
            ".".join(filter(None, key)): [value for value in distribution.grid(1) if isinstance(value, str)]
            for key, distribution in self.space.items()
        }
        for name, chosen in self.agents.items():
            found[f"--agent {name}"] = chosen.agent.partition(":")[2].split()
        return {name: values for name, values in found.items() if values}

    def differences(self, other: HuntSettings) -> list[str]:
        """Return the differences between the settings that determine trials, as texts; ``[run]`` is ignored."""
        mine, theirs = (
            _flat(asdict(one)) | {f"agents.{agent}.action": text for agent, text in one._stated_actions()}
            for one in (self, other)
        )
        missing = "(not there)"
        return [
            f"{key} was {_toml_value(mine.get(key, missing))} and is now {_toml_value(theirs.get(key, missing))}"
            for key in sorted(mine.keys() | theirs.keys(), key=lambda key: (key.count("."), key))
            if mine.get(key) != theirs.get(key)
            and not key.startswith("run.")
            and key != "trials"
            # The kind of an argument that only one of them has says nothing more.
            and not (key.endswith(".kind") and key.removesuffix(".kind") in mine.keys() ^ theirs.keys())
        ]

    def _stated_actions(self) -> Iterator[tuple[str, str]]:
        """Yield agents with their forms of actions as a user would have to request them."""
        from crashhunt.scenario import with_stated_choice

        for agent, chosen in self.agents.items():
            with suppress(UsageError):  # a later version may have written a form that this version does not know
                if chosen.action is not None:
                    yield agent, with_stated_choice(chosen.action)


def _flat(data: object, prefix: str = "") -> dict[str, str]:
    if isinstance(data, dict):
        found: dict[str, str] = {}
        for key, value in data.items():
            found |= _flat(value, f"{prefix}.{key}" if prefix else str(key))
        return found
    if isinstance(data, list | tuple):
        return {prefix: ",".join(str(item) for item in data) or "none"}
    return {prefix.removesuffix(".spec"): str(data)}


def write_settings(path: Path, settings: HuntSettings, command: list[str], *, like: Path | None = None) -> None:
    """Write ``hunt.toml``, with the command line as a comment on top. The file is never incomplete.

    Keys that a later version has added to an existing file, or to the file ``like``, are kept.
    """
    import tomli_w

    data = _without_none(asdict(settings))
    if not settings.events:
        del data["events"]
    data = {**_in_order(data, settings, _FIRST_KEYS), "run": _in_order(data["run"], settings.run, _RUN_KEYS)}
    data = merged(data, _changed_settings(like or path))
    text = f"# {command_line(*command)}\n{tomli_w.dumps(data)}"
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _in_order(data: Plain, settings: HuntSettings | RunSettings, first: tuple[str, ...]) -> dict[str, object]:
    """Return the keys that every version knows, in order, then later keys whose values differ from the default."""
    later = (item for item in fields(settings) if item.name not in first)
    asked = [item.name for item in later if getattr(settings, item.name) not in (_default(item), None)]
    return {name: data[name] for name in (*first, *asked) if name in data}


def _default(item: Field[object]) -> object:
    return item.default if item.default_factory is MISSING else item.default_factory()


def read_settings(path: Path) -> HuntSettings:
    """Read ``hunt.toml``.

    Raises:
        HuntDirectoryError: the file is missing or not valid; the message names the key, its value and the fix.
    """
    from crashhunt.base.validation import validate

    try:
        data = tomllib.loads(read_bounded(path).decode())
    except FileNotFoundError:
        place = str(path.parent)
        what = "is not the directory of a hunt: it has no hunt.toml" if path.parent.is_dir() else "does not exist"
        hint = "" if path.parent.is_dir() else near_path(path.parent, ".zip")
        fix = f"{hint}give the directory of a hunt"
        raise HuntDirectoryError(f"{place!r} {what}", fix=fix) from None
    except (ValueError, RecursionError) as error:
        raise HuntDirectoryError(f"not valid TOML: {error}", fix="correct the file", where=str(path)) from None
    except OSError as error:
        raise HuntDirectoryError(
            f"cannot be read: {error.strerror}", fix="check that the file exists and may be read", where=str(path)
        ) from None
    known, later = known_part(HuntSettings, data)
    # A key that resembles a missing one is a typing error or damage, not a key of a later version.
    wrong = {key: later[key] for key in [slip(later, known, HuntSettings)] if key}
    if "run" in later and isinstance(known.get("run"), dict):
        wrong |= {"run": merged(known["run"], later["run"])} if slip(later["run"], known["run"], RunSettings) else {}
    return validate(HuntSettings, {**known, **wrong}, where=str(path), error=HuntDirectoryError)


def _changed_settings(path: Path) -> Plain:
    """Return the keys that a later version has added to an existing file."""
    try:
        later: Plain = known_part(HuntSettings, tomllib.loads(read_bounded(path).decode()))[1]
    except (OSError, ValueError, RecursionError):
        return {}
    return later


def _toml_value(value: object) -> object:
    return "none" if value == "" else value


def _without_none(data: object) -> Any:
    if isinstance(data, dict):
        return {str(key): _without_none(value) for key, value in data.items() if value is not None}
    if isinstance(data, list | tuple):
        return [_without_none(item) for item in data]
    if isinstance(data, Outcome | Path):
        return str(data)
    return data


def fields_of(kind: type) -> tuple[str, ...]:
    """Return the names of the fields of a dataclass."""
    return tuple(item.name for item in fields(kind))
