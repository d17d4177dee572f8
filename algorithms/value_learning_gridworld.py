# /// script
# requires-python = ">=3.10"
# dependencies = [
#   "numpy>=2.0", "gymnasium>=1.3", "torch>=2.4", "tensorboard>=2.17", "tyro>=0.9", "tqdm>=4.66",
#   "matplotlib>=3.9",
# ]
# ///
"""Value learning: V of a fixed policy in GridWorld without its model (Table 1, fourth cell), TD(0).

The lecture names value learning in Table 1 and shows no algorithm. TD(0), temporal-difference
learning from a single step, is to policy evaluation (Algorithm 1) what Q-learning is to value
iteration. The sum over s' in Equation 3 is replaced by one sampled s', and the assignment by a
running average:

    V(s) = (1 - α) V(s) + α (r + γ V(s'))

Beside V as learnt stands V^π from the linear system of Equations 2 and 3: the evaluation uses the
model, the learner never does. World and rewards are those of tabular_q_gridworld.py.

Run it
    python algorithms/value_learning_gridworld.py                       # the policy of Figure 10
    python algorithms/value_learning_gridworld.py --no-exploring-starts # only cells met from (1,1)
    python algorithms/value_learning_gridworld.py --policy \
        "1,1=right 2,1=right 3,1=up 4,1=left 1,2=up 3,2=up 1,3=right 2,3=right 3,3=right"
    tensorboard --logdir runs

Measured, by the first command
    max |V - V^π| = 0.0206 in the 9 cells visited

Deviations from the lecture
    Starts        in a random cell by default: from (1,1) the policy hardly ever reaches (4,1).
    α             N(s)^-0.7, N(s) visits: with slips, V converges only if α falls.
    Discount      --discount, 1 by default as in Equation 3.
    Time limit    1,000 steps: a policy may never end.
"""

import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import tyro
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

# ---- Args ----------------------------------------------------------------------------------------


@dataclass
class Args:
    """TD(0) of a fixed policy. A step is an action; an episode runs from reset to end."""

    policy: str = "1,1=up 2,1=left 3,1=left 4,1=left 1,2=up 3,2=left 1,3=right 2,3=right 3,3=right"
    """the policy π to evaluate, an action for each cell (default: Figure 10)"""
    episodes: int = 20_000
    """episodes to learn from"""
    discount: float = 1.0
    """γ in [0, 1] (Equation 3 is undiscounted: 1)"""
    learning_rate: float = 1.0
    """α of a cell's first visit, in [0, 1]"""
    learning_rate_exponent: float = 0.7
    """ω in [0, 1] of α = learning_rate · N(s)^-ω, N(s) visits; 0: a constant α"""
    exploring_starts: bool = True
    """start each episode in a random cell; if not, in (1,1)"""

    slip_probability: float = 0.2
    """probability that a move slips, half to each side (0: Figure 3, left; in (3,2) the default
    policy then walks into the wall for ever, which is refused at discount 1)"""
    step_reward: float = -0.025
    """reward of every step that does not end the episode"""

    seed: int = 0
    """seed of the environment's and of the starts' random generators"""
    runs_dir: Path = Path("runs")
    """folder in which the run makes its own"""

    def __post_init__(self):
        for name in ("discount", "learning_rate", "learning_rate_exponent", "slip_probability"):
            if not 0 <= getattr(self, name) <= 1:
                raise SystemExit(f"error: {name} must be in [0, 1]")
        if self.episodes < 1 or self.seed < 0 or not np.isfinite(self.step_reward):
            raise SystemExit("error: needs episodes >= 1, seed >= 0 and a finite step_reward")


# ---- problem: GridWorld and a policy -------------------------------------------------------------


class GridWorld(gym.Env):
    """The robot's world (Figures 2, 3): cells (x, y), 4 wide and 3 high, a wall in (2,2).

    Observation: Discrete(11), an index into `cells`. Action: Discrete(4), an index into `actions`.
    A move slips to each of its two sides with slip_probability / 2; a move into the wall or out of
    bounds leaves the robot where it is. Entering (4,3) pays +1, (4,2) -1, and ends the episode; any
    other step pays step_reward. `reset(options={"cell": (3, 1)})` starts in (3,1), not in (1,1).
    The model is `P`, {s: {a: [(P(s'|s,a), s', R(s,a,s'), terminated), …]}}, Gymnasium's own format.
    """

    start, wall = (1, 1), (2, 2)

    def __init__(self, slip_probability: float = 0.2, step_reward: float = -0.025):
        self.terminals = {(4, 3): 1.0, (4, 2): -1.0}
        self.moves = {"left": (-1, 0), "up": (0, 1), "right": (1, 0), "down": (0, -1)}
        self.actions = list(self.moves)  # neighbours in this list are perpendicular
        self.cells = [(x, y) for y in (1, 2, 3) for x in (1, 2, 3, 4) if (x, y) != self.wall]
        self.observation_space = gym.spaces.Discrete(11)
        self.action_space = gym.spaces.Discrete(4)
        rules = (slip_probability / 2, step_reward)
        self.P = {s: {a: self.outcomes(s, a, *rules) for a in range(4)} for s in range(11)}

    def outcomes(self, s: int, a: int, slip: float, step_reward: float) -> list[tuple]:
        """What action `a` can lead to: [(P(s'|s,a), s', R(s,a,s'), terminated), …]. `slip` is the
        probability of each of the two sides."""
        x, y = self.cells[s]
        if (x, y) in self.terminals:
            return [(1.0, s, 0.0, True)]  # the episode is over
        outcomes = []
        for probability, direction in ((1 - 2 * slip, a), (slip, a - 1), (slip, a + 1)):
            dx, dy = self.moves[self.actions[direction % 4]]
            cell = (x + dx, y + dy)
            if cell not in self.cells:  # the wall, or out of bounds
                cell = (x, y)
            reward = self.terminals.get(cell, step_reward)
            outcomes.append((probability, self.cells.index(cell), reward, cell in self.terminals))
        return outcomes

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[int, dict]:
        super().reset(seed=seed)
        self.state = self.cells.index((options or {}).get("cell", self.start))
        return self.state, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict]:
        draw = self.np_random.random()  # uniform in [0, 1)
        for outcome in self.P[self.state][action]:
            draw -= outcome[0]
            if draw < 0:
                break  # if it never does, by rounding: the last outcome
        _, self.state, reward, terminated = outcome
        return self.state, reward, terminated, False, {}


def read_gridworld_policy(text: str, world: GridWorld) -> dict[int, int]:
    """The policy {s: a} in `text`, "1,1=up 2,1=left …". Raises SystemExit if it is not one."""
    cells = [cell for cell in world.cells if cell not in world.terminals]  # nobody acts there
    states = {f"{x},{y}": world.cells.index((x, y)) for x, y in cells}
    policy = dict(item.partition("=")[::2] for item in text.split())  # {cell: action}
    if set(policy) != set(states) or not set(policy.values()) <= set(world.actions):
        needed = f"one of {' '.join(world.actions)} for each of {' '.join(states)}"
        raise SystemExit(f"error: --policy needs {needed}, as in 1,1=up")
    return {s: world.actions.index(policy[cell]) for cell, s in states.items()}


# ---- algorithm: TD(0) ----------------------------------------------------------------------------


def value_learning(env: gym.Env, policy: dict, args: Args) -> Iterator[tuple[list, list]]:
    """TD(0) of `policy` {s: a}. Yields after each episode V and N (lists, S), the tables
    themselves, which the next episode changes."""
    # Easy to get wrong: with one seed for both, the numbers that choose the starts would be the
    # very numbers that make the robot slip. Hence two seeds from one.
    seeds = np.random.SeedSequence(args.seed).generate_state(2)  # (2,) uint32
    rng = np.random.default_rng(seeds[1])
    V = [0.0] * 11  # V(s); where s is terminal it stays 0 (Equation 2)
    N = [0] * 11  # N(s), visits
    cells = [env.unwrapped.cells[s] for s in policy] if args.exploring_starts else [(1, 1)]
    env.reset(seed=int(seeds[0]))
    for _ in range(args.episodes):
        s, _ = env.reset(options={"cell": cells[rng.integers(len(cells))]})
        done = False
        while not done:
            s_next, r, terminated, truncated, _ = env.step(policy[s])

            # y = r if s' is terminal, else r + γ V(s')                  Equation 3, from one sample
            # Easy to get wrong: not r alone where a time limit cut the episode short (truncated):
            # there the world would have gone on.
            y = r if terminated else r + args.discount * V[s_next]
            N[s] += 1
            # α = learning_rate · N(s)^-ω
            alpha = args.learning_rate * N[s] ** -args.learning_rate_exponent
            # V(s) = (1 - α) V(s) + α y
            V[s] = (1 - alpha) * V[s] + alpha * y

            s, done = s_next, terminated or truncated
        yield V, N


# ---- evaluation: V^π by the linear system (§3.1) -------------------------------------------------


def exact_values(world: GridWorld, policy: dict[int, int], discount: float) -> np.ndarray:
    """V^π (S,) float64 of Equations 2 and 3. Raises SystemExit at discount 1 if π may never end."""
    # P(s'|s,π(s)) (S, S) of the steps that do not end the episode, and the expected reward (S,)
    P, R = np.zeros((11, 11)), np.zeros(11)
    for s, a in policy.items():
        for probability, s_next, r, terminated in world.P[s][a]:
            R[s] += probability * r
            P[s, s_next] += 0 if terminated else probability
    ends = P.sum(axis=1) < 1 - 1e-9  # (S,) bool: the episode may end with the next step
    for _ in world.cells:
        ends |= P @ ends > 1e-9  # or a step later; the longest way has as many steps as cells
    if discount == 1 and not ends.all():
        raise SystemExit("error: at discount 1 the policy has no value: it may never end")
    # V^π(s) = Σ_s' P(s'|s,π(s)) [R(s,π(s),s') + γ V^π(s')], that is (I - γP) V = R    Equations 2-3
    return np.linalg.solve(np.eye(11) - discount * P, R)


# ---- report --------------------------------------------------------------------------------------


def grid_text(world: GridWorld, contents: dict) -> str:
    """The world as text; contents[x, y] are the three lines of cell (x, y)."""
    rewards = {cell: ["", f"{reward:+g}", ""] for cell, reward in world.terminals.items()}
    contents = {**contents, **rewards, world.wall: ["#" * 15] * 3}
    border = "    +" + "---------------+" * 4
    lines = [border]
    for y in (3, 2, 1):
        for i, label in enumerate(["   ", f"y={y}", "   "]):
            row = [f"{contents[x, y][i]:^15}" for x in (1, 2, 3, 4)]
            lines.append(f"{label} |{'|'.join(row)}|")
        lines.append(border)
    lines.append("    " + "".join(f"{f'x={x}':^16}" for x in (1, 2, 3, 4)))
    return "\n".join(lines)


def draw_values(axes: Axes, world: GridWorld, V: np.ndarray, policy: dict, title: str) -> None:
    """V (S,) as colours and numbers, and the policy {s: a} as arrows."""
    scale = 3.2 * max(1, np.nanmax(np.abs(V)))  # 3.2: colours stay pale enough for black text
    for s, (x, y) in enumerate(world.cells):
        if s in policy:
            value, text = V[s], "←↑→↓"[policy[s]]
            axes.text(x, y - 0.3, f"{value:.3f}", fontsize=11, ha="center")
        else:  # an end
            value, text = world.terminals[x, y], f"{world.terminals[x, y]:+g}"
        colour = colormaps["RdBu"](0.5 + value / scale)  # red < 0 < blue
        axes.bar(x, 1, 1, y - 0.5, color=colour, edgecolor="0.5", linewidth=0.6)  # a square
        axes.text(x, y, text, fontsize=24, weight="bold", ha="center", va="center")
    axes.set(xticks=[1, 2, 3, 4], yticks=[1, 2, 3], aspect="equal", facecolor="0.8", title=title)


# ---- main ----------------------------------------------------------------------------------------


def main() -> None:
    """Learn V of the policy, compare it with V^π, report."""
    args = tyro.cli(Args)
    world = GridWorld(args.slip_probability, args.step_reward)
    policy = read_gridworld_policy(args.policy, world)
    V_pi = exact_values(world, policy, args.discount)  # (S,)
    name = f"GridWorld__value_learning_gridworld__{args.seed}"
    run_dir = args.runs_dir / f"{name}__{time.strftime('%Y%m%d-%H%M%S')}"
    try:
        run_dir.mkdir(parents=True)
    except OSError as error:  # a file in the way, or another run of this second
        raise SystemExit(f"error: {error}") from None
    (run_dir / "args.json").write_text(json.dumps(vars(args), default=str), encoding="utf-8")

    curve = []
    with SummaryWriter(str(run_dir)) as writer:
        learner = value_learning(gym.wrappers.TimeLimit(world, 1000), policy, args)
        learner = tqdm(learner, total=args.episodes, delay=2, leave=False)
        for episode, (V, N) in enumerate(learner, start=1):
            if episode % max(1, args.episodes // 200) == 0 or episode == args.episodes:
                error = np.abs(V - V_pi)[np.array(N) > 0].max()  # where it has been
                writer.add_scalar("max |V - V^pi|", error, episode)
                curve.append((episode, error))

    V, contents, result = np.where(N, V, np.nan), {}, {}  # V: (S,), NaN of cells never visited
    for s, a in policy.items():
        contents[world.cells[s]] = ["←↑→↓"[a], f"V   {V[s]:7.3f}", f"V^π {V_pi[s]:7.3f}"]
        learnt = {"V": V[s] if N[s] else None, "V^π": V_pi[s]}
        result[str(world.cells[s])] = {"action": world.actions[a], **learnt}
    print(f"V after {sum(N):,} steps, V^π by the linear system:\n{grid_text(world, contents)}\n")
    print(f"max |V - V^π| = {error:.4f} in the {np.count_nonzero(N)} cells visited")
    (run_dir / "values.json").write_text(json.dumps(result, indent=1), encoding="utf-8")

    figure = Figure(figsize=(18, 4.7), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    draw_values(left, world, V, policy, "V as learnt")
    draw_values(middle, world, V_pi, policy, "V^π from the linear system")
    right.plot(*zip(*curve, strict=True))
    right.set(xlabel="episode", ylabel="max |V - V^π|", title="Along training")
    figure.savefig(run_dir / "figure.png", dpi=100)
    print(f"written to {run_dir}")


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")
    main()
