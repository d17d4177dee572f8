# /// script
# requires-python = ">=3.10"
# dependencies = [
#   "numpy>=2.0", "scipy>=1.14", "gymnasium>=1.0", "torch>=2.4", "tensorboard>=2.17", "tyro>=0.9", "tqdm>=4.66",
#   "matplotlib>=3.9",
# ]
# ///
r"""Value learning: the value of a fixed policy in GridWorld, without its model (Table 1, "unknown MDP, evaluate π").

The lecture names value learning in Table 1 and shows no algorithm. It is TD(0). What Q-learning (Algorithm 5,
Equation 34) is to value iteration, this is to policy evaluation (Algorithm 1, Equation 3): the sum over s' is replaced
by the one s' that came, and the assignment by a running average,

    V(s) = (1 - α) V(s) + α (r + γ V(s')).

V as learnt stands beside V^π from the linear system of Equations 2 and 3, for here the model is known, though not to
the learner. World and default rewards are those of tabular_q_gridworld.py, whose docstring says where they come from.

Run it
    python algorithms/value_learning_gridworld.py                            # the optimal policy, which is Figure 10's
    python algorithms/value_learning_gridworld.py --no-exploring-starts      # V only where episodes from (1,1) go
    python algorithms/value_learning_gridworld.py \
        --policy "1,1=right 2,1=right 3,1=up 4,1=left 1,2=up 3,2=up 1,3=right 2,3=right 3,3=right"    # past the -1
    tensorboard --logdir runs

Measured
    With the default 20,000 episodes and seed 0: max |V - V^π| = 0.0206 over the nine cells.

Deviations
    The lecture says                      this file does                        why
    ------------------------------------  ------------------------------------  ---------------------------------------
    no algorithm                          TD(0)                                 its update is Equation 34 with π for max
    every episode starts in (1,1)         in a random cell, by default          the optimal policy never gets to (4,1):
                                                                                V there would not be learnt
    no discount                           --discount, 1 by default              as in the other scripts
    no word on time limits                1,000 steps cut an episode short      a policy may never end; the target still
                                                                                looks ahead, for the world does go on
    no word on α                          N(s)^-0.7, N(s) visits of the cell    a constant α (exponent 0) never settles
"""

import contextlib
import dataclasses
import inspect
import io
import itertools
import json
import math
import re
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple, NoReturn, TypeVar

import gymnasium as gym
import numpy as np
import tyro
from gymnasium.wrappers import TimeLimit
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import CenteredNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy import sparse
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

Flags = TypeVar("Flags")

# ---- Args ----------------------------------------------------------------------------------------


@dataclass
class Args:
    """Counts of steps are actions of the agent, counts of episodes run from a reset to an end."""

    policy: str = ""
    """the policy to evaluate, an action for each cell, as in "1,1=up 2,1=left …" (default: the optimal one)"""
    episodes: int = 20_000
    """episodes to learn from"""
    discount: float = 1.0
    """γ in [0, 1], weight of a reward one step later (Equation 3 is undiscounted: 1)"""
    learning_rate: float = 1.0
    """α of a cell's first visit, in (0, 1]"""
    learning_rate_exponent: float = 0.7
    """ω in [0, 1] of α = learning_rate · N(s)^-ω, where N(s) counts the visits of the cell; 0 keeps α constant"""
    exploring_starts: bool = True
    """start each episode in a random cell, so that V is learnt also where the policy never goes; if not, in (1,1)"""

    slip_probability: float = 0.2
    """chance that a move goes astray, half to each perpendicular side (0: Figure 3, left)"""
    step_reward: float = -0.025
    """reward of every transition that does not end the episode"""
    max_episode_steps: int = 1000
    """steps after which an episode is cut short"""

    seed: int = 0
    """seed of the environment's and of the starts' random generators"""
    runs_dir: Path = Path("runs")
    """a folder for this run is made here: args.json, TensorBoard events, and the two files below"""
    output_json: Path | None = None
    """where to write V, V^π and the policy (default: values.json in the run's folder)"""
    figure: Path | None = None
    """where to draw V, V^π and the error, .png, .pdf or .svg (default: figure.png in the run's folder)"""


def fail(message: str) -> NoReturn:
    """Bad input: one line on standard error, exit code 2."""
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2)


def parse_args(args_class: type[Flags]) -> Flags:
    """Read the command line; a flag that cannot be read ends in one line and exit code 2, not in tyro's box."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a Windows console or pipe may not know π
            stream.reconfigure(encoding="utf-8", errors="backslashreplace")
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            return tyro.cli(args_class, description=f"{__doc__}\n{inspect.getdoc(args_class)}")
    except SystemExit as stop:
        if stop.code != 2:
            raise
        lines = [line.strip("│ ") for line in box.getvalue().splitlines()[1:]]
        fail(" ".join(itertools.takewhile(lambda line: not line.startswith(("─", "╰")), lines)) + " (see --help)")


def check_outputs(output_json: Path | None, figure: Path | None) -> None:
    """Raises ValueError where a file could not be written, before an hour of work finds it out."""
    for path in filter(None, (output_json, figure)):
        if path.is_dir() or not path.absolute().parent.is_dir():
            raise ValueError(f"cannot write {path}: it is a folder, or in none")
    if figure and figure.suffix not in (".png", ".pdf", ".svg"):
        raise ValueError(f"--figure {figure}: the name must end in .png, .pdf or .svg")


def check_evaluation(args: Args) -> None:
    """Raises ValueError for a flag outside its range; NaN is outside every range."""
    for name, inside, allowed in (
        ("episodes", args.episodes >= 1, "at least 1"),
        ("discount", 0 <= args.discount <= 1, "in [0, 1]"),
        ("learning-rate", 0 < args.learning_rate <= 1, "in (0, 1]"),
        ("learning-rate-exponent", 0 <= args.learning_rate_exponent <= 1, "in [0, 1]"),
        ("max-episode-steps", args.max_episode_steps >= 1, "at least 1"),
        ("seed", args.seed >= 0, "at least 0"),
    ):
        if not inside:
            raise ValueError(f"{name} must be {allowed}, not {getattr(args, name.replace('-', '_'))}")
    if not args.policy and args.discount == 1 and args.step_reward > 0:
        raise ValueError(f"step-reward {args.step_reward} > 0, discount 1: never to end is best, no policy is optimal")


# ---- problem -------------------------------------------------------------------------------------


class GridWorld(gym.Env):
    """The robot's world of Figures 2 and 3: cells (x, y), 4 wide and 3 high, a wall in (2,2), the start in (1,1).

    Observation: Discrete(11), the index in `cells` of the robot's cell. Action: Discrete(4), an index in `actions`.
    A move goes where it should with probability 1 - slip_probability, and to each of the two perpendicular sides with
    slip_probability / 2 (0: the deterministic world of Figure 3); a move into the wall or out of bounds stays.
    Entering (4,3) pays +1, entering (4,2) pays -1, and both terminate; every other transition pays `step_reward`.

    `reset(options={"cell": (3, 1)})` starts from another cell. The model is there as in Gymnasium's own toy worlds:
    `P`, {s: {a: [(P(s'|s,a), s', R(s,a,s'), terminated), …]}}, and `initial_state_distrib`; a learner reads neither.
    Raises ValueError for a slip probability outside [0, 1], a step reward that is not finite, a wrong mode or cell.
    """

    metadata: ClassVar = {"render_modes": ["ansi", "rgb_array"], "render_fps": 4}
    width, height, start, wall = 4, 3, (1, 1), (2, 2)
    terminals: ClassVar = {(4, 3): 1.0, (4, 2): -1.0}
    moves: ClassVar = {"left": (-1, 0), "up": (0, 1), "right": (1, 0), "down": (0, -1)}  # neighbours are perpendicular

    def __init__(self, slip_probability: float = 0.2, step_reward: float = -0.025, render_mode: str | None = None):
        if not 0 <= slip_probability <= 1:
            raise ValueError(f"slip-probability must be in [0, 1], not {slip_probability}")
        if not math.isfinite(step_reward):
            raise ValueError(f"step-reward must be a finite number, not {step_reward}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be one of {self.metadata['render_modes']}, not {render_mode!r}")
        grid = itertools.product(range(1, self.height + 1), range(1, self.width + 1))
        self.cells = [(x, y) for y, x in grid if (x, y) != self.wall]
        self.actions = list(self.moves)
        self.observation_space = gym.spaces.Discrete(len(self.cells))
        self.action_space = gym.spaces.Discrete(len(self.actions))
        self.slip_probability, self.step_reward, self.render_mode = slip_probability, step_reward, render_mode
        self.P = {s: {a: self.outcomes(s, a) for a in range(len(self.actions))} for s in range(len(self.cells))}
        self.initial_state_distrib = np.eye(len(self.cells))[self.cells.index(self.start)]  # (S,)
        self.state = self.cells.index(self.start)

    def outcomes(self, s: int, a: int) -> list[tuple[float, int, float, bool]]:
        """What action `a` in state `s` can lead to: (P(s'|s,a), s', R(s,a,s'), terminated), of positive probability."""
        if self.cells[s] in self.terminals:
            return [(1.0, s, 0.0, True)]  # the episode is over: nothing moves, nothing is paid
        outcomes = []
        slip = self.slip_probability / 2
        for probability, direction in ((1 - self.slip_probability, a), (slip, a - 1), (slip, a + 1)):
            x, y = self.cells[s]
            dx, dy = self.moves[self.actions[direction % len(self.actions)]]
            cell = (x + dx, y + dy) if (x + dx, y + dy) in self.cells else (x, y)  # wall and bounds: stays
            reward = self.terminals.get(cell, self.step_reward)
            outcomes.append((probability, self.cells.index(cell), reward, cell in self.terminals))
        return [outcome for outcome in outcomes if outcome[0] > 0]

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[int, dict]:
        super().reset(seed=seed)
        cell = tuple((options or {}).get("cell", self.start))
        if cell not in self.cells or cell in self.terminals:
            raise ValueError(f"the robot cannot start in {cell}")
        self.state = self.cells.index(cell)
        return self.state, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict]:
        draw = self.np_random.random()  # uniform in [0, 1)
        for outcome in self.P[self.state][action]:
            draw -= outcome[0]
            if draw < 0:
                break
        _, self.state, reward, terminated = outcome
        return self.state, reward, terminated, False, {}

    def render(self) -> str | np.ndarray | None:
        """The world and the robot, as text ("ansi") or as an image (300, 400, 3) uint8 ("rgb_array")."""
        robot = self.cells[self.state]
        if self.render_mode == "ansi":
            return format_cells(self, {robot: ["robot"]}, width=7)
        if self.render_mode == "rgb_array":
            figure = Figure(figsize=(self.width, self.height), dpi=100)
            axes = figure.add_axes((0, 0, 1, 1))
            draw_world(axes, self)
            axes.plot(*robot, "o", markersize=40, color="tab:blue")
            canvas = FigureCanvasAgg(figure)
            canvas.draw()
            return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # (300, 400, 3) uint8
        return None


def format_cells(world: GridWorld, contents: dict[tuple[int, int], list[str]], width: int) -> str:
    """The world as text; `contents[x, y]` are the lines in cell (x, y), the wall and the terminals draw themselves."""
    lines = max(map(len, contents.values()))
    signs = {cell: [f"{reward:+g}"] for cell, reward in world.terminals.items()}
    contents = {world.wall: ["#" * width] * lines, **signs, **contents}
    border = "    +" + f"{'-' * width}+" * world.width
    text = [border]
    for y in range(world.height, 0, -1):
        row = [contents.get((x, y), []) for x in range(1, world.width + 1)]
        row = [[""] * ((lines - len(cell)) // 2) + cell + [""] * lines for cell in row]  # centred
        for i in range(lines):
            label = f"y={y}" if i == lines // 2 else ""
            text.append(f"{label:>3} |" + "".join(f"{cell[i]:^{width}}|" for cell in row))
        text.append(border)
    return "\n".join([*text, "     " + " ".join(f"{f'x={x}':^{width}}" for x in range(1, world.width + 1)).rstrip()])


def draw_world(axes: Axes, world: GridWorld) -> None:
    """Draw the cells, the wall (hatched) and the terminals with their rewards; cell (x, y) is centred on (x, y)."""
    for x, y in itertools.product(range(1, world.width + 1), range(1, world.height + 1)):
        wall, terminal = (x, y) == world.wall, (x, y) in world.terminals
        style = dict(facecolor="0.75", hatch="///") if wall else dict(facecolor="0.9" if terminal else "none")
        axes.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, edgecolor="black", linewidth=1.5, **style))
        if terminal:
            axes.text(x, y, f"{world.terminals[x, y]:+g}", ha="center", va="center", fontsize=20, fontweight="bold")
    axes.set(xlim=(0.45, world.width + 0.55), ylim=(0.45, world.height + 0.55), aspect="equal")
    axes.set(xticks=range(1, world.width + 1), yticks=range(1, world.height + 1), xlabel="x", ylabel="y")
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)


def read_policy(text: str, world: GridWorld) -> np.ndarray:
    """The policy (S,) int64 in `text`, "1,1=up 2,1=left …", one action for each cell; 0 in terminals.

    Raises ValueError for what is no cell or action, for a cell named twice, and for cells without an action.
    """
    chosen = {}
    for item in text.split():
        match = re.fullmatch(r"\(?(\d+),(\d+)\)?=(\w+)", item)
        if not match:
            raise ValueError(f"--policy: {item!r} is not x,y=action, as in 1,1=up")
        cell, action = (int(match[1]), int(match[2])), match[3]
        if cell not in world.cells or cell in world.terminals:
            raise ValueError(f"--policy: nobody acts in ({cell[0]},{cell[1]})")
        if action not in world.moves:
            raise ValueError(f"--policy: {action!r} in ({cell[0]},{cell[1]}) is not one of {', '.join(world.moves)}")
        if cell in chosen:
            raise ValueError(f"--policy: ({cell[0]},{cell[1]}) is named twice")
        chosen[cell] = world.actions.index(action)
    missing = [f"({x},{y})" for x, y in world.cells if (x, y) not in world.terminals and (x, y) not in chosen]
    if missing:
        raise ValueError(f"--policy: no action for {', '.join(missing)}")
    return np.array([chosen.get(cell, 0) for cell in world.cells])  # (S,)


# ---- algorithm -----------------------------------------------------------------------------------


class Estimate(NamedTuple):
    """What is known of V after an episode; the return is the mean over the episodes since the last estimate."""

    episode: int
    steps: int
    V: np.ndarray  # (S,) float64
    visits: np.ndarray  # (S,) int64
    mean_return: float


def value_learning(env: gym.Env, policy: np.ndarray, args: Args) -> Iterator[Estimate]:
    """TD(0), V^π of `policy` (S,) from samples; pauses after 100 episodes or fewer, evenly spaced in log scale.

    Same arguments, same V, bit for bit.
    """
    # Easy to get wrong: Gymnasium's generator is default_rng(seed), so starts drawn by default_rng(seed) would be drawn
    # with the very numbers that make the robot slip. Hence two seeds from one.
    environment_seed, start_seed = np.random.SeedSequence(args.seed).generate_state(2).tolist()
    starts = np.random.default_rng(start_seed)
    world, actions = env.unwrapped, policy.tolist()
    cells = [cell for cell in world.cells if cell not in world.terminals]
    V = [0.0 for _ in world.cells]  # V(s), and 0 for ever where s is terminal (Equation 2): no action is taken there
    N = [0 for _ in world.cells]  # N(s), visits
    pauses = set(np.geomspace(1, args.episodes, 100).round().astype(int).tolist())
    steps, total_reward, last_episode = 0, 0.0, 0
    for episode in tqdm(range(1, args.episodes + 1), desc="learning", unit=" episodes", leave=False):
        start = cells[starts.integers(len(cells))] if args.exploring_starts else world.start
        s, _ = env.reset(seed=environment_seed if episode == 1 else None, options={"cell": start})
        ended = False
        while not ended:
            s_next, r, terminated, truncated, _ = env.step(actions[s])

            N[s] += 1
            alpha = args.learning_rate * N[s] ** -args.learning_rate_exponent
            # V(s) = (1 - α) V(s) + α (r + γ V(s')), with r alone if s' is terminal           Equation 3, one sample
            # Easy to get wrong: r alone only if *terminated*. An episode cut short by a time limit would have gone on.
            target = r if terminated else r + args.discount * V[s_next]
            V[s] = (1 - alpha) * V[s] + alpha * target

            s, ended = s_next, terminated or truncated
            steps += 1
            total_reward += r
        if episode in pauses:
            yield Estimate(episode, steps, np.array(V), np.array(N), total_reward / (episode - last_episode))
            total_reward, last_episode = 0.0, episode


# ---- evaluation ----------------------------------------------------------------------------------


def model_matrices(model: dict, states: int, actions: int) -> tuple[sparse.csr_array, np.ndarray]:
    """The model {s: {a: [(P(s'|s,a), s', R(s,a,s'), terminated), …]}} as matrices, in which (s, a) is row s·A + a.

    Returns P (S·A, S) and the expected rewards R (S·A,), float64. A transition that terminates adds its reward and no
    successor: nothing comes after it (Equation 2).
    """
    entries, R = [], np.zeros(states * actions)  # (S·A,)
    for s, choices in model.items():
        for a, outcomes in choices.items():
            for probability, s_next, reward, terminated in outcomes:
                R[s * actions + a] += probability * reward
                if not terminated:
                    entries.append((probability, s * actions + a, s_next))
    probabilities, rows, columns = np.array(entries).reshape(-1, 3).T  # (successors,) each
    shape = (states * actions, states)
    return sparse.csr_array((probabilities, (rows.astype(int), columns.astype(int))), shape=shape), R


def optimal_action_values(P: sparse.csr_array, R: np.ndarray, discount: float, max_sweeps: int = 100_000) -> np.ndarray:
    """Q* (S, A) by value iteration (Algorithm 3) on `model_matrices`, to rounding error.

    Raises ValueError when that does not converge, as when reward can be collected without end.
    """
    Q = np.zeros(len(R))  # (S·A,)
    for _ in range(max_sweeps):
        # Q*(s,a) = Σ_s' P(s'|s,a) [R(s,a,s') + γ max_a' Q*(s',a')]                    Equation 30
        previous, Q = Q, R + discount * (P @ Q.reshape(P.shape[1], -1).max(axis=1))  # (S·A,)
        if np.abs(Q - previous).max() <= 1e-13 * max(1, np.abs(Q).max()):
            return Q.reshape(P.shape[1], -1)
    hint = ": a discount below 1 makes it finite" if discount == 1 else ""
    raise ValueError(f"Q* has not converged in {max_sweeps:,} sweeps{hint}")


def greedy_actions(Q: np.ndarray, tolerance: float = 0.0) -> np.ndarray:
    """Which actions (S, A) bool are greedy: within `tolerance` of the best of their state (Equation 35)."""
    return Q >= Q.max(axis=1, keepdims=True) - tolerance


def decision_states(P: sparse.csr_array, start: np.ndarray) -> np.ndarray:
    """The states (S,) bool in which an agent that starts from the distribution `start` (S,) may have to act."""
    reached, grown = np.zeros(len(start), dtype=bool), start > 0  # (S,) both
    while (reached != grown).any():
        reached = grown
        grown = reached | (np.repeat(reached, P.shape[0] // P.shape[1]) @ P > 0)  # (S,)
    return reached


def policy_values(P_pi: sparse.csr_array, R_pi: np.ndarray, discount: float, names: list[str]) -> np.ndarray:
    """V^π (S,) from the linear system of Equations 2 and 3, on the rows P_pi (S, S), R_pi (S,) of its actions.

    Undiscounted, a state from which the policy never ends has value 0 if nothing is ever paid there; raises ValueError,
    naming the states, if something is.
    """
    can_end, grown = np.zeros(len(R_pi), dtype=bool), P_pi.sum(axis=1) < 1 - 1e-12  # (S,) both
    while (can_end != grown).any():
        can_end = grown
        grown = can_end | (P_pi @ can_end > 0)  # (S,)
    if discount < 1:
        can_end[:] = True  # an endless sum is finite
    elif R_pi[~can_end].any():
        caught = ", ".join(itertools.compress(names, ~can_end))
        raise ValueError(f"the policy never ends from {caught}: undiscounted, it has no finite value there")
    V = np.zeros(len(R_pi))  # (S,)
    # V^π(s) = Σ_s' P(s'|s,π(s)) [R(s,π(s),s') + γ V^π(s')], that is (I - γ P) V = R              Equations 2, 3
    system = np.eye(can_end.sum()) - discount * P_pi[can_end][:, can_end].toarray()
    V[can_end] = np.linalg.solve(system, R_pi[can_end])
    return V


# ---- report and checkpoint -----------------------------------------------------------------------

ARROWS = {"left": "←", "up": "↑", "right": "→", "down": "↓"}


def number(x: float) -> str:
    """Three decimals, and no minus sign on a zero."""
    return f"{round(x, 3) + 0.0:.3f}"


def draw_label(axes: Axes, x: float, y: float, value: float, norm: CenteredNorm) -> tuple[tuple[float, ...], str]:
    """Write a value at (x, y); returns its colour (red < 0 < blue) and the ink, black or white, that reads on it."""
    colour = colormaps["RdBu"](norm(value))
    ink = "white" if np.dot(colour[:3], (0.299, 0.587, 0.114)) < 0.5 else "black"  # luminance of red, green, blue
    axes.text(x, y, number(value), ha="center", va="center", fontsize=9, color=ink)
    return colour, ink


def draw_policy(axes: Axes, world: GridWorld, V: np.ndarray, greedy: np.ndarray, title: str) -> None:
    """Figure 10 as a picture: arrows for the greedy actions (S, A) bool, on the values V (S,); NaN is no value."""
    draw_world(axes, world)
    norm = CenteredNorm(halfrange=max(1.0, np.nanmax(np.abs(V))))
    for (x, y), value, best in zip(world.cells, V, greedy, strict=True):
        if (x, y) not in world.terminals:
            ink = "black"
            if not math.isnan(value):
                colour, ink = draw_label(axes, x, y - 0.38, value, norm)
                axes.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=colour, edgecolor="black", linewidth=1.5))
            arrow = dict(arrowstyle="-|>", linewidth=2.5, mutation_scale=18, shrinkA=0, shrinkB=0, color=ink)
            tail, tip = (-0.2, 0.25) if best.sum() == 1 else (0.03, 0.3)  # a tie is a star of arrows
            for dx, dy in itertools.compress(world.moves.values(), best):
                start, end = (x + tail * dx, y + 0.05 + tail * dy), (x + tip * dx, y + 0.05 + tip * dy)
                axes.annotate("", end, start, arrowprops=arrow)
    axes.set(title=title)


def format_values(world: GridWorld, policy: np.ndarray, V: np.ndarray, V_pi: np.ndarray) -> str:
    """In each cell the action of the policy (S,), V (S,) as learnt, and V^π (S,) below it; NaN is shown as "-"."""
    contents = {}
    for cell, a, learnt, exact in zip(world.cells, policy, V, V_pi, strict=True):
        if cell not in world.terminals:
            shown = "-" if math.isnan(learnt) else number(learnt)
            contents[cell] = [ARROWS[world.actions[a]], f"V   {shown:>7}", f"V^π {number(exact):>7}"]
    return format_cells(world, contents, width=15)


def draw_error(axes: Axes, history: list[Estimate], errors: list[float]) -> None:
    """Along training: max |V - V^π|."""
    axes.plot([estimate.episode for estimate in history], errors)
    axes.set(xscale="log", yscale="log", xlabel="episodes", ylabel="max |V - V^π|", title="Along training")
    axes.grid(alpha=0.3)


def make_run_dir(runs_dir: Path, env_id: str, script: str, seed: int) -> Path:
    """Make the folder runs_dir/{env_id}__{script}__{seed}__{time}; a second one in the same second is numbered."""
    name = f"{env_id.replace('/', '-').replace(':', '-')}__{script}__{seed}__{time.strftime('%Y%m%d-%H%M%S')}"
    runs_dir.mkdir(parents=True, exist_ok=True)
    for run_dir in itertools.chain([runs_dir / name], (runs_dir / f"{name}-{i}" for i in itertools.count(2))):
        with contextlib.suppress(FileExistsError):
            run_dir.mkdir()
            return run_dir


# ---- main ----------------------------------------------------------------------------------------


def main() -> None:
    """Learn V of a policy, judge it against V^π, report."""
    args = parse_args(Args)
    try:
        check_evaluation(args)
        check_outputs(args.output_json, args.figure)
        world = GridWorld(args.slip_probability, args.step_reward)
        env = TimeLimit(world, args.max_episode_steps)
        names, S, A = [f"({x},{y})" for x, y in world.cells], len(world.cells), len(world.actions)
        acting = np.array([cell not in world.terminals for cell in world.cells])  # (S,)
        P, R = model_matrices(world.P, S, A)  # (S·A, S) and (S·A,): known only to the judge, learning never reads them
        if args.policy:
            policy = read_policy(args.policy, world)  # (S,)
        else:
            Q_star = optimal_action_values(P, R, args.discount)  # (S, A)
            policy = greedy_actions(Q_star, 1e-9).argmax(axis=1)  # (S,)
        rows = np.arange(S) * A + policy  # (S,)
        V_pi = policy_values(P[rows], R[rows], args.discount, names)  # (S,)
        if not args.policy and np.abs(V_pi - Q_star.max(axis=1))[acting].max() > 1e-6:
            raise ValueError("of the best actions the first go round for ever: name a policy that ends, by --policy")
        start = acting if args.exploring_starts else world.initial_state_distrib  # (S,)
        reached = decision_states(P[rows], start)  # (S,)
        run_dir = make_run_dir(args.runs_dir, "GridWorld", "value_learning_gridworld", args.seed)
        settings = json.dumps(dataclasses.asdict(args), indent=1, default=str) + "\n"
        (run_dir / "args.json").write_text(settings, encoding="utf-8")

        history, errors = [], []
        with SummaryWriter(str(run_dir)) as writer:
            for estimate in value_learning(env, policy, args):
                history.append(estimate)
                errors.append(float(np.abs(estimate.V - V_pi)[reached].max()))
                writer.add_scalar("evaluation/max_error", errors[-1], estimate.episode)
                writer.add_scalar("training/mean_return", estimate.mean_return, estimate.episode)

        V = np.where(acting & (estimate.visits == 0), np.nan, estimate.V)  # (S,)
        print(f"V after {estimate.episode:,} episodes, {estimate.steps:,} steps, and V^π from the linear system:\n")
        print(format_values(world, policy, V, V_pi))
        if np.isnan(V).any():
            print(f"never visited: {', '.join(itertools.compress(names, np.isnan(V)))}")
        print(f"max |V - V^π| = {errors[-1]:.4f} in the {reached.sum()} cells that episodes can reach")
        print(f"written to {run_dir}")

        figure = Figure(figsize=(19, 5), layout="constrained")
        learnt, training, exact = figure.subplots(1, 3)
        chosen = np.eye(A, dtype=bool)[policy]  # (S, A)
        draw_policy(learnt, world, V, chosen, f"V after {estimate.episode:,} episodes")
        draw_error(training, history, errors)
        draw_policy(exact, world, V_pi, chosen, "V^π from the linear system")
        figure.savefig(args.figure or run_dir / "figure.png", dpi=100)
        result = {
            "values": {name: None if math.isnan(v) else v for name, v in zip(names, V.tolist(), strict=True)},
            "exact_values": dict(zip(names, V_pi.tolist(), strict=True)),
            "policy": {names[s]: world.actions[policy[s]] for s in np.flatnonzero(acting)},
            "visits": dict(zip(names, estimate.visits.tolist(), strict=True)),
            "episodes": estimate.episode,
            "steps": estimate.steps,
            "max_error": errors[-1],
        }
        output = args.output_json or run_dir / "values.json"
        output.write_text(json.dumps(result, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    except (ValueError, OSError) as error:
        fail(" ".join(str(error).split()))


if __name__ == "__main__":
    main()
