"""The first copy of an episode: what it says about whether there can be any."""

from __future__ import annotations

from types import SimpleNamespace

from crashhunt.base.forks import CannotForkError, NoProcessError
from crashhunt.episode import FirstCopy


def test_system_without_a_process_to_spare_is_asked_again_at_the_next_step():
    left, ended, refused = [NoProcessError("no memory")], [], []

    def fork(work, *, observed):
        if left:
            raise left.pop()
        return SimpleNamespace(end=lambda: ended.append(work(None)))

    first = FirstCopy(refused.append)
    for steps in range(5):
        episode = SimpleNamespace(steps=steps, fork=fork)
        if first.is_due(episode):
            first.ask(episode)
    assert (ended, refused) == ([{}], [])
    left.append(CannotForkError("a process with several threads cannot be forked"))
    first = FirstCopy(refused.append)
    first.ask(SimpleNamespace(steps=1, fork=fork))
    assert refused == ["a process with several threads cannot be forked"]
    assert not first.is_due(SimpleNamespace(steps=2))
