"""What the tests of the two GridWorld scripts compare with: the world written down a second time, in fractions."""

from fractions import Fraction

import gymnasium as gym
import numpy as np
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

CELLS = [(1, 1), (2, 1), (3, 1), (4, 1), (1, 2), (3, 2), (4, 2), (1, 3), (2, 3), (3, 3), (4, 3)]
ACTIONS = ["left", "up", "right", "down"]
STEP = {"left": (-1, 0), "up": (0, 1), "right": (1, 0), "down": (0, -1)}
SIDES = {"left": ("up", "down"), "up": ("left", "right"), "right": ("up", "down"), "down": ("left", "right")}
PAID = {(4, 3): 1, (4, 2): -1}
DECIDING = [CELLS.index(cell) for cell in CELLS if cell not in PAID]
FIGURE_10 = {"(2,1)": "left", "(3,1)": "left", "(4,1)": "left", "(3,2)": "left"}  # what §5.2 says of the lost picture
OPTIMAL = FIGURE_10 | {"(1,1)": "up", "(1,2)": "up", "(1,3)": "right", "(2,3)": "right", "(3,3)": "right"}


def transitions(slip, step_reward):
    """{(cell, action): {(next cell, reward): probability}} in exact fractions."""
    slip, step_reward = Fraction(slip), Fraction(step_reward)
    result = {}
    for cell in CELLS:
        for action in ACTIONS:
            outcomes = {}
            for direction, probability in ((action, 1 - slip), *((side, slip / 2) for side in SIDES[action])):
                target = (cell[0] + STEP[direction][0], cell[1] + STEP[direction][1])
                target = target if target in CELLS else cell
                key = (target, PAID.get(target, step_reward))
                outcomes[key] = outcomes.get(key, 0) + probability
            result[cell, action] = outcomes
    return result


def optimal_table(slip, step_reward, discount):
    """Q* (11, 4) by sweeps over the dictionary above, one number at a time; rows of the terminals are 0."""
    Q = np.zeros((len(CELLS), len(ACTIONS)))
    model = {pair: [(float(p), CELLS.index(cell), cell in PAID, float(r)) for (cell, r), p in outcomes.items()]
             for pair, outcomes in transitions(slip, step_reward).items()}
    for _ in range(3000):
        previous = Q.copy()
        for s in DECIDING:
            for a, action in enumerate(ACTIONS):
                Q[s, a] = sum(p * (r + (0 if ended else discount * previous[n].max()))
                              for p, n, ended, r in model[CELLS[s], action])
        if np.abs(Q - previous).max() < 1e-14:
            break
    return Q


def policy_map(Q):
    """The greedy policy as rows of arrows, top to bottom, `*` for a terminal and `#` for the wall: ">>>*/^#<*/^<<<"."""
    arrows = {cell: "*" if cell in PAID else "<^>v"[Q[s].argmax()] for s, cell in enumerate(CELLS)}
    return "/".join("".join(arrows.get((x, y), "#") for x in range(1, 5)) for y in (3, 2, 1))


class Transcript(gym.Wrapper):
    """Keeps every transition (s, a, r, s', terminated) and how each episode began."""

    def __init__(self, env):
        super().__init__(env)
        self.transitions, self.seeds = [], []

    def reset(self, *, seed=None, options=None):
        self.seeds.append(seed)
        self.s, info = self.env.reset(seed=seed, options=options)
        return self.s, info

    def step(self, action):
        s_next, r, terminated, truncated, info = self.env.step(action)
        self.transitions.append((self.s, action, r, s_next, terminated))
        self.s = s_next
        return s_next, r, terminated, truncated, info


def run_main(script, monkeypatch, capsys, *flags):
    """Run a script's main in this process; returns exit code, standard output and standard error."""
    monkeypatch.setattr("sys.argv", [script.__name__, *map(str, flags)])
    code = 0
    try:
        script.main()
    except SystemExit as stop:
        code = stop.code
    return code, *capsys.readouterr()


def assert_refused(result, folder, *words):
    """One line on standard error that says `words`, exit code 2, nothing printed, nothing written."""
    code, out, err = result
    assert code == 2, err
    assert out == "" and err.count("\n") == 1 and err.startswith("error: "), err
    for word in words:
        assert word in err, err
    assert not list(folder.iterdir())


def scalars(folder):
    """{tag: [(step, value), …]} of the TensorBoard events in a run's folder."""
    events = EventAccumulator(str(folder)).Reload()
    return {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
