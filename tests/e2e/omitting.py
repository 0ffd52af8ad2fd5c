"""Agents that omit one thing each; they are safe otherwise."""

from crashhunt.agents import CarFollowing


class NeverLooksAside(CarFollowing):
    """Follows well, and changes lanes every five seconds without looking."""

    def reset(self, seed):
        super().reset(seed)
        self.step = 0

    def act(self, observation):
        speed, _ = super().act(observation)
        self.step += 1
        turn = 0 if self.step % 50 else (1 if self.step // 50 % 2 else -1)
        return (speed, turn)
