# /// script
# requires-python = ">=3.10"
# dependencies = [
#   "numpy>=2.0", "gymnasium>=1.3", "torch>=2.4", "tensorboard>=2.17", "tyro>=0.9", "tqdm>=4.66",
#   "matplotlib>=3.9",
# ]
# ///
"""Tabular Q-learning: a robot learns GridWorld without its model (§5.2, Algorithm 5, Eq. 34-37).

It prints and draws Figure 9, the Q-values of each cell, and Figure 10, the policy. Beside them is
Q* by value iteration (§4.3): the evaluation uses the model, the learner never does.

Run it
    python algorithms/tabular_q_gridworld.py                       # 1,000 episodes: Figure 9
    python algorithms/tabular_q_gridworld.py --episodes 200000     # until the policy is Figure 10's
    python algorithms/tabular_q_gridworld.py --learning-rate 1 --learning-rate-exponent 0.7
    python algorithms/tabular_q_gridworld.py --step-reward -0.5    # a hurried robot risks the -1
    python algorithms/tabular_q_gridworld.py --slip-probability 0  # Figure 3, left
    python algorithms/tabular_q_gridworld.py --env-id CliffWalking-v1 --learning-rate-exponent 0
    python algorithms/tabular_q_gridworld.py --env-id FrozenLake-v1 --env-kwargs is_slippery=False
    tensorboard --logdir runs

Measured, by `python benchmarks/gridworld.py seeds`
    200,000 episodes: Figure 10's policy for 20 of 20 seeds, with max |Q - Q*| from 0.006 to 0.028.

Deviations from the lecture
    Rewards       ±1 in the marked cells, slip 0.2: the lecture's text has no numbers. In it only
                  those cells pay. Here a step costs 0.025, since without a discount Figure 10 is
                  optimal only for step rewards from -0.0274 to -0.0221, as
                  `python benchmarks/gridworld.py step-rewards` shows.
    Stopping      after --episodes: from samples one cannot tell whether Q has converged.
    α             0.7 · N(s,a)^-0.85, N(s,a) visits: with slips, Q converges only if α falls.
    ε             falls with each episode, from 1 to 0.7. A greedier robot hardly ever sees (4,1);
                  and Q-learning learns Q* from any behaviour that keeps trying every action in
                  every state (it is off-policy).
    Discount      --discount, 1 by default as in Equation 34: other environments need one.
    Time limit    1,000 steps, where the environment has none: a policy may never end.
    Figure 9      its 1000 interactions are taken as episodes: 1,000 steps are only about 30.
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
    """Tabular Q-learning (Algorithm 5). A step is an action; an episode runs from reset to end.
    Q(s,a) is the expected sum of rewards from state s on, if the first action is a."""

    episodes: int = 1000
    """episodes to learn from (Figure 9: 1000 interactions)"""
    discount: float = 1.0
    """γ in [0, 1] (Equation 34 is undiscounted: 1)"""
    learning_rate: float = 0.7
    """α of the first visit of (s, a), in [0, 1] (Equation 34: not 0)"""
    learning_rate_exponent: float = 0.85
    """ω in [0, 1] of α = learning_rate · N(s,a)^-ω, N(s,a) visits; 0: a constant α"""
    epsilon_initial: float = 1.0
    """ε_initial in [0, 1], probability of a random action in the first episode (line 1)"""
    epsilon_final: float = 0.7
    """ε_final in [0, 1], the same in the last episode (line 10)"""

    slip_probability: float = 0.2
    """GridWorld: probability that a move slips, half to each side (0: Figure 3, left)"""
    step_reward: float = -0.025
    """GridWorld: reward of every step that does not end the episode"""
    env_id: str = "GridWorld"
    """or a Gymnasium environment with Discrete observations and actions"""
    env_kwargs: str = ""
    """arguments of --env-id, such as "map_name=8x8 is_slippery=False"; not of GridWorld"""

    seed: int = 0
    """seed of the environment's and of the exploration's random generators"""
    runs_dir: Path = Path("runs")
    """folder in which the run makes its own"""

    def __post_init__(self):
        for name in ("discount", "learning_rate", "learning_rate_exponent", "epsilon_initial",
                     "epsilon_final", "slip_probability"):
            if not 0 <= getattr(self, name) <= 1:
                raise SystemExit(f"error: {name} must be in [0, 1]")
        if self.episodes < 1 or self.seed < 0 or not np.isfinite(self.step_reward):
            raise SystemExit("error: needs episodes >= 1, seed >= 0 and a finite step_reward")


# ---- problem: GridWorld --------------------------------------------------------------------------


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


def make_world(args: Args) -> gym.Env:
    """GridWorld, or the environment of --env-id, with a time limit. Raises SystemExit, one line."""
    if args.env_id == "GridWorld":
        return gym.wrappers.TimeLimit(GridWorld(args.slip_probability, args.step_reward), 1000)
    try:
        items = (item.split("=") for item in args.env_kwargs.split())
        kwargs = {k: {"true": True, "false": False}.get(v.lower(), v) for k, v in items}
        env = gym.make(args.env_id, disable_env_checker=True, **kwargs)  # it costs time in step()
    except Exception as error:  # whatever the constructor of somebody's environment raises
        raise SystemExit(f"error: cannot make {args.env_id}: {error}") from None
    for space in (env.observation_space, env.action_space):
        if not isinstance(space, gym.spaces.Discrete) or space.start != 0:
            raise SystemExit(f"error: a table needs spaces Discrete(n), {args.env_id} has {space}")
    return env if env.spec.max_episode_steps else gym.wrappers.TimeLimit(env, 1000)


# ---- algorithm: tabular Q-learning (Algorithm 5) -------------------------------------------------


def tabular_q_learning(env: gym.Env, args: Args) -> Iterator[tuple[list, list, float]]:
    """Algorithm 5. Yields after each episode: Q and N (lists, S x A), and the episode's return.

    Q and N are the tables themselves, which the next episode changes.
    """
    # Easy to get wrong: with one seed for both, the numbers that decide on exploration would be
    # the very numbers that make the robot slip. Hence two seeds from one.
    seeds = np.random.SeedSequence(args.seed).generate_state(2)  # (2,) uint32
    random = np.random.default_rng(seeds[1]).random  # a function: a number in [0, 1)
    S, A = int(env.observation_space.n), int(env.action_space.n)
    Q = [[0.0] * A for _ in range(S)]  # lines 2-6; Python reads lists faster than arrays
    N = [[0] * A for _ in range(S)]  # N(s,a), visits
    env.reset(seed=int(seeds[0]))
    # A number of episodes, not until Q has converged (line 7). One ε for each, falling linearly
    # from ε_initial to ε_final                                                     # lines 1, 10-12
    for epsilon in np.linspace(args.epsilon_initial, args.epsilon_final, args.episodes).tolist():
        s, _ = env.reset()
        total_reward, done = 0.0, False
        while not done:
            # With probability ε a random action, else π(s) = argmax_a Q(s,a)            # lines 8-9
            if random() < epsilon:
                a = int(random() * A)
            else:
                best = max(Q[s])
                ties = [a for a in range(A) if Q[s][a] == best]  # at the start all actions
                a = ties[int(random() * len(ties))]
            s_next, r, terminated, truncated, _ = env.step(a)

            # y = r if s' is terminal, else r + γ max_a' Q(s',a')   (Equations 36, 37)
            # Easy to get wrong: not r alone where a time limit cut the episode short (truncated):
            # there the world would have gone on.
            y = r if terminated else r + args.discount * max(Q[s_next])
            N[s][a] += 1
            # α = learning_rate · N(s,a)^-ω
            alpha = args.learning_rate * N[s][a] ** -args.learning_rate_exponent
            # Q(s,a) = (1 - α) Q(s,a) + α y                                   # line 13, Equation 34
            Q[s][a] = (1 - alpha) * Q[s][a] + alpha * y

            s, done = s_next, terminated or truncated
            total_reward += r
        yield Q, N, total_reward


# ---- evaluation: Q* by value iteration (§4.3) ----------------------------------------------------


def optimal_action_values(model: dict, discount: float) -> np.ndarray:
    """Q* (S, A) float64 by value iteration on a model such as GridWorld's `P`.

    Raises SystemExit if it does not converge, as when reward can be collected for ever.
    """
    Q = np.zeros((len(model), len(model[0])))  # (S, A)
    for _ in tqdm(range(100_000), "value iteration", unit=" sweeps", delay=2, leave=False):
        V = Q.max(axis=1)  # (S,)
        for s, choices in model.items():
            for a, outcomes in choices.items():
                # Q*(s,a) = Σ_s' P(s'|s,a) [R(s,a,s') + γ max_a' Q*(s',a')]           Equation 30
                Q[s, a] = 0.0
                for probability, s_next, r, terminated in outcomes:
                    Q[s, a] += probability * (r if terminated else r + discount * V[s_next])
        if np.allclose(Q.max(axis=1), V, rtol=1e-12, atol=1e-12):
            return Q
    raise SystemExit("error: no Q* after 100,000 sweeps. If it is infinite, lower --discount")


def greedy(Q: np.ndarray) -> np.ndarray:
    """The actions (S, A) bool that are best in their state, ties included (Equations 31, 35)."""
    return Q > Q.max(axis=1, keepdims=True) - 1e-9


# ---- report --------------------------------------------------------------------------------------


def arrows(chosen: np.ndarray) -> str:
    """The arrows of the actions `chosen` (4,) bool, in the order of GridWorld.moves."""
    return "".join(arrow for arrow, best in zip("←↑→↓", chosen, strict=True) if best)


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


def action_values_text(world: GridWorld, Q: np.ndarray) -> str:
    """Figures 9 and 10 as text: Q (S, A), each value on its action's side, and the policy."""
    contents = {}
    for cell, values, best in zip(world.cells, Q, greedy(Q), strict=True):
        left, up, right, down = (f"{value:.3f}" for value in values)
        contents[cell] = [up, f"{left} {arrows(best)} {right}", down]
    return grid_text(world, contents)


def draw_action_values(axes: Axes, world: GridWorld, Q: np.ndarray, title: str) -> None:
    """Figures 9 and 10: Q (S, A) in four coloured triangles a cell, and the policy as arrows."""
    scale = 3.2 * max(1, np.abs(Q).max())  # 3.2: colours stay pale enough for black text
    centred = dict(ha="center", va="center")
    for (x, y), values, best in zip(world.cells, Q, greedy(Q), strict=True):
        axes.text(x, y, arrows(best), fontsize=20 / best.sum(), weight="bold", **centred)
        for value, (dx, dy) in zip(values, world.moves.values(), strict=True):
            # a triangle: the cell's middle and two corners, for "right" (1/2, ±1/2) from there
            corners_x = [x, x + (dx - dy) / 2, x + (dx + dy) / 2]
            corners_y = [y, y + (dy + dx) / 2, y + (dy - dx) / 2]
            colour = colormaps["RdBu"](0.5 + value / scale)  # red < 0 < blue
            axes.fill(corners_x, corners_y, facecolor=colour, edgecolor="0.5", linewidth=0.6)
            axes.text(x + 0.32 * dx, y + 0.38 * dy, f"{value:.3f}", fontsize=8.5, **centred)
    for (x, y), reward in world.terminals.items():  # they cover the triangles of their cells
        colour = colormaps["RdBu"](0.5 + reward / scale)
        axes.bar(x, 1, 1, y - 0.5, color=colour, edgecolor="0.5", linewidth=0.6, zorder=4)  # square
        axes.text(x, y, f"{reward:+g}", fontsize=24, weight="bold", zorder=5, **centred)
    axes.set(xticks=[1, 2, 3, 4], yticks=[1, 2, 3], aspect="equal", facecolor="0.8", title=title)


# ---- main ----------------------------------------------------------------------------------------


def main() -> None:
    """Learn, compare with Q* where there is a model, report."""
    args = tyro.cli(Args)
    env = make_world(args)
    world = env.unwrapped
    model = getattr(world, "P", None)  # for the evaluation; the learner never reads it
    if model is not None:
        Q_star = optimal_action_values(model, args.discount)  # (S, A)
    name = f"{args.env_id.replace('/', '-')}__tabular_q_gridworld__{args.seed}"
    run_dir = args.runs_dir / f"{name}__{time.strftime('%Y%m%d-%H%M%S')}"
    try:
        run_dir.mkdir(parents=True)
    except OSError as error:  # a file in the way, or another run of this second
        raise SystemExit(f"error: {error}") from None
    (run_dir / "args.json").write_text(json.dumps(vars(args), default=str), encoding="utf-8")

    returns, curve = [], []
    with SummaryWriter(str(run_dir)) as writer:
        learner = tqdm(tabular_q_learning(env, args), total=args.episodes, delay=2, leave=False)
        for episode, (Q, N, total_reward) in enumerate(learner, start=1):
            returns.append(total_reward)
            if episode % max(1, args.episodes // 200) == 0 or episode == args.episodes:
                # what the curve shows: the return, or where there is a model the distance to Q*
                label, score = "mean return", np.mean(returns[-100:])
                writer.add_scalar(label, score, episode)
                if model is not None:
                    label, score = "max |Q - Q*|", np.abs(Q - Q_star)[np.any(N, axis=1)].max()
                    writer.add_scalar(label, score, episode)
                curve.append((episode, score))

    Q, visited = np.array(Q), np.any(N, axis=1)  # (S, A) and (S,)
    names, actions = range(len(Q)), range(len(Q[0]))
    if isinstance(world, GridWorld):
        names, actions = world.cells, world.actions
    tables = {f"Q after {episode:,} episodes": Q}
    if model is not None:
        tables["Q* by value iteration"] = Q_star
    figure = Figure(figsize=(6.5 * len(tables) + 5, 4.7), layout="constrained")
    *panels, last = figure.subplots(1, len(tables) + 1)
    for axes, (title, table) in zip(panels, tables.items(), strict=True):
        if isinstance(world, GridWorld):
            print(f"{title}, and its policy:\n{action_values_text(world, table)}\n")
            draw_action_values(axes, world, table, title)
        else:
            # white: states never visited
            figure.colorbar(axes.imshow(np.where(visited[:, None], table, np.nan), aspect="auto"))
            axes.set(xlabel="action", ylabel="state", title=title)
    last.plot(*zip(*curve, strict=True))
    last.set(xlabel="episode", ylabel=label, title="Along training")
    figure.savefig(run_dir / "figure.png", dpi=100)

    if model is not None:
        # Every action best in Q is best in Q*. (At discount 1 so is a detour that costs nothing.)
        optimal = (greedy(Q) <= greedy(Q_star)).all(axis=1)[visited].sum()
        print(f"{label} = {score:.4f}, optimal in {optimal} of {visited.sum()} states visited")
    score = np.mean(returns[-100:])
    print(f"{np.sum(N):,} steps; mean return of the last 100 episodes {score:.4g}, while exploring")
    result = {"action_values": {}, "policy": {}}
    for s in np.flatnonzero(visited):
        result["action_values"][str(names[s])] = dict(zip(map(str, actions), Q[s], strict=True))
        result["policy"][str(names[s])] = str(actions[Q[s].argmax()])
    (run_dir / "q_table.json").write_text(json.dumps(result, indent=1), encoding="utf-8")
    print(f"written to {run_dir}")


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")
    main()
