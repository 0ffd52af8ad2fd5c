"""The settings with which a process runs trials of one hunt. These settings are sent to other processes."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from crashhunt.base.codec import (
    ESSENTIAL,
    OMIT_DEFAULT,
    Serializable,
    default_of,
    from_plain,
    merged,
    not_understood,
    required_in,
    to_plain,
)
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.version import __version__
from crashhunt.scenario import Scenario, as_in_file
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Mapping

    from crashhunt.base.codec import JsonObject
    from crashhunt.trial import TrialResult

_TIMEOUT_S = 60.0  # what leaving it out means, whatever the default of the option is some day
_AUDIT_STREAM = 1  # apart from what draws the trial itself


_SCHEMA = 1  # a replay starts the crashhunt of a snapshot, which may be another one


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkerSettings(Serializable):
    """Everything that a worker needs to run the trials of one hunt; it is sent to other processes."""

    scenario: Scenario  # scenario of the trials
    oracles: tuple[str, ...]  # the oracles that detect crashes, each as in ``--oracle``
    crash_on: tuple[Outcome, ...]  # the outcomes that end a trial as a crash
    scratch: Path  # the folder into which workers write black boxes and output while trials run
    # folders whose modules take precedence over installed modules, the first folder first: those of the snapshot. Empty
    # for none.
    code: tuple[str, ...] = ()
    # the file of the snapshot for each argument value that names a file
    argument_files: dict[str, str] = field(default_factory=dict)
    timeout_s: float = _TIMEOUT_S  # wall-clock limit of a trial, in s
    keep_trials: bool = False  # whether the scratch folder of every trial is kept, not only of crashes
    # for an untrusted crash, the files that the process may read in addition to installed packages and its scratch
    # folder. The process may write only in the scratch folder. With None, the process has no restrictions.
    sealed: tuple[str, ...] | None = field(default=None, metadata=ESSENTIAL)
    # whether the trial confirms a crash: further runs find the last step at which braking avoids a collision, and
    # lights and routes are recorded for its picture. Only in a new process.
    find_escapes: bool = False
    audit: float = 0.0  # the share of trials without a crash whose scratch folder is kept, because they are run again
    hunt_seed: int = 0  # seed of the hunt, which determines the audited trials
    # number of traffic seeds for which a worker keeps a suspended fork after the warm-up; 0 for none
    warm_copies: int = field(default=0, metadata=OMIT_DEFAULT)
    # time between two probes of a trial, in s of simulation time; 0 for no probes
    probe_s: float = field(default=0.0, metadata=OMIT_DEFAULT)
    # the rates of disturbances in branches, each as ``NAME=RATE``; empty for no branches
    branch: tuple[str, ...] = field(default=(), metadata=OMIT_DEFAULT)
    # the rates of disturbances in forks with a forced first disturbance, each as ``NAME=RATE``; empty for none
    force: tuple[str, ...] = field(default=(), metadata=OMIT_DEFAULT)
    # wall-clock limit of each action of a program, a library or an FMU, in s; 0 for none
    step_timeout_s: float = field(default=0.0, metadata=OMIT_DEFAULT)
    # identifiers of the vehicles whose program drives in one trial after another
    reuses: tuple[str, ...] = field(default=(), metadata=OMIT_DEFAULT)

    json_keys: ClassVar[tuple[str, ...]] = (
        "oracles", "crash_on", "scratch", "code", "argument_files", "timeout_s", "keep_trials", "sealed",
        "find_escapes", "audit", "hunt_seed", "warm_copies", "probe_s", "branch", "force", "step_timeout_s",
        "reuses",
    )  # fmt: skip

    def keeps(self, result: TrialResult) -> bool:
        """Return whether the recording and the files of a trial are kept."""
        is_wanted = self.keep_trials or result.outcome in self.crash_on or result.failure is not None
        return is_wanted or self.is_audited(result)

    def is_audited(self, result: TrialResult) -> bool:
        """Return whether a trial belongs to the audited sample, which its number and the hunt's seed determine."""
        if self.audit <= 0.0 or result.outcome not in (Outcome.SURVIVED, Outcome.FINISHED):
            return False
        draw = np.random.SeedSequence(self.hunt_seed, spawn_key=(result.spec.number, _AUDIT_STREAM)).generate_state(1)[
            0
        ]
        return bool(draw < self.audit * 2**32)

    def to_json(self) -> JsonObject:
        """Return the settings as JSON-compatible data."""
        # A replay hands this to the crashhunt of the snapshot, and an older one refuses keys that it does not know:
        # what has come since is written only where it is asked for. For this the defaults may never change.
        scenario = as_in_file(_asked(replace(self.scenario, file=type(self.scenario).file, added={})))
        requires = required_in(self)
        whole = {**scenario, "schema": self.scenario.schema, "folder": str(self.scenario.folder)}
        data = {"schema": _SCHEMA, "scenario": merged(whole, self.scenario.added), **to_plain(self)}
        return {**data, "requires": requires} if requires else data

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the settings from the data of `to_json` of any version; unknown keys are ignored.

        Raises:
            CrashhuntError: another version of crashhunt wrote the data, and they need a feature that this version does
                not have.
        """
        from crashhunt.scenario import installed_backends, scenario_from_dict

        tables = [backend.table for _, backend in installed_backends()] if data.get("requires") else []
        unknown = not_understood(data.get("requires") or (), cls, Scenario, *tables)
        if data.get("schema") != _SCHEMA or unknown:
            how = f"with {', '.join(unknown)}, which {__version__} does not support" if unknown else "in another way"
            raise CrashhuntError(
                f"the snapshot has crashhunt {__version__}, but the installed crashhunt runs its trials {how}",
                fix=f"pip install crashhunt=={__version__}, or replay with --code current",
            )
        scenario = dict(data["scenario"])
        folder = Path(str(scenario.pop("folder")))
        made = scenario_from_dict(scenario, where="worker settings", folder=folder, tolerant=True)
        return from_plain(cls, {**data, "scenario": made})


def _asked(value: object) -> Any:
    """Return plain data in which a dataclass contains only the fields that differ from their defaults."""
    if is_dataclass(value):
        pairs = ((item, getattr(value, item.name)) for item in fields(value))
        return {item.name: _asked(held) for item, held in pairs if held != default_of(item)}
    if isinstance(value, dict):
        return {name: _asked(held) for name, held in value.items()}
    return [_asked(held) for held in value] if isinstance(value, list | tuple) else value


def scratch_of(scratch: Path, number: int) -> Path:
    """Return the scratch folder of a trial, which remains if the trial is kept."""
    return scratch / f"trial-{number:06d}"
