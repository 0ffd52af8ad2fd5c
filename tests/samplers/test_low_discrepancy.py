"""Points in a cube stand for arguments, and Halton's and Sobol's fill it evenly, whatever the arguments are."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from conftest import examples
from hypothesis import HealthCheck, example, given, settings, strategies as st
from spaces import are_inside, ask, distributions, spaces, spec_of

from crashhunt.samplers import Cube, HaltonSampler, HuntFacts, NamedSampler, Proposal, SobolSampler
from crashhunt.space import Choice, Constant, Range

KINDS = (HaltonSampler, SobolSampler)
quickly = settings(deadline=None, max_examples=examples(30), suppress_health_check=[HealthCheck.too_slow])


@quickly
@given(distributions, st.floats(0, 1))
def test_a_quantile_is_a_value_and_has_a_share(known, share):
    value = known.quantile(share)
    assert known.contains(value)
    again = known.quantile(known.share_of(value))
    assert again == pytest.approx(value, rel=1e-9, abs=1e-3) if isinstance(value, float) else again == value
    assert type(value) is type(known.sample(np.random.default_rng(0)))


@quickly
@given(distributions)
@example(Range(0.0, -0.0))
def test_quantiles_of_even_shares_are_spread_as_draws_are(known):
    if isinstance(known, Constant) or (isinstance(known, Choice) and isinstance(known.options[0], str | bool)):
        return
    rng = np.random.default_rng(1)
    drawn = sorted(float(known.sample(rng)) for _ in range(400))
    spread = sorted(float(known.quantile((index + 0.5) / 400)) for index in range(400))
    width = max(spread[-1] - spread[0], 1e-9)
    apart = [abs(np.mean([one <= at for one in drawn]) - np.mean([one <= at for one in spread])) for at in spread[::40]]
    assert max(apart) < 0.12, f"as a share of {width}"  # Kolmogorov and Smirnov: 0.12 in one of 10,000


@quickly
@given(spaces, st.integers(0, 2**40))
def test_a_point_represents_arguments_and_comes_back(space, seed):
    cube = Cube(space)
    point = np.random.default_rng(seed).random(cube.dimensions)
    arguments = cube.arguments(point)
    assert list(arguments) == sorted(space)
    back = cube.point(spec_of(0, Proposal(arguments)))
    assert cube.arguments(back).keys() == arguments.keys()
    assert ((back >= 0) & (back <= 1)).all()
    assert np.abs(cube.point(spec_of(0, Proposal(cube.arguments(back)))) - back).max(initial=0.0) < 1e-6


@pytest.mark.parametrize("kind", KINDS)
@quickly
@given(space=spaces, seed=st.integers(0, 2**70), first=st.integers(0, 5000))
def test_proposals_are_inside_and_follow_from_seed_and_number(kind, space, seed, first):
    sampler = kind(space, hunt=HuntFacts(seed))
    numbers = [first, first + 1, 0, first + 1, 3]
    asked = [ask(sampler, number) for number in numbers]
    assert all(are_inside(proposal, space) for proposal in asked)
    assert asked[1] == asked[3]
    assert [ask(kind(space, hunt=HuntFacts(seed)), number, seed=2) for number in numbers] == asked


@pytest.mark.parametrize("kind", KINDS)
def test_every_part_of_the_space_gets_its_share(kind):
    space = {("ego", f"x{index}"): Range(0.0, 1.0) for index in range(2)} | {("", "mode"): Choice(tuple("abcd"))}
    sampler = kind(space, hunt=HuntFacts(5))
    asked = [ask(sampler, number).arguments for number in range(256)]
    for name in ("x0", "x1"):
        counts = np.histogram([one["ego", name] for one in asked], bins=16, range=(0, 1))[0]
        assert counts.min() >= 13, name  # 16 each; of independent draws the fewest are 9 or so
        assert counts.max() <= 19, name
    modes = [one["", "mode"] for one in asked]
    assert all(60 <= modes.count(mode) <= 68 for mode in "abcd")


@pytest.mark.parametrize("kind", KINDS)
def test_the_seed_of_the_hunt_scrambles_it(kind):
    space = {("ego", "speed"): Range(0.0, 1.0)}
    name = kind.sequence.lower()
    made = [NamedSampler(name, space, points=3, hunt=HuntFacts(seed)) for seed in range(8)]
    first = {ask(sampler, 0).arguments["ego", "speed"] for sampler in made}
    assert len(first) == 8


@pytest.mark.nightly
def test_scipy_is_imported_only_when_it_is_asked():
    code = (
        "import sys; from crashhunt.samplers import HaltonSampler, NamedSampler; from crashhunt.space import Range\n"
        "sampler = NamedSampler('halton', {('', 'x'): Range(0.0, 1.0)}, points=1)\n"
        "assert 'scipy' not in sys.modules; sampler.ask(0, None); assert 'scipy.stats' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
