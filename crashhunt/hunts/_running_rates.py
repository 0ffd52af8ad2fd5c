"""Which trials of a hunt count for its crash rate, and the rate of a running hunt.

Cost: constant for each trial. A resumed hunt reads the number and the outcome of each earlier trial once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.plans import rate_of
from crashhunt.rates import BarWatch, CountingRule, RateWatch, TrialFacts
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from crashhunt.ledger import Facts, Ledger
    from crashhunt.plans import HuntSettings

__all__ = ["bar_watch", "counting_rule", "rate_watch", "why_no_interval"]


def counting_rule(settings: HuntSettings, facts: Facts) -> CountingRule:
    """Return how the trials of a hunt count."""
    independent = bool(facts.get("independent", settings.sampler == "random"))
    origin = "" if independent or settings.seeds else facts.get("plain_origin") or ""
    return CountingRule(
        max_steps=settings.max_steps,
        agents=max(1, len(settings.agents)),
        plain_origin=origin,
        traffics=settings.seeds,
        planned=settings.trials,
    )


def why_no_interval(settings: HuntSettings, facts: Facts) -> str:
    """Return why the trials of a hunt say nothing about a rate; empty where they do."""
    if settings.rare:
        return "in rare mode, one of five trials runs without disturbances; crashhunt status reports the rate"
    if settings.seeds:
        if settings.sampler != "random":
            return f"the sampler {settings.sampler} does not draw trials independently"
        if settings.trials < settings.seeds:
            return "no number of trials was fixed ahead for each traffic (--seeds): TRIALS must be at least --seeds"
        return ""
    if facts.get("independent", settings.sampler == "random") or facts.get("plain_origin"):
        return ""
    return f"the sampler {settings.sampler} does not draw trials independently"


def bar_watch(settings: HuntSettings, ledger: Ledger) -> BarWatch | None:
    """Return what watches the rate, with the trials that ended in earlier runs; None where there is no bar."""
    if not settings.run.until_rate:
        return None
    bar, per = rate_of(settings.run.until_rate)
    rule = CountingRule(max_steps=settings.max_steps, agents=max(1, len(settings.agents)), planned=settings.trials)
    watch = BarWatch(rule, bar, per, settings.crash_on)
    for data in ledger.plain_results():
        watch.add(data)
    return watch


def rate_watch(settings: HuntSettings, ledger: Ledger) -> RateWatch | None:
    """Return what counts the trials per trial, with those of earlier runs; None where they bound no rate."""
    facts = ledger.facts()
    if why_no_interval(settings, facts):
        return None
    watch = RateWatch(counting_rule(settings, facts), "trial", settings.crash_on)
    for number, outcome, origin, was_killed in ledger.endings():
        trial = TrialFacts(
            number=number,
            has_ended=not was_killed,
            valid=outcome != Outcome.INVALID,
            crashed=outcome in settings.crash_on,
            steps=0,
            driven_s=None,
            driven_m=None,
            step_length_s=None,
            origin=origin,
        )
        watch.add_facts(trial)
    return watch
