# /// script
# requires-python = ">=3.10"
# dependencies = [
#   "numpy>=2.0", "scipy>=1.14", "gymnasium>=1.0", "torch>=2.4", "tensorboard>=2.17", "tyro>=0.9", "tqdm>=4.66",
#   "matplotlib>=3.9",
# ]
# ///
"""Tabular Q-learning: a robot learns GridWorld without being told its model (§5.2, Algorithm 5, Equations 34-36).

Figure 9, the Q-values of each cell, and Figure 10, the policy, are printed and drawn, beside Q* by value iteration
(§4.3), for here the model is known, though not to the learner. The world is that of Figures 2 and 3. Its rewards are
in the lost pictures, but §5.2 says what the robot does: it goes left in (2,1), (3,1), (4,1) and (3,2). With the
lecture's undiscounted Equation 34 and moves that slip in 2 of 10 cases, that policy is optimal if every step that does
not end the episode pays between -0.0274 and -0.0221, and for no discount at a step reward of 0: hence --step-reward
-0.025 (`python benchmarks/gridworld.py step-rewards` solves the model along the step reward, and prints all changes).

Run it
    python algorithms/tabular_q_gridworld.py                        # 1,000 episodes, as for Figure 9
    python algorithms/tabular_q_gridworld.py --episodes 200000      # until the policy is Figure 10's
    python algorithms/tabular_q_gridworld.py --learning-rate 1 --learning-rate-exponent 0.7     # quick, and less exact
    python algorithms/tabular_q_gridworld.py --step-reward -0.5     # a hurried robot risks the -1
    python algorithms/tabular_q_gridworld.py --slip-probability 0   # Figure 3, left
    python algorithms/tabular_q_gridworld.py --env-id CliffWalking-v1 --learning-rate-exponent 0 --epsilon-initial 0.7
    python algorithms/tabular_q_gridworld.py --env-id FrozenLake-v1 --env-kwargs is_slippery=false --discount 0.9
    tensorboard --logdir runs

Measured on one x86-64 core (Python 3.11, Gymnasium 1.4.0, NumPy 2.4), mostly by `python benchmarks/gridworld.py`
    Seeds 0 to 19 with --episodes 200000: the policy is Figure 10's and optimal in all nine cells for 20 of 20 seeds,
    with max |Q - Q*| from 0.0035 to 0.0238. After the default 1,000 episodes, with seed 0, it is optimal in 6 of 9
    cells and max |Q - Q*| = 0.672: a robot that learns slowly enough to tell 0.546 from 0.543 in (4,1) is slow at
    first. With --learning-rate 1 --learning-rate-exponent 0.7 the same 1,000 episodes give 9 of 9 cells and 0.210.
    Speed: 538,720 steps per second in the learning loop; 38% of that time is the environment's.
    CliffWalking-v1 as above: max |Q - Q*| = 0.0000, and an optimal action in 37 of 37 states.

Deviations
    The lecture says                      this file does                        why
    ------------------------------------  ------------------------------------  ---------------------------------------
    repeat until Q has converged          --episodes of them                    whether it has, samples do not tell
    Equation 34 has no discount           --discount, 1 by default              other environments need one
    α in (0, 1]                           0.7 · N(s,a)^-0.85, N(s,a) visits     a constant α (exponent 0) never settles;
                                                                                a large one overshoots in (4,1), where
                                                                                "down" mostly stays and forgets slowly
    "some schedule" of ε, per transition  linear in episodes, from 1 to 0.7     the number of steps is not known before;
                                                                                Q-learning is off-policy, and a greedier
                                                                                robot hardly ever sees (4,1)
    r + max Q(s',a') for every s'         r alone where the episode terminated  Equation 36: nothing comes after the end
    no word on ties                       broken at random, and named           the first one is "left", for ever
    no word on time limits                1,000 steps cut an episode short      a policy may never end; the target still
                                                                                looks ahead, for the world does go on
    1000 interactions (Figure 9)          1,000 episodes                        1,000 transitions are about 30 episodes
"""

import contextlib
import dataclasses
import inspect
import io
import itertools
import json
import math
import sys
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple, NoReturn, TypeVar

import gymnasium as gym
import numpy as np
import tyro
from gymnasium.wrappers import TimeLimit, TransformAction, TransformObservation
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import CenteredNorm
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from scipy import sparse
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

Flags = TypeVar("Flags")

# ---- Args ----------------------------------------------------------------------------------------


@dataclass
class Args:
    """Counts of steps are actions of the agent, counts of episodes run from a reset to an end."""

    episodes: int = 1000
    """episodes to learn from (the lecture's Figure 9: 1000)"""
    discount: float = 1.0
    """γ in [0, 1], weight of a reward one step later (Equation 34 is undiscounted: 1)"""
    learning_rate: float = 0.7
    """α of a pair's first visit, in (0, 1] (Equation 34)"""
    learning_rate_exponent: float = 0.85
    """ω in [0, 1] of α = learning_rate · N(s,a)^-ω, where N(s,a) counts the visits of the pair; 0 keeps α constant"""
    epsilon_initial: float = 1.0
    """ε_initial in [0, 1], chance of a random action in the first episode (Algorithm 5, line 1)"""
    epsilon_final: float = 0.7
    """ε_final in [0, 1], where annealing ends (Algorithm 5, line 10)"""
    epsilon_annealing: float = 1.0
    """share of the episodes, in [0, 1], over which ε falls linearly from ε_initial to ε_final"""

    slip_probability: float = 0.2
    """GridWorld: chance that a move goes astray, half to each perpendicular side (0: Figure 3, left)"""
    step_reward: float = -0.025
    """GridWorld: reward of every transition that does not end the episode"""
    env_id: str = "GridWorld"
    """GridWorld, or a Gymnasium environment with discrete observations and actions (FrozenLake-v1, Taxi-v3, …)"""
    env_kwargs: str = ""
    """that environment's arguments, such as "map_name=8x8 is_slippery=false" """
    max_episode_steps: int = 0
    """steps after which an episode is cut short (0: 1000 in GridWorld, elsewhere the environment's own limit)"""

    seed: int = 0
    """seed of the environment's and of the exploration's random generators"""
    runs_dir: Path = Path("runs")
    """a folder for this run is made here: args.json, TensorBoard events, and the two files below"""
    output_json: Path | None = None
    """where to write the Q table and the policy (default: q_table.json in the run's folder)"""
    figure: Path | None = None
    """where to draw Q, policy and training curves, .png, .pdf or .svg (default: figure.png in the run's folder)"""


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


def check_learning(args: Args) -> None:
    """Raises ValueError for a flag outside its range; NaN is outside every range."""
    for name, inside, allowed in (
        ("episodes", args.episodes >= 1, "at least 1"),
        ("discount", 0 <= args.discount <= 1, "in [0, 1]"),
        ("learning-rate", 0 < args.learning_rate <= 1, "in (0, 1]"),
        ("learning-rate-exponent", 0 <= args.learning_rate_exponent <= 1, "in [0, 1]"),
        ("epsilon-initial", 0 <= args.epsilon_initial <= 1, "in [0, 1]"),
        ("epsilon-final", 0 <= args.epsilon_final <= args.epsilon_initial, "in [0, epsilon-initial]"),
        ("epsilon-annealing", 0 <= args.epsilon_annealing <= 1, "in [0, 1]"),
        ("max-episode-steps", args.max_episode_steps >= 0, "at least 0"),
        ("seed", args.seed >= 0, "at least 0"),
    ):
        if not inside:
            raise ValueError(f"{name} must be {allowed}, not {getattr(args, name.replace('-', '_'))}")


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


def numbered(env: gym.Env) -> gym.Env:
    """`env` with its discrete observations and actions numbered from 0, so that they are indices into a table.

    Discrete, MultiDiscrete and a Tuple of Discrete spaces (Blackjack-v1) will do; raises ValueError for any other.
    """
    space = env.observation_space
    spaces = list(space) if isinstance(space, gym.spaces.Tuple) else [space]
    if all(isinstance(part, gym.spaces.Discrete) for part in spaces):
        first, sizes = [part.start for part in spaces], [int(part.n) for part in spaces]
    elif isinstance(space, gym.spaces.MultiDiscrete):
        first, sizes = space.start.ravel(), space.nvec.ravel().tolist()
    else:
        raise ValueError(f"a table needs discrete observations, not {space}")
    if not isinstance(env.action_space, gym.spaces.Discrete):
        raise ValueError(f"a table needs discrete actions, not {env.action_space}")
    if not isinstance(space, gym.spaces.Discrete) or first[0] != 0:
        states = gym.spaces.Discrete(math.prod(sizes))
        env = TransformObservation(env, lambda o: int(np.ravel_multi_index(np.ravel(o) - first, sizes)), states)
    if env.action_space.start != 0:
        start, actions = int(env.action_space.start), gym.spaces.Discrete(int(env.action_space.n))
        env = TransformAction(env, lambda a: a + start, actions)
    return env


def make_environment(args: Args) -> gym.Env:
    """GridWorld or the Gymnasium environment of --env-id, with its time limit; ValueError if it cannot be made."""
    if args.env_id == "GridWorld":
        if args.env_kwargs:
            raise ValueError("--env-kwargs belongs to --env-id; GridWorld has --slip-probability and --step-reward")
        if args.discount == 1 and args.step_reward > 0:
            raise ValueError(f"step-reward {args.step_reward} > 0, discount 1: never to end is best, Q* is infinite")
        return TimeLimit(GridWorld(args.slip_probability, args.step_reward), args.max_episode_steps or 1000)
    if (args.slip_probability, args.step_reward) != (Args.slip_probability, Args.step_reward):
        raise ValueError(f"--slip-probability and --step-reward belong to GridWorld, not to {args.env_id}")
    kwargs = {}
    for item in args.env_kwargs.split():
        name, equals, kwargs[name] = item.partition("=")
        if not equals:
            raise ValueError(f"--env-kwargs: {item!r} is not name=value")
        with contextlib.suppress(ValueError):  # what is not JSON, such as 8x8, stays text
            kwargs[name] = json.loads(kwargs[name].replace("True", "true").replace("False", "false"))
    kwargs.update(max_episode_steps=args.max_episode_steps or None, disable_env_checker=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # advice about versions, on a run in which nothing is wrong
        try:
            try:
                env = gym.make(args.env_id, **kwargs)
            except gym.error.DeprecatedEnv:
                env = gym.make(args.env_id.rpartition("-v")[0], **kwargs)
                print(f"{args.env_id} is retired in Gymnasium {gym.__version__}; {env.spec.id} takes its place.\n")
        except Exception as error:  # whatever the constructor of somebody's environment raises
            raise ValueError(f"Gymnasium cannot make {args.env_id} with {args.env_kwargs!r}: {error}") from error
    return numbered(env)


# ---- algorithm -----------------------------------------------------------------------------------


class Evaluation(NamedTuple):
    """The learner after an episode; return and length are means over the episodes since the last evaluation."""

    episode: int
    steps: int
    epsilon: float
    Q: np.ndarray  # (S, A) float64
    visits: np.ndarray  # (S, A) int64
    mean_return: float
    mean_length: float


def annealed_epsilon(episode: int, args: Args) -> float:
    """ε of episode 1, 2, …: linear from ε_initial to ε_final over the share `epsilon_annealing` of the episodes."""
    done = min(1, (episode - 1) / max(1, args.epsilon_annealing * args.episodes - 1))
    return args.epsilon_initial + done * (args.epsilon_final - args.epsilon_initial)


def tabular_q_learning(env: gym.Env, args: Args) -> Iterator[Evaluation]:
    """Tabular Q-learning (Algorithm 5); pauses to be evaluated after 100 episodes or fewer, evenly spaced in log scale.

    `env` numbers its observations and actions from 0. Same arguments, same tables, bit for bit.
    """
    # Easy to get wrong: Gymnasium's generator is default_rng(seed), so an exploration with default_rng(seed) would draw
    # the very numbers that make the robot slip. Hence two seeds from one.
    environment_seed, exploration_seed = np.random.SeedSequence(args.seed).generate_state(2).tolist()
    random = np.random.default_rng(exploration_seed).random
    states, actions = range(env.observation_space.n), range(env.action_space.n)
    Q = [[0.0 for a in actions] for s in states]  # Q(s,a), and 0 for ever where s is terminal: no action is taken there
    N = [[0 for a in actions] for s in states]  # N(s,a), visits; lists, for Python reads them far faster than arrays
    pauses = set(np.geomspace(1, args.episodes, 100).round().astype(int).tolist())
    steps, total_reward, last_steps, last_episode = 0, 0.0, 0, 0
    for episode in tqdm(range(1, args.episodes + 1), desc="learning", unit=" episodes", leave=False):
        epsilon = annealed_epsilon(episode, args)
        s, _ = env.reset(seed=environment_seed if episode == 1 else None)
        ended = False
        while not ended:
            # π(s) = argmax_a Q(s,a), and a random action with probability ε
            if random() < epsilon:
                a = int(random() * len(actions))
            else:
                # Easy to get wrong: ties are broken at random. The first of the best would be "left" in every unknown
                # cell, and a robot that explores little would not leave (1,1).
                best = max(Q[s])
                greedy = [a for a in actions if Q[s][a] == best]
                a = greedy[0] if len(greedy) == 1 else greedy[int(random() * len(greedy))]
            s_next, r, terminated, truncated, _ = env.step(a)

            N[s][a] += 1
            alpha = args.learning_rate * N[s][a] ** -args.learning_rate_exponent
            # Q(s,a) = (1 - α) Q(s,a) + α (r + γ max_a' Q(s',a')), r alone if s' is terminal           Equations 34, 36
            # Easy to get wrong: r alone only if *terminated*. An episode cut short by a time limit would have gone on.
            target = r if terminated else r + args.discount * max(Q[s_next])
            Q[s][a] = (1 - alpha) * Q[s][a] + alpha * target

            s, ended = s_next, terminated or truncated
            steps += 1
            total_reward += r
        if episode in pauses:
            since = episode - last_episode
            means = total_reward / since, (steps - last_steps) / since
            yield Evaluation(episode, steps, epsilon, np.array(Q), np.array(N), *means)  # (S, A) both
            total_reward, last_steps, last_episode = 0.0, steps, episode


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


def decision_states(P: sparse.csr_array, start: np.ndarray) -> np.ndarray:
    """The states (S,) bool in which an agent that starts from the distribution `start` (S,) may have to act."""
    reached, grown = np.zeros(len(start), dtype=bool), start > 0  # (S,) both
    while (reached != grown).any():
        reached = grown
        grown = reached | (np.repeat(reached, P.shape[0] // P.shape[1]) @ P > 0)  # (S,)
    return reached


def greedy_actions(Q: np.ndarray, tolerance: float = 0.0) -> np.ndarray:
    """Which actions (S, A) bool are greedy: within `tolerance` of the best of their state (Equation 35)."""
    return Q >= Q.max(axis=1, keepdims=True) - tolerance


def optimal_states(Q: np.ndarray, Q_star: np.ndarray) -> np.ndarray:
    """The states (S,) bool in which every greedy action of Q is a best action of Q*."""
    return (greedy_actions(Q) <= greedy_actions(Q_star, 1e-9)).all(axis=1)


# ---- report and checkpoint -----------------------------------------------------------------------

ARROWS = {"left": "←", "up": "↑", "right": "→", "down": "↓"}


def number(x: float) -> str:
    """Three decimals, and no minus sign on a zero."""
    return f"{round(x, 3) + 0.0:.3f}"


def format_action_values(world: GridWorld, Q: np.ndarray) -> str:
    """Figure 9 as text: the four Q-values of each cell, each on the side that its action moves to."""
    contents = {}
    for cell, values in zip(world.cells, Q.tolist(), strict=True):
        if cell not in world.terminals:
            left, up, right, down = map(number, values)
            contents[cell] = [up, f"{left} {right:>6}", down]
    return format_cells(world, contents, width=15)


def format_policy(world: GridWorld, greedy: np.ndarray) -> str:
    """Figure 10 as text: the arrows of the greedy actions (S, A) bool; a cell with several has a tie."""
    arrows = list(ARROWS.values())
    contents = {}
    for cell, best in zip(world.cells, greedy, strict=True):
        if cell not in world.terminals:
            contents[cell] = ["".join(itertools.compress(arrows, best))]
    return format_cells(world, contents, width=6)


def draw_label(axes: Axes, x: float, y: float, value: float, norm: CenteredNorm) -> tuple[tuple[float, ...], str]:
    """Write a value at (x, y); returns its colour (red < 0 < blue) and the ink, black or white, that reads on it."""
    colour = colormaps["RdBu"](norm(value))
    ink = "white" if np.dot(colour[:3], (0.299, 0.587, 0.114)) < 0.5 else "black"  # luminance of red, green, blue
    axes.text(x, y, number(value), ha="center", va="center", fontsize=9, color=ink)
    return colour, ink


def draw_action_values(axes: Axes, world: GridWorld, Q: np.ndarray, title: str) -> None:
    """Figure 9 as a picture: Q (S, A), each cell in four triangles, on the side that the action moves to."""
    draw_world(axes, world)
    norm = CenteredNorm(halfrange=max(1.0, np.abs(Q).max()))
    for (x, y), values in zip(world.cells, Q, strict=True):
        if (x, y) not in world.terminals:
            for value, (dx, dy) in zip(values, world.moves.values(), strict=True):
                colour, _ = draw_label(axes, x + 0.31 * dx, y + 0.31 * dy, value, norm)
                corners = [(x, y), (x + (dx - dy) / 2, y + (dy + dx) / 2), (x + (dx + dy) / 2, y + (dy - dx) / 2)]
                axes.add_patch(Polygon(corners, facecolor=colour, edgecolor="0.4", linewidth=0.5))
    axes.set(title=title)


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


def draw_training(axes: Axes, history: list[Evaluation], errors: list[float], optimal: list[int], states: int) -> None:
    """Along training: max |Q - Q*| and in how many states the policy is optimal; without Q*, return and length."""
    episodes = [evaluation.episode for evaluation in history]
    right = axes.twinx()
    if errors:
        axes.plot(episodes, errors, color="tab:blue")
        axes.set(ylabel="max |Q - Q*|", yscale="log", title="Along training")
        right.step(episodes, optimal, where="post", color="tab:orange")
        right.set(ylabel=f"states with an optimal action, of {states}", ylim=(0, states * 1.05))
    else:
        axes.plot(episodes, [evaluation.mean_return for evaluation in history], color="tab:blue")
        axes.set(ylabel="mean return", title="Along training")
        right.plot(episodes, [evaluation.mean_length for evaluation in history], color="tab:orange")
        right.set(ylabel="mean length of an episode, steps")
    axes.set(xscale="log", xlabel="episodes")
    axes.yaxis.label.set_color("tab:blue")
    right.yaxis.label.set_color("tab:orange")
    axes.grid(alpha=0.3)


def format_table(names: list[str], actions: list[str], Q: np.ndarray, shown: np.ndarray) -> str:
    """Q (S, A) as text, a row for each of the first 64 states in `shown` (S,) bool, with its greedy actions."""
    greedy = greedy_actions(Q)
    lines = [" " * 8 + "".join(f"{f'Q(s,{action})':>11}" for action in actions) + "   greedy"]
    for s in np.flatnonzero(shown)[:64]:
        best = " or ".join(itertools.compress(actions, greedy[s]))
        lines.append(f"{names[s]:>8}" + "".join(f"{number(value):>11}" for value in Q[s]) + f"   {best}")
    return "\n".join(lines + [f"and {shown.sum() - 64} states more"] * bool(shown.sum() > 64))


def table_as_json(names: list[str], actions: list[str], Q: np.ndarray, known: np.ndarray) -> dict:
    """Values, action values, policy and ties of the states `known` (S,) bool, keyed as the known-MDP scripts do."""
    greedy = greedy_actions(Q)
    choices = {names[s]: list(itertools.compress(actions, greedy[s])) for s in np.flatnonzero(known)}
    return {
        "values": {name: float(Q[s].max()) if known[s] else None for s, name in enumerate(names)},
        "action_values": {names[s]: dict(zip(actions, Q[s].tolist(), strict=True)) for s in np.flatnonzero(known)},
        "policy": {name: best[0] for name, best in choices.items()},
        "ties": {name: best for name, best in choices.items() if len(best) > 1},
    }


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
    """Learn, judge against Q* where the model is known, report."""
    args = parse_args(Args)
    try:
        check_learning(args)
        check_outputs(args.output_json, args.figure)
        env = make_environment(args)
        world = env.unwrapped
        S, A = int(env.observation_space.n), int(env.action_space.n)
        Q_star, deciding = None, np.ones(S, dtype=bool)  # (S,)
        model = getattr(world, "P", None)
        if model is not None and len(model) == S:  # known only to the judge: learning never reads it
            P, R = model_matrices(model, S, A)  # (S·A, S) and (S·A,)
            Q_star = optimal_action_values(P, R, args.discount)  # (S, A)
            deciding = decision_states(P, getattr(world, "initial_state_distrib", np.ones(S)))  # (S,)
        run_dir = make_run_dir(args.runs_dir, args.env_id, "tabular_q_gridworld", args.seed)
        settings = json.dumps(dataclasses.asdict(args), indent=1, default=str) + "\n"
        (run_dir / "args.json").write_text(settings, encoding="utf-8")

        history, errors, optimal = [], [], []
        with SummaryWriter(str(run_dir)) as writer:
            for evaluation in tabular_q_learning(env, args):
                history.append(evaluation)
                scalars = {
                    "training/epsilon": evaluation.epsilon,
                    "training/mean_return": evaluation.mean_return,
                    "training/mean_length": evaluation.mean_length,
                }
                if Q_star is not None:
                    errors.append(float(np.abs(evaluation.Q - Q_star)[deciding].max()))
                    optimal.append(int(optimal_states(evaluation.Q, Q_star)[deciding].sum()))
                    scalars |= {"evaluation/max_error": errors[-1], "evaluation/optimal_states": optimal[-1]}
                for name, value in scalars.items():
                    writer.add_scalar(name, value, evaluation.episode)

        Q, visited = evaluation.Q, evaluation.visits.sum(axis=1) > 0  # (S, A) and (S,)
        print(f"Q after {evaluation.episode:,} episodes, {evaluation.steps:,} steps:\n")
        if isinstance(world, GridWorld):
            names, actions, shown = [f"({x},{y})" for x, y in world.cells], world.actions, deciding
            print(format_action_values(world, Q))
            print(f"\nQ* by value iteration:\n\n{format_action_values(world, Q_star)}")
            print(f"\nPolicy learnt:\n\n{format_policy(world, greedy_actions(Q))}")
            print(f"\nOptimal policy:\n\n{format_policy(world, greedy_actions(Q_star, 1e-9))}")
            figure = Figure(figsize=(14, 10.5), layout="constrained")
            axes = figure.subplots(2, 2)
            draw_action_values(axes[0, 0], world, Q, f"Q after {evaluation.episode:,} episodes")
            draw_policy(axes[1, 0], world, Q.max(axis=1), greedy_actions(Q), "Policy learnt, on max Q(s,a)")
            draw_action_values(axes[1, 1], world, Q_star, "Q* by value iteration")
            training = axes[0, 1]
        else:
            names, actions, shown = [str(s) for s in range(S)], [str(a) for a in range(A)], visited
            print(format_table(names, actions, Q, visited))
            figure = Figure(figsize=(14, 5.25), layout="constrained")
            table, training = figure.subplots(1, 2)
            image = table.imshow(Q, aspect="auto", cmap="RdBu", norm=CenteredNorm(), interpolation="nearest")
            figure.colorbar(image, ax=table)
            table.set(title=f"Q after {evaluation.episode:,} episodes", xlabel="action", ylabel="state")
        draw_training(training, history, errors, optimal, deciding.sum())
        figure.savefig(args.figure or run_dir / "figure.png", dpi=100)

        table = table_as_json(names, actions, Q, shown)
        for name, tied in itertools.islice(table["ties"].items(), 20):
            print(f"Tie in {name}: {', '.join(tied)} have the same Q.")
        if len(table["ties"]) > 20:
            print(f"Ties in {len(table['ties']) - 20} states more.")
        result = {"episodes": evaluation.episode, "steps": evaluation.steps, "visits": evaluation.visits.tolist()}
        if Q_star is not None:
            result |= {"max_error": errors[-1], "optimal_states": optimal[-1], "states": int(deciding.sum())}
            print(f"max |Q - Q*| = {errors[-1]:.4f}; an optimal action in {optimal[-1]} of {deciding.sum()} states")
        last = evaluation.episode - (history[-2].episode if len(history) > 1 else 0)
        print(f"mean return of the last {last} episodes, while exploring with ε = {evaluation.epsilon:.2f}: "
              f"{evaluation.mean_return:.4g}")
        print(f"written to {run_dir}")
        output = args.output_json or run_dir / "q_table.json"
        output.write_text(json.dumps(table | result, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    except (ValueError, OSError) as error:
        fail(" ".join(str(error).split()))


if __name__ == "__main__":
    main()
