# /// script
# requires-python = ">=3.10"
# dependencies = [
#     "gymnasium>=1.3", "matplotlib>=3.9", "numpy>=2.0", "pandas>=2.2", "scipy>=1.14",
#     "tqdm>=4.66", "tyro>=0.9",
# ]
# ///
"""Value iteration: the best policy of a known Markov decision process (§4.3, Algorithm 3).

Run it
    python algorithms/value_iteration.py                      # the lecture's MDP, its two tables
    python algorithms/value_iteration.py --env-id FrozenLake-v1 --env-kwargs map_name=8x8
    python algorithms/value_iteration.py --env-id CliffWalking-v1 --figure cliff.png
    python algorithms/value_iteration.py --model my_mdp.json --discount 0.95 --output-json best.json

Measured
    The first command converges in 4 sweeps to V* = (11, 1, 4) and π* = (a1, a1, a2). FrozenLake-v1,
    4×4, at discount 1: V(0) = 0.8235294117, 14/17, after 993 sweeps.

Deviations
    §3 and §4 are undiscounted; here a reward t steps later counts γ^t (--discount).
    At discount 1, of actions that tie (to 1e-9), the policy takes one that ends: an argmax may walk
    to and fro for ever.
    At discount 1 V_i may stop above V*. Say that s1 has one action, which ends and costs 9, and s0
    has two: "go" to s1, which pays 8, and "stay" in s0, which pays 0. V_0(s1) = 0 makes V_1(s0) 8;
    "stay" is worth V_i(s0), so V_i(s0) stays at 8 for ever, while V*(s0) = max(8 - 9, 0) = 0.
    Rewards may also cancel: -1 from s0 to s1 and 1 back, beside an exit from s0 that costs 5, make
    V_i alternate for ever. In both cases this exits with an error; policy_iteration.py solves both.
    A transition that terminates adds no V(s'). A model may list terminal states, as FrozenLake does
    its goal; their V is never read.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import tyro
from matplotlib.figure import Figure
from scipy import sparse
from tqdm import tqdm

# ---- Args ----------------------------------------------------------------------------------------


@dataclass
class Args:
    """An iteration is a sweep over all states. V(s) is the expected sum of rewards from
    state s on, in their unit; Q(s, a) the same if the first action is a; π(s) the action in s."""

    model: Path | None = None
    """JSON file: {state: {action: [[probability, next state, reward, terminated], ...]}}"""
    env_id: str = ""
    """Gymnasium environment with a model (unwrapped.P), such as FrozenLake-v1; replaces --model"""
    env_kwargs: str = ""
    """its arguments, such as "map_name=8x8 is_slippery=False"; all but True and False are text"""
    discount: float = 1.0
    """γ in [0, 1], the weight of a reward one step later"""
    tolerance: float = 1e-12
    """V has converged when no V(s) changes by more than this in a sweep (relative to |V(s)|, if
    above 1); the error of V may be larger"""
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

# The model as arrays (`arrays`, below), for S states with at most A actions each: P (A·S, S) is
# sparse, its row a·S + s belongs to action a in state s; R (A, S) holds the expected rewards, here
# written as a column beside P. Figure 5:
#                P: s0   s1   s2    R: Σ_s' P(s'|s, a) R(s, a, s')
#     a1, s0         .    1    .    10
#     a1, s1         .    .    .     1
#     a1, s2         .    .    .     1
#     a2, s0         .   .6   .4     8 = 0.6 · 10 + 0.4 · 5
#     a2, s1         .    .    .    -∞: s1 has no second action; -∞ is never the largest Q
#     a2, s2        .3    .    .     0.7 = 0.7 · 1 + 0.3 · 0
# A transition that terminates is left out of P, for nothing comes after it. So a row's sum is the
# probability to go on, and sG has no row, no column, and V = 0.


# ---- algorithm: value iteration ------------------------------------------------------------------


def backup(P: sparse.csr_array, R: np.ndarray, V: np.ndarray, discount: float) -> np.ndarray:
    """Q (A, S) of the values V (S,)."""
    # Q(s, a) = Σ_s' P(s'|s, a) [R(s, a, s') + γ V(s')]  Equation 29; R is summed already
    future = (P @ (discount * V)).reshape(R.shape)  # (A, S) γ Σ_s' P(s'|s, a) V(s')
    return np.add(R, future, out=future)  # R + future, in place: a new array takes time


def value_iteration(P, R, discount: float, tolerance=1e-12, max_iterations=100_000):
    """Algorithm 3: V* (S,), and the largest change of a V(s) in each sweep, relative to |V(s)| if
    that is above 1. The Bellman Optimality Principle (Equation 27), which V* satisfies, is made an
    assignment.

    Exits if V has not converged after max_iterations: V* is infinite, the sweeps are too few, or
    see the deviations.
    """
    V, changes = np.zeros(R.shape[1]), []  # V: (S,)
    for _ in tqdm(range(max_iterations), "value iteration", unit=" sweeps", delay=2, leave=False):
        # V_{i+1}(s) = max_a Σ_s' P(s'|s, a) [R(s, a, s') + γ V_i(s')]  Algorithm 3, line 7
        V, V_old = backup(P, R, V, discount).max(axis=0), V  # (S,)
        changes.append((np.abs(V - V_old) / np.maximum(1, np.abs(V))).max())
        if changes[-1] <= tolerance:
            return V, changes
    raise SystemExit(f"error: V has not converged in {max_iterations} sweeps")


def proper_policy(P: sparse.csr_array, R: np.ndarray, Q: np.ndarray) -> np.ndarray:
    """At discount 1: π (S,) int, a best action in each state. Of best actions that tie, π takes the
    one that soonest ends the episode, or leads to states with V = 0 where π can stay for ever.

    Exits if from some state no best action leads to an end.
    """
    # Easy to get wrong: if the only reward is at the goal, walking to and fro ties with walking to
    # the goal, and an argmax may choose to walk to and fro for ever.
    V = Q.max(axis=0)  # (S,)
    tied = np.isclose(Q, V, rtol=1e-9, atol=1e-9)  # (A, S) the best actions
    # Rest: the states with V = 0 among which best actions can stay for ever, or end. At first all
    # states with V = 0; while every best action of one can lead out, drop that one.
    rest, before = np.abs(V) <= 1e-9, None  # (S,)
    while not np.array_equal(rest, before):
        # (A, S): best actions that only lead to rest or end. One that surely ends has an empty row.
        to_rest = tied & ((P @ ~rest).reshape(R.shape) == 0)
        rest, before = rest & to_rest.any(axis=0), rest
    # Which best action ends soonest? The values of a second MDP tell. It has only the best actions,
    # a reward of 1 for an end, and a discount below 1, so that a later end is worth less:
    # V_end(s) = max_a 0.995 · (1 if a leads to rest, else P(end|s, a) + Σ_s' P(s'|s, a) V_end(s'))
    ends = (1 - P.sum(axis=1)).round(8).reshape(R.shape)  # (A, S); in floats .7 + .2 + .1 < 1
    R_end, V_end, V_old = np.where(tied, ends, -np.inf), np.zeros(len(V)), None  # (A, S), (S,)
    while not np.array_equal(V_end, V_old):  # V_end rises, to 0.995 at most: it converges
        Q_end = 0.995 * np.where(to_rest, 1, backup(P, R_end, V_end, discount=1))  # (A, S)
        V_end, V_old = Q_end.max(axis=0), V_end  # (S,)
    if not V_end.all():
        raise SystemExit("error: at discount 1 the best actions of a state never come to an end")
    return Q_end.argmax(axis=0)  # (S,)


# ---- report: reading a model, tables, output -----------------------------------------------------


def read_model(args: Args) -> tuple[dict, gym.Env | None, sparse.csr_array, np.ndarray]:
    """The model that the flags name, else Figure 5; its environment, if it has one; P and R.

    Exits with one line if there is no model.
    """
    if not 0 <= args.discount <= 1:
        raise SystemExit(f"error: --discount {args.discount} is not in [0, 1]")
    try:
        model, env = (json.loads(args.model.read_bytes()) if args.model else FIGURE_5), None
        if args.env_id:
            items = (item.split("=") for item in args.env_kwargs.split())
            kwargs = {k: {"true": True, "false": False}.get(v.lower(), v) for k, v in items}
            model = (env := gym.make(args.env_id, **kwargs).unwrapped).P
        # Names are text, as in JSON. A state without an action is terminal, and is left out:
        # transitions into it terminate, which `arrays` checks.
        model = {str(s): {str(a): t for a, t in model[s].items()} for s in model if model[s]}
        return model, env, *arrays(model)
    except Exception as error:  # no such file, environment or argument, or it has no model
        raise SystemExit(f"error: {args.env_id or args.model}: {error!r}") from None


def arrays(model: dict) -> tuple[sparse.csr_array, np.ndarray]:
    """P (A·S, S) and R (A, S) of a model of S states, with at most A actions in each.

    Exits with one line if a state and action make no sense.
    """
    A, S = max(map(len, model.values())), len(model)
    P, R = sparse.lil_array((A * S, S)), np.full((A, S), -np.inf)
    number = {state: s for s, state in enumerate(model)}
    for state, s in number.items():
        for a, (action, transitions) in enumerate(model[state].items()):
            try:
                R[a, s] = sum(p * reward for p, _, reward, _ in transitions)
                for p, next_state, _, terminated in transitions:
                    if not {False: False, True: True}[terminated]:  # a text is an error
                        P[a * S + s, number[str(next_state)]] += p
                p = [transition[0] for transition in transitions]
                if not (min(p) >= 0 and abs(sum(p) - 1) <= 1e-9 and np.isfinite(R[a, s])):
                    raise ValueError
            except Exception:  # wrong numbers, an unknown next state, or not four values
                raise SystemExit(f"error: {action} in {state}: invalid {transitions}") from None
    return P.tocsr(), R


def worked(transitions: list, discount: float, V: dict[str, str]) -> str:
    """Σ_s' P(s'|s, a) [R(s, a, s') + γ V(s')] as text, `0.6·[10 + 0] + 0.4·[5 + 0]`."""
    γ = "" if discount == 1 else f"{discount:g}·"
    terms = [f"{p:g}·[{r:.9g} + {γ}{'0' if end else V[str(s)]}]" for p, s, r, end in transitions]
    return " + ".join(terms)


def print_table(header: list[str], rows: list[list[str]]) -> None:
    """Print the rows i = 0, 1, ... of a table of the lecture."""
    print(pd.DataFrame(rows, columns=header).rename_axis(columns="i").to_string(), "\n")


def q_row(model: dict, Q: np.ndarray, V: np.ndarray, discount: float) -> list[str]:
    """A row of the lecture's table of Q(s, a) (A, S), from V (S,), both rounded to 0.01."""
    texts = {s: f"{round(v, 2):.9g}" for s, v in zip(model, V, strict=True)}
    pairs = [(t, Q[a, i]) for i, s in enumerate(model) for a, t in enumerate(model[s].values())]
    return [f"{worked(t, discount, texts)} = {round(q, 2):.9g}" for t, q in pairs]


def report(path: Path | None, model: dict, V, Q, policy, iterations: int, residual: float) -> None:
    """Print V (S,) and π (S,), and write them with Q (A, S) to `path`. The Bellman residual is the
    largest |max_a Q(s, a) - V(s)|. Policy evaluation and exhaustive search have |Q(s, π(s)) - V(s)|
    instead; in states that π never reaches, V is NaN and π is -1."""
    values, q = (np.where(np.isnan(x), None, x).tolist() for x in (V, Q.T))
    solution = {  # in JSON, undefined is null
        "values": dict(zip(model, values, strict=True)),
        # strict=False: without the -∞ of the actions that a state does not have
        "action_values": {s: dict(zip(model[s], q[i], strict=False)) for i, s in enumerate(model)},
        "policy": {s: list(model[s])[a] for s, a in zip(model, policy, strict=True) if a >= 0},
        "iterations": iterations,
        "residual": float(residual),
    }
    table = pd.DataFrame({"V(s)": solution["values"], "π(s)": solution["policy"]})
    print(table.to_string(max_rows=20, float_format="{:.12g}".format, na_rep="undefined"))
    print(f"{iterations} iterations, Bellman residual {residual:.2g}")
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(solution, indent=1) + "\n", "utf-8")


def save_figure(path: Path, env: gym.Env | None, P, V, policy, changes: list[float]) -> None:
    """Draw the changes and, of FrozenLake and CliffWalking, V (S,) as colours, π (S,) as arrows."""
    figure = Figure(figsize=(12, 4.5), layout="constrained")
    axes = figure.add_subplot(1, 2, 1, xlabel="sweep", ylabel="largest relative change of V")
    axes.semilogy(range(1, len(changes) + 1), np.maximum(changes, 1e-16), marker=".")
    # Directions of actions 0 to 3 as complex numbers: 1 is right, 1j is up.
    grids = {"FrozenLakeEnv": [-1, -1j, 1, 1j], "CliffWalkingEnv": [1j, 1, -1j, -1]}
    if directions := grids.get(type(env).__name__):
        # P leaves out the transitions that end, so nothing leads to holes and goal: empty columns.
        # Nothing leads to the cliff either: who steps there is put back to the start.
        acts = P.sum(axis=0) > 0  # (S,)
        cells = np.where(acts, V, np.nan).reshape(-1, getattr(env, "ncol", 12))  # CliffWalking: 12
        axes = figure.add_subplot(1, 2, 2, title="V and π", xticks=[], yticks=[])
        figure.colorbar(axes.imshow(cells, "YlGn", alpha=0.8), label="V(s)", shrink=0.8)
        arrows = np.where(acts, np.array(directions)[policy], np.nan).reshape(cells.shape)
        axes.quiver(arrows.real, arrows.imag, pivot="mid")  # up on the page, while rows go down
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, format="png", dpi=120)


# ---- main ----------------------------------------------------------------------------------------


def main(args: Args) -> None:
    """Solve the MDP that the flags name, and report."""
    model, env, P, R = read_model(args)
    V, changes = value_iteration(P, R, args.discount, args.tolerance, args.max_iterations)
    Q = backup(P, R, V, args.discount)  # (A, S)
    # π*(s) = argmax_a Q*(s, a)  Equations 28 and 31
    policy = Q.argmax(axis=0) if args.discount < 1 else proper_policy(P, R, Q)  # (S,)
    if R.size <= 12:  # small enough to be worked through on paper: V_0, V_1, … once more
        Vs, Q_rows = [np.zeros(len(V))], [["0" for s in model for a in model[s]]]
        # Numbered as in the lecture's tables: Q_i comes from V_{i-1}, V_i from Q_i, so Q converges
        # one sweep after V. Rows after i = 9 are not printed.
        for _ in range(min(len(changes) + 1, 9)):
            Q_i = backup(P, R, Vs[-1], args.discount)  # (A, S)
            Q_rows.append(q_row(model, Q_i, Vs[-1], args.discount))
            Vs.append(Q_i.max(axis=0))  # (S,)
        print_table([f"V_i({s})" for s in model], [[f"{round(v, 2):.9g}" for v in x] for x in Vs])
        print_table([f"Q_i({s}, {a})" for s in model for a in model[s]], Q_rows)
    report(args.output_json, model, V, Q, policy, len(changes), np.abs(Q.max(axis=0) - V).max())
    if args.figure:
        save_figure(args.figure, env, P, V, policy, changes)


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")  # a pipe on Windows may not know π
    main(tyro.cli(Args, description=__doc__))
