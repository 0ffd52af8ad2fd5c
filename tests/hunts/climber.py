"""A sampler that learns: it goes on from the nearest miss, and says of each proposal what it was told, in order."""

from __future__ import annotations

from crashhunt.samplers import Proposal


class Climber:
    learns = True

    def __init__(self, space, *, points=10):
        self._space = sorted(space.items())
        self._best = None
        self._told = 0

    def ask(self, number, rng):
        drawn = {key: distribution.sample(rng) for key, distribution in self._space}
        if self._best is None or self._told % 3 == 0:
            return Proposal(drawn, origin=f"draw {self._told}")
        spec = self._best.spec
        before = {
            **{("", name): value for name, value in spec.scenario_arguments.items()},
            **{(agent, name): value for agent, given in spec.arguments.items() for name, value in given.items()},
        }
        mixed = {
            key: before[key] if not isinstance(value, float) else before[key] + (value - before[key]) / 4
            for key, value in drawn.items()
        }
        return Proposal(mixed, seed=spec.seed, parent=spec.number, origin=f"climb {self._told}")

    def tell(self, result):
        self._told = (31 * self._told + result.spec.number + 7 * result.steps) % 99991
        nearness = result.closest.time_to_collision_s
        if self._best is None or nearness < self._best.closest.time_to_collision_s:
            self._best = result


class Old(Climber):
    """As samplers were before there were proposals."""

    learns = False

    def ask(self, number, rng):
        return {key: distribution.sample(rng) for key, distribution in self._space}


class Bad(Climber):
    """Does what is asked of it by the name of an argument of the scenario, which is how a test chooses."""

    def __init__(self, space, *, points=10):
        super().__init__(space)
        self._how = next(name for agent, name in space if not agent)
        if self._how == "unmade":
            raise KeyError("nothing to sample")
        if self._how == "independent":
            self.independent = True

    def ask(self, number, rng):
        given = super().ask(number, rng).arguments
        return {
            "raises": lambda: 1 / 0,
            "list": lambda: [1, 2],
            "missing": dict,
            "more": lambda: {**given, ("ego", "other"): 1},
            "infinite": lambda: {**given, ("ego", "speed"): float("inf")},
            "object": lambda: {**given, ("ego", "speed"): object},
            "seed": lambda: Proposal(given, seed=-1),
            "parent": lambda: Proposal(given, parent="first"),
            "origin": lambda: Proposal(given, origin=None),
        }[self._how]()
