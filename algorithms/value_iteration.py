# /// script
# requires-python = ">=3.10"
# dependencies = [
#     "gymnasium>=1.0", "matplotlib>=3.9", "numpy>=2.0", "scipy>=1.14", "tqdm>=4.66", "tyro>=0.9",
# ]
# ///
"""Value iteration: the best policy of a known Markov decision process (§4.3, Algorithm 3).

Run it
    python algorithms/value_iteration.py                      # the lecture's MDP, its two tables
    python algorithms/value_iteration.py --env-id FrozenLake-v1 --env-kwargs map_name=8x8
    python algorithms/value_iteration.py --env-id CliffWalking-v1 --figure cliff.png
    python algorithms/value_iteration.py --model my_mdp.json --discount 0.95 --output-json best.json

Measured
    The first command converges in 4 sweeps to V* = (11, 1, 4) and π* = (a1, a1, a2). FrozenLake-v1
    at discount 1: V(0) = 0.823529411742, 14/17, after 993 sweeps.

Deviations
    The lecture is undiscounted; here a reward t steps later counts γ^t (--discount).
    Of actions that tie, the policy takes one that ends soonest: at discount 1 an argmax may walk to
    and fro for ever. Where V is held up at discount 1 (from V_0 = 0, costs may be seen later than a
    way to stay for nothing), it is not V*: that is an error.
    A transition that terminates adds no V(s'): a terminal state needs no entry in a model. Where
    one has (FrozenLake's holes and goal), its V means nothing.
"""

import functools
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import tyro
from matplotlib.figure import Figure
from scipy import sparse
from tqdm import tqdm

# ---- Args ----------------------------------------------------------------------------------------


@dataclass
class Args:
    """V, Q and rewards have the same unit; an iteration is a sweep over all states."""

    model: Path | None = None
    """JSON file: {state: {action: [[probability, next state, reward, terminated], ...]}}"""
    env_id: str = ""
    """Gymnasium environment with a model (unwrapped.P), such as FrozenLake-v1"""
    env_kwargs: str = ""
    """its arguments, such as "map_name=8x8 is_slippery=False" """
    discount: float = 1.0
    """γ in [0, 1], the weight of a reward one step later"""
    tolerance: float = 1e-12
    """V has converged when no V(s) changes by more (relative to |V(s)|, if above 1) in a sweep;
    its error may be larger, by about the length of an episode, or 1 / (1 - γ)"""
    max_iterations: int = 100_000
    """sweeps after which to give up"""
    output_json: Path | None = None
    """write values, action values and policy to this file"""
    figure: Path | None = None
    """draw the convergence, and V and π of FrozenLake and CliffWalking, to this .png"""


# ---- problem: a known Markov decision process ----------------------------------------------------

FIGURE_5 = {  # model[state][action] = [(probability, next state, reward, terminated), ...]
    "s0": {"a1": [(1.0, "s1", 10, False)], "a2": [(0.6, "s1", 10, False), (0.4, "s2", 5, False)]},
    "s1": {"a1": [(1.0, "sG", 1, True)]},
    "s2": {"a1": [(1.0, "sG", 1, True)], "a2": [(0.7, "sG", 1, True), (0.3, "s0", 0, False)]},
}

ARROWS = {"FrozenLakeEnv": "←↓→↑", "CliffWalkingEnv": "↑→↓←"}  # of actions 0 to 3

# `arrays`, below, makes of it P (rows, S), sparse, R (rows,) and first_row (S,). Figure 5:
#                P: s0   s1   s2    R: Σ_s' P(s'|s, a) R(s, a, s')    first_row
#     s0, a1         .    1    .    10                                0
#     s0, a2         .   .6   .4     8 = 0.6 · 10 + 0.4 · 5
#     s1, a1         .    .    .     1                                2
#     s2, a1         .    .    .     1                                3
#     s2, a2        .3    .    .     0.7 = 0.7 · 1 + 0.3 · 0
# A row is a pair (s, a). A transition that terminates is left out of P, for nothing comes after it.
# So a row's sum is the chance to go on, and sG has no row, no column, and V = 0.


# ---- algorithm: value iteration ------------------------------------------------------------------


def backup(P: sparse.csr_array, R: np.ndarray, V: np.ndarray, discount: float) -> np.ndarray:
    """Q (rows,) of the values V (S,)."""
    # Q(s, a) = Σ_s' P(s'|s, a) [R(s, a, s') + γ V(s')]  Equation 29; R is summed already
    return R + discount * (P @ V)  # (rows,)


def maximum(Q: np.ndarray, first_row: np.ndarray) -> np.ndarray:
    """max_a Q(s, a): (rows,) → (S,)."""
    width, rest = divmod(len(Q), len(first_row))
    if rest == 0 and (first_row == width * np.arange(len(first_row))).all():
        # Every state has `width` actions: the same as below, action by action, is much quicker.
        return functools.reduce(np.maximum, Q.reshape(-1, width).T)  # (S,)
    return np.maximum.reduceat(Q, first_row)  # (S,) over rows first_row[s] to first_row[s + 1] - 1


def value_iteration(P, R, first_row, discount: float, tolerance=1e-12, max_iterations=100_000):
    """Algorithm 3: V* (S,), and the largest change of a V(s) in each sweep, relative to |V(s)| if
    that is above 1.

    Exits if V has not converged after max_iterations: V* is infinite, or that is too few.
    """
    V, changes = np.zeros(len(first_row)), []  # V: (S,)
    for _ in tqdm(range(max_iterations), "value iteration", unit=" sweeps", delay=2, leave=False):
        # V_i+1(s) = max_a Σ_s' P(s'|s, a) [R(s, a, s') + γ V_i(s')]  Algorithm 3, line 7
        V, V_old = maximum(backup(P, R, V, discount), first_row), V  # (S,)
        changes.append((np.abs(V - V_old) / np.maximum(1, np.abs(V))).max())
        if changes[-1] <= tolerance:
            return V, changes
    raise SystemExit(f"error: V has not converged in {max_iterations} sweeps")


def argmax(Q: np.ndarray, first_row: np.ndarray) -> np.ndarray:
    """argmax_a Q(s, a): (rows,) → (S,) int, the first best row of each state."""
    counts = np.diff(first_row, append=len(Q))  # (S,) |A_s|
    rows = np.flatnonzero(Q == np.repeat(maximum(Q, first_row), counts))  # the best of all states
    return rows[np.searchsorted(rows, first_row)]


def greedy_policy(P, R, first_row: np.ndarray, Q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At discount 1: π (S,) int, a row for each state, and where it may end (S,) bool. Of the best
    actions that tie, π takes one that soonest ends, or rests for nothing."""
    V, counts = maximum(Q, first_row), np.diff(first_row, append=len(Q))  # (S,), (S,) |A_s|
    tied = np.isclose(Q, np.repeat(V, counts), rtol=1e-9, atol=1e-9)  # (rows,)
    # Easy to get wrong: walking to and fro ties with walking to the goal. So a second MDP decides,
    # by value iteration again: of the tied actions alone, an end is worth 1, and γ = 0.995.
    rests = (np.abs(R) <= 1e-9) & (P @ (np.abs(V) > 1e-9) == 0)  # (rows,) an end, too: V stays 0
    ends = (1 - P.sum(axis=1)).round(8)  # (rows,) the chance to end
    V_end, V_old = np.zeros(len(V)), None  # (S,)
    while not np.array_equal(V_end, V_old):
        Q_end = np.where(tied, 0.995 * np.where(rests, 1, ends + P @ V_end), -1)  # (rows,)
        V_end, V_old = maximum(Q_end, first_row), V_end  # (S,)
    return argmax(Q_end, first_row), V_end > 0


# ---- report: reading a model, tables, output -----------------------------------------------------


def read_model(args: Args) -> tuple[dict, gym.Env | None]:
    """The model that the flags name, else Figure 5, and its environment, if it has one.

    Exits with one line if there is no model.
    """
    if not 0 <= args.discount <= 1:
        raise SystemExit(f"error: --discount {args.discount} is not in [0, 1]")
    model, env = FIGURE_5, None
    try:
        if args.model:
            model = json.loads(args.model.read_text("utf-8"))
        if args.env_id:
            items = (item.split("=") for item in args.env_kwargs.split())
            kwargs = {k: {"true": True, "false": False}.get(v.lower(), v) for k, v in items}
            env = gym.make(args.env_id, **kwargs).unwrapped
            model = env.P
        # Names are text, as in JSON. A state without an action is terminal.
        model = {str(s): {str(a): t for a, t in model[s].items()} for s in model if model[s]}
        _, *_ = model  # at least one state
    except Exception as error:  # no such file, environment or argument, or it has no model
        raise SystemExit(f"error: {args.env_id or args.model}: {error!r}") from None
    return model, env


def arrays(model: dict) -> tuple[sparse.csr_array, np.ndarray, np.ndarray]:
    """P (rows, S), R (rows,) and first_row (S,) of a model.

    Exits with one line if a state and action make no sense.
    """
    column = {s: i for i, s in enumerate(model)}
    rows = [(s, a, t) for s in model for a, t in model[s].items()]
    P, R = sparse.lil_array((len(rows), len(model))), np.zeros(len(rows))
    for row, (s, a, transitions) in enumerate(rows):
        try:
            for p, s_next, reward, terminated in transitions:
                R[row] += p * reward
                if going_on := p * (1 - terminated):  # nothing comes after an end
                    P[row, column[str(s_next)]] += going_on
            p = [transition[0] for transition in transitions]
            if not (min(p) >= 0 and abs(sum(p) - 1) <= 1e-9 and np.isfinite(R[row])):
                raise ValueError
        except Exception:  # wrong numbers, an unknown next state, or not four values
            raise SystemExit(f"error: state {s}, action {a}: invalid {transitions}") from None
    # The first row of a state is the number of actions of the states before it.
    return P.tocsr(), R, np.cumsum([0, *map(len, model.values())])[:-1]


def worked(transitions: list, discount: float, V: dict[str, str]) -> str:
    """Σ_s' P(s'|s, a) [R(s, a, s') + γ V(s')] as text, `0.6·[10 + 0] + 0.4·[5 + 0]`."""
    γ = "" if discount == 1 else f"{discount:g}·"
    terms = [f"{p:g}·[{r:g} + {γ}{'0' if end else V[str(s)]}]" for p, s, r, end in transitions]
    return " + ".join(terms)


def print_table(header: list[str], rows: list[list[str]]) -> None:
    """Print the rows in columns that line up, with i = 0, 1, ... before them."""
    lines = [["i", *header], *([str(i), *row] for i, row in enumerate(rows))]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for line in [*lines, []]:
        print("  ".join(map(str.ljust, line, widths)).rstrip())


def q_row(model: dict, Q: np.ndarray, V: np.ndarray, discount: float) -> list[str]:
    """A row of the lecture's table of Q_i(s, a) (rows,), worked out from V_i (S,)."""
    texts = {s: f"{round(v, 2):g}" for s, v in zip(model, V, strict=True)}
    rows = [transitions for actions in model.values() for transitions in actions.values()]
    return [f"{worked(t, discount, texts)} = {round(q, 2):g}" for t, q in zip(rows, Q, strict=True)]


def report(path: Path | None, model: dict, V, Q, policy, iterations: int, residual: float) -> None:
    """Print V (S,) and π (S,), and write them with Q (rows,) to `path`. NaN is undefined. The
    Bellman residual is the largest |max_a Q(s, a) - V(s)|, or |Q(s, π(s)) - V(s)| of a policy."""
    actions = [(s, a) for s, choices in model.items() for a in choices]  # of every row
    V, Q = (np.where(np.isnan(x), None, x).tolist() for x in (V, Q))  # JSON has no NaN
    q = iter(Q)  # goes through the rows
    solution = {
        "values": dict(zip(model, V, strict=True)),
        "action_values": {s: {a: next(q) for a in choices} for s, choices in model.items()},
        "policy": dict(actions[row] for row in policy[policy >= 0]),
        "iterations": iterations,
        "residual": float(residual),
    }
    for s, v in zip(list(model)[:20], V, strict=False):
        text = "undefined" if v is None else round(v, 12)
        print(f"V({s}) = {text:<16} π({s}) = {solution['policy'].get(s, '-')}")
    print(f"{iterations} iterations, Bellman residual {residual:.2g}")
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(solution, indent=1) + "\n", "utf-8")


def save_figure(path: Path, env: gym.Env | None, P, V, policy, changes: list[float]) -> None:
    """Draw the changes and, of FrozenLake and CliffWalking, V (S,) as colours, π (S,) as arrows."""
    figure = Figure(figsize=(12, 4.5), layout="constrained")
    axes = figure.add_subplot(1, 2, 1, xlabel="sweep", ylabel="largest change of V")
    axes.semilogy(range(1, len(changes) + 1), np.maximum(changes, 1e-16), marker=".")
    if arrows := ARROWS.get(type(env).__name__):
        acts = P.sum(axis=0) > 0  # (S,) the agent comes here and goes on: no hole, goal or cliff
        cells = np.where(acts, V, np.nan).reshape(-1, getattr(env, "ncol", 12))  # (rows, columns)
        axes = figure.add_subplot(1, 2, 2, title="V and π", xticks=[], yticks=[])
        figure.colorbar(axes.imshow(cells, "YlGn", alpha=0.8), label="V(s)", shrink=0.8)
        for s in np.flatnonzero(acts):
            y, x = divmod(s, cells.shape[1])
            # 4 actions a state, so row % 4 is the action
            axes.text(x, y, arrows[policy[s] % 4], ha="center", va="center", fontsize=16)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, format="png", dpi=120)


# ---- main ----------------------------------------------------------------------------------------


def main(args: Args) -> None:
    """Solve the MDP that the flags name, and report."""
    model, env = read_model(args)
    P, R, first_row = arrays(model)
    limits = args.discount, args.tolerance, args.max_iterations
    V, changes = value_iteration(P, R, first_row, *limits)
    Q = backup(P, R, V, args.discount)  # (rows,)
    # π*(s) = argmax_a Q*(s, a)  Equation 31
    policy = argmax(Q, first_row)  # (S,) int, rows
    if args.discount == 1:
        policy, ends = greedy_policy(P, R, first_row, Q)
        # Staying for nothing where V_i was once too large, or a loop of +1 and -1, can hold V up.
        if (np.abs(V[~ends]) > 1e-9).any():
            raise SystemExit("error: V is held up by a loop without end; try policy_iteration.py")
    if len(R) <= 12:  # small enough to be worked through on paper: V_0, V_1, … once more
        values, Q_rows = [np.zeros(len(V))], [["0"] * len(R)]
        for _ in range(min(len(changes) + 1, 9)):  # Q converges a sweep after V
            Q_i = backup(P, R, values[-1], args.discount)  # (rows,)
            Q_rows.append(q_row(model, Q_i, values[-1], args.discount))
            values.append(maximum(Q_i, first_row))  # (S,)
        print_table([f"V_i({s})" for s in model], [[f"{round(v, 2):g}" for v in V] for V in values])
        print_table([f"Q_i({s}, {a})" for s in model for a in model[s]], Q_rows)
    residual = np.abs(maximum(Q, first_row) - V).max()
    report(args.output_json, model, V, Q, policy, len(changes), residual)
    if args.figure:
        save_figure(args.figure, env, P, V, policy, changes)


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")  # a pipe on Windows may not know π
    main(tyro.cli(Args, description=__doc__))
