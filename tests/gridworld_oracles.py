"""What the tests of the two GridWorld scripts compare with: the world, written down once more."""

import gymnasium as gym
import pytest

CELLS = [(1, 1), (2, 1), (3, 1), (4, 1), (1, 2), (3, 2), (4, 2), (1, 3), (2, 3), (3, 3), (4, 3)]
ACTIONS = ["left", "up", "right", "down"]
ENDS = {(4, 3): 1.0, (4, 2): -1.0}
ACTING = [0, 1, 2, 3, 4, 5, 7, 8, 9]
STEP = {"left": (-1, 0), "up": (0, 1), "right": (1, 0), "down": (0, -1)}
FIGURE_10 = dict(zip(ACTING, "up left left left up left right right right".split(), strict=True))


def outcomes(cell, action, slip=0.2, step_reward=-0.025):
    """{(next cell, reward): probability} of an action in a cell."""
    sides = ("up", "down") if action in ("left", "right") else ("left", "right")
    result = {}
    for way, p in ((action, 1 - slip), (sides[0], slip / 2), (sides[1], slip / 2)):
        target = (cell[0] + STEP[way][0], cell[1] + STEP[way][1])
        target = target if target in CELLS else cell
        key = (target, ENDS.get(target, step_reward))
        result[key] = result.get(key, 0) + p
    return {key: p for key, p in result.items() if p > 0}


def values(policy=None, slip=0.2, step_reward=-0.025, discount=1.0):
    """V (11,) of the policy {s: action}, of the best one without it: 400 plain sweeps."""
    V = dict.fromkeys(CELLS, 0.0)
    for _ in range(400):
        old = dict(V)
        for s in ACTING:
            worth = {action: sum(p * (r + discount * old[c]) for (c, r), p in
                                 outcomes(CELLS[s], action, slip, step_reward).items())
                     for action in ACTIONS}
            V[CELLS[s]] = worth[policy[s]] if policy else max(worth.values())
    return [V[cell] for cell in CELLS]


class Transcript(gym.Wrapper):
    """Keeps every transition (s, a, r, s', terminated)."""

    def __init__(self, env):
        super().__init__(env)
        self.transitions = []

    def reset(self, **kwargs):
        self.s, info = self.env.reset(**kwargs)
        return self.s, info

    def step(self, action):
        s, (self.s, r, terminated, truncated, info) = self.s, self.env.step(action)
        self.transitions.append((s, action, r, self.s, terminated))
        return self.s, r, terminated, truncated, info


def assert_refused(script, flags, folder, monkeypatch):
    """One line, exit code not 0, nothing written; tyro's own box (code 2) will do."""
    monkeypatch.chdir(folder)
    (folder / "file").touch()
    monkeypatch.setattr("sys.argv", ["", *flags])
    with pytest.raises(SystemExit) as stop:
        script.main()
    assert stop.value.code == 2 or "\n" not in stop.value.code
    assert [path.name for path in folder.iterdir()] == ["file"]
