# /// script
# requires-python = ">=3.10"
# dependencies = [
#     "gymnasium>=1.0", "numpy>=2.0", "scipy>=1.14", "tyro>=0.9",
# ]
# ///
"""The Bellman optimality equation as a linear program (§4.3, Equation 27).

Run it
    python algorithms/linear_program.py                       # the lecture's MDP, its program
    python algorithms/linear_program.py --env-id FrozenLake-v1 --discount 0.99
    python algorithms/linear_program.py --env-id Taxi-v4

Measured
    The first command prints V* = (11, 1, 4), the V* of value iteration.

Deviations
    The lecture is undiscounted; here a reward t steps later counts γ^t (--discount).
    Of actions that tie, the policy takes one that ends soonest: at discount 1 an argmax may walk to
    and fro for ever.
"""

import functools
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import tyro
from scipy import optimize, sparse

# ---- Args ----------------------------------------------------------------------------------------


@dataclass
class Args:
    """V, Q and rewards have the same unit; an iteration is one of the solver,
    which may find the solution before its first one."""

    model: Path | None = None
    """JSON file: {state: {action: [[probability, next state, reward, terminated], ...]}}"""
    env_id: str = ""
    """Gymnasium environment with a model (unwrapped.P), such as FrozenLake-v1"""
    env_kwargs: str = ""
    """its arguments, such as "map_name=8x8 is_slippery=False" """
    discount: float = 1.0
    """γ in [0, 1], the weight of a reward one step later"""
    output_json: Path | None = None
    """write values, action values and policy to this file"""


# ---- problem: a known Markov decision process ----------------------------------------------------

FIGURE_5 = {  # model[state][action] = [(probability, next state, reward, terminated), ...]
    "s0": {"a1": [(1.0, "s1", 10, False)], "a2": [(0.6, "s1", 10, False), (0.4, "s2", 5, False)]},
    "s1": {"a1": [(1.0, "sG", 1, True)]},
    "s2": {"a1": [(1.0, "sG", 1, True)], "a2": [(0.7, "sG", 1, True), (0.3, "s0", 0, False)]},
}

# `arrays`, below, makes of it P (rows, S), sparse, R (rows,) and first_row (S,). Figure 5:
#                P: s0   s1   s2    R: Σ_s' P(s'|s, a) R(s, a, s')    first_row
#     s0, a1         .    1    .    10                                0
#     s0, a2         .   .6   .4     8 = 0.6 · 10 + 0.4 · 5
#     s1, a1         .    .    .     1                                2
#     s2, a1         .    .    .     1                                3
#     s2, a2        .3    .    .     0.7 = 0.7 · 1 + 0.3 · 0
# A row is a pair (s, a). A transition that terminates is left out of P, for nothing comes after it.
# So a row's sum is the chance to go on, and sG has no row, no column, and V = 0.


# ---- algorithm: linear program -------------------------------------------------------------------


def linear_program(P, R, first_row: np.ndarray, discount: float) -> tuple[np.ndarray, int]:
    """Equation 27 as a linear program: V* (S,), and the solver's iterations.

    V* is the smallest V that satisfies all inequalities: in each state one of them is an equation.
    Exits if there is none.
    """
    # min Σ_s V(s)  subject to  V(s) ≥ R(s, a) + γ Σ_s' P(s'|s, a) V(s')  for all s and a,
    # that is (γ P - E) V ≤ -R, where E has a 1 in each row's own state
    counts = np.diff(first_row, append=len(R))  # (S,) |A_s|
    E = sparse.eye_array(len(first_row), format="csr")[np.repeat(np.arange(len(counts)), counts)]
    # float64 has 16 digits: beside a reward of 1e9, 1e-10 cannot be asked for.
    digits = float(np.clip(1e-16 * np.abs(R).max(), 1e-10, 1e-7))
    tolerances = {"primal_feasibility_tolerance": digits, "dual_feasibility_tolerance": 1e-10}
    # Easy to get wrong: where the agent may stay for nothing V ≥ 0. At discount 1 the constraint of
    # an action that stays in s for nothing, V(s) ≥ 0 + V(s), does not say so.
    idle = maximum(idle_rows(P, R, first_row, np.zeros(len(counts))), first_row)  # (S,)
    bounds = [(0 if rests else None, None) for rests in idle]  # (S, 2)
    program = optimize.linprog(
        np.ones(len(counts)), discount * P - E, -R, bounds=bounds, options=tolerances
    )
    # Infeasible: no finite V is large enough, V* is +∞ somewhere. Unbounded: somewhere none is too
    # small, V* is -∞.
    if program.x is None:
        raise SystemExit(f"error: V* is not found: {program.message.splitlines()[0]}")
    return program.x, int(program.nit)  # (S,)


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


def idle_rows(P, R, first_row: np.ndarray, V: np.ndarray) -> np.ndarray:
    """(rows,) bool: idle actions. Their expected reward is 0, and they end or lead to states alone
    where V (S,) is 0 and some action is idle again: the agent may rest there for ever."""
    idle, before = np.abs(V) <= 1e-9, None  # (S,)
    while not np.array_equal(idle, before):
        rows = (np.abs(R) <= 1e-9) & (P @ (~idle) == 0)  # (rows,)
        idle, before = idle & maximum(rows, first_row), idle
    return rows


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


# ---- main ----------------------------------------------------------------------------------------


def main(args: Args) -> None:
    """Solve the MDP that the flags name, and report."""
    model, _ = read_model(args)
    P, R, first_row = arrays(model)
    V, iterations = linear_program(P, R, first_row, args.discount)
    Q = backup(P, R, V, args.discount)  # (rows,)
    if len(R) <= 12:  # small enough to be worked through on paper
        unknowns = {s: f"V({s})" for s in model}
        print("min  " + " + ".join(unknowns.values()) + "  subject to")
        for s, actions in model.items():
            for transitions in actions.values():
                print(f"V({s}) ≥ {worked(transitions, args.discount, unknowns)}")
        print()
    # π*(s) = argmax_a Q*(s, a)  Equation 31
    policy = argmax(Q, first_row)  # (S,) int, rows
    if args.discount == 1:
        policy, _ = greedy_policy(P, R, first_row, Q)
    residual = np.abs(maximum(Q, first_row) - V).max()
    report(args.output_json, model, V, Q, policy, iterations, residual)


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")  # a pipe on Windows may not know π
    main(tyro.cli(Args, description=__doc__))
