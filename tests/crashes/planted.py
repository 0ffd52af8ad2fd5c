"""An agent with planted defects; which of them acts in a trial is an argument, so that tests know what is the same."""

from crashhunt.agents import CarFollowing


class Planted(CarFollowing):
    def __init__(self, defect: str = "asleep", observation_space=None, action_space=None, step_length_s: float = 0.1):
        super().__init__(
            desired_speed=25.0, observation_space=observation_space, action_space=action_space,
            step_length_s=step_length_s,
        )  # fmt: skip
        self.defect = defect

    def reset(self, seed):
        super().reset(seed)
        self.step = 0

    def act(self, observation):
        action = super().act(observation)
        self.step += 1
        if self.step < 30:
            return action
        if self.defect == "asleep":
            return self._meta["FASTER"] if self._meta else (30.0, 0)
        if self.defect == "blind":  # changes lanes all the time, and looks ahead only
            turn = 1 if self.step // 20 % 2 else -1
            return self._meta["LANE_LEFT" if turn == 1 else "LANE_RIGHT"] if self._meta else (action[0], turn)
        return observation[self.step * 1000]
