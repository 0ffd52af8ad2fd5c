"""The shapes of what a ledger says besides trials."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NotRequired, TypeAlias, TypedDict

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.hunts._kinds import KindData

__all__ = ["Facts", "Noted", "Owner", "Row", "Seal"]

Row: TypeAlias = tuple[Any, ...]
"""As SQLite returns one; whoever asks for it knows which columns there are."""


class Owner(TypedDict):
    """What tells a process from every other: ``started`` is in ticks since its machine did."""

    host: str
    pid: int
    started: int


class Noted(TypedDict, total=False):
    """What is noted of a hunt besides its state; None where something no longer holds.

    Args:
        owner: who runs it, while somebody does.
        began: when it was begun or resumed, in s since the epoch.
        heartbeat: when it was there last, likewise.
        done_before: how many trials had ended when it began.
        planned: how many trials it has; 0 where only the time is limited.
        until: when its time is up, in s since the epoch; None where it has all the time.
        hunt_seed: what its trials are drawn from.
        independent: whether they were drawn independently of each other.
        plain_origin: of the trials that were, where its sampler keeps some apart that it does not guide; else None.
        lag: by how many trials a sampler that learns is told late.
        origins: whether its sampler says where trials come from.
        core: whether the simulator's compiled core is used; None where it has none.
        disturb: how often what disturbs its trials; None where nothing does.
        copies: of its trials, which there are to be, some of ``probes`` and ``branches``; None where there are none.
        confirmed: of these, how many trials were run from the start of what they found, and how many crashed there.
        nodes: the machines on which it ran last, where there were several: fields of `NodeFigures`.
        kinds: of crashes, the most frequent first, where it collects them all.
        dropped: of each kind, in words, the trials whose crashes are in the ledger only, as shorter ones were kept.
        newest_kind: when the last new one came, in s since the epoch; None where there was none, or nobody knows.
        audits_left: the trials that were to be run again for the audit, and have not been; None where there is none.
        failed_steps: how many steps were simulated to confirm something that was not confirmed.
    """

    owner: Owner | None
    began: float
    heartbeat: float
    done_before: int
    planned: int
    until: float | None
    hunt_seed: int
    independent: bool
    plain_origin: str | None
    lag: int | None
    origins: bool
    core: str | None
    disturb: list[str] | None
    copies: list[str] | None
    confirmed: Mapping[str, Sequence[int]] | None
    nodes: list[dict[str, Any]]
    kinds: list[KindData]
    newest_kind: float | None
    audits_left: list[int] | None
    failed_steps: int
    dropped: dict[str, list[int]]


class Facts(Noted, total=False):
    """All facts of a hunt.

    Args:
        state: as it was entered last, one of ``running``, ``error`` or why it stopped.
        detail: why.
    """

    state: str
    detail: str | None


class Seal(TypedDict):
    """What a ledger held when it was closed; earlier versions said less."""

    outcomes: Mapping[str, int]
    steps: int
    table: str
    dangers: NotRequired[str]
    other_steps: NotRequired[int]
    events: int
    replaced: int
    proposals: NotRequired[int]
    facts: int
