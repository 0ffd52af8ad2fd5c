"""Roots with copies, and what becomes of them, for test_forced_onsets.py in a process that has one thread."""

from __future__ import annotations

import os
import time
from dataclasses import replace

from branching import Place, Sleeps

from crashhunt.base.processes import children_of
from crashhunt.disturbances import disturber_of, first_forcing, parse_rates
from crashhunt.episode import OnsetForcer, _forks as forks
from crashhunt.trial import CRASHES, Forcing

RATES = ("brake=0.05", "late_observation=0.05", "stop=0.05", "unseen=0.05")


def forcer_of(rates, waited=(), patience_s=30.0, tell=lambda _: None):
    return OnsetForcer(rates, CRASHES, patience_s, list(waited).append, tell)


def sampler_of(place, rates):
    return disturber_of(parse_rates(rates), agents=("ego",), step_length_s=place.simulator.step_length_s)


def cells_of(place, rates):
    """The cells of all first onsets in a root."""
    return place.run(forcer_of(rates), forcing=first_forcing(sampler_of(place, rates), place.steps)).forced.masses


def roots(name, stage, speed, seed, steps, rates=RATES):
    """What the copies of a root come to, and whether each that crashed does so from the start."""
    place = Place(name, stage, speed, seed, steps)
    sampler = sampler_of(place, rates)
    first = first_forcing(sampler, steps)
    early = tuple(one for one in sampler.draw(seed, 1) if one.step == 1)
    plain, root = place.run(disturbances=early), place.run(forcer_of(rates), disturbances=early, forcing=first)
    again = place.run(forcer_of(rates), disturbances=early, forcing=first)
    starts = [place.run(disturbances=one.disturbances) for one in root.forced.copies if one.crash]
    other = place.run(forcer_of(rates), forcing=replace(first, ratios={"stop=6.0": 4.0}))
    always = ("late_observation=0.05",)  # of the agent: each onset is effective
    law = replace(first_forcing(sampler_of(place, always), steps), second_spacing=0.1)
    late = place.run(forcer_of(always), forcing=replace(law, second=tuple(cells_of(place, always)))).forced
    return {
        "chance": sampler_of(place, always).chance("late_observation"),
        "late": [[one.onset, one.within, one.step] for one in late.copies if not one.second and not one.crash],
        "same": plain.digest == root.digest,
        "outcome": str(root.outcome),
        "again": again.forced == root.forced,
        "forced": root.forced.to_json(),
        "starts": [[str(one.outcome), one.steps, one.disturbed] for one in starts],
        "proposed": [[one.cell, one.weight / one.within] for one in other.forced.copies],
        "spacing": first.spacing,
        "other_steps": root.other_steps - (root.setup_steps or 0),
        "left": len(children_of(os.getpid())),
        "plain": place.run(forcer_of(rates)).forced,
    }


def lost(stage):
    """What becomes of a root with copies that hang or die."""
    place, found = Place("toy", stage, 9.5, 2, 60), {}
    forcing, forks._PAUSES_S = Forcing(0.1), (0.0, 0.0)
    for name, how in {"hangs": lambda: time.sleep(600), "dies": lambda: os.kill(os.getpid(), 9)}.items():
        result = place.run(forcer_of(RATES, patience_s=0.3), Sleeps(how), forcing=forcing)
        found[name] = [
            str(result.outcome), len(children_of(os.getpid())), result.is_fully_asked, result.is_to_be_run_again,
            result.forced.to_json(),
        ]  # fmt: skip
    return found


ANSWERS = {
    "lost": lost,
    "toy": lambda stage: roots("toy", stage, 9.5, 2, 120),
    "loop": lambda stage: roots("loop", stage, 15.0, 7, 150),
    "merge": lambda stage: roots("merge", stage, 15.0, 7, 150, ("cut_in=0.05", "late_merge=0.05", "speed=0.05")),
}
