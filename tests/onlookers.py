"""Agents and an observer with which tests look at what others do."""

from __future__ import annotations

from crashhunt.episode import Observer


class Always:
    """Returns the same action in each step, whatever it sees."""

    def __init__(self, action):
        self.action = action

    def reset(self, seed):
        pass

    def act(self, observation):
        return self.action


class Steady(Always):
    """Drives at a speed that may be set, and reacts to no other vehicle."""

    def __init__(self, speed=8.0):
        self.speed = speed

    def act(self, observation):
        return self.speed, 0


class Scripted:
    """Does what a function of the step says, and has another function look at what it is shown."""

    def __init__(self, act, look=id):
        self._act, self._look, self._step = act, look, 0

    def reset(self, seed):
        self._step = 0

    def act(self, observation):
        self._look(observation)
        self._step += 1
        return self._act(self._step)


class Watch(Observer):
    """Keeps scenes, and what takes place."""

    def __init__(self):
        self.scenes, self.told = [], []

    def scene(self, step, scene, rewards):
        self.scenes.append(scene)

    def disturbance(self, disturbance):
        self.told.append(disturbance)

    def of(self, name, values):
        """One of the arrays of scenes, for one actor, in the scenes in which it is there."""
        there = [scene for scene in self.scenes if name in scene.roster.index]
        return [getattr(scene, values)[scene.roster.index[name]] for scene in there]

    def speeds(self, name):
        return self.of(name, "speeds")
