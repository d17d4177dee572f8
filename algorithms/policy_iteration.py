# /// script
# requires-python = ">=3.10"
# dependencies = [
#     "gymnasium>=1.0", "numpy>=2.0", "scipy>=1.14", "tqdm>=4.66", "tyro>=0.9",
# ]
# ///
"""Policy iteration: evaluate, improve, repeat (§4.4, Algorithm 4).

Run it
    python algorithms/policy_iteration.py                     # the lecture's MDP, from π2
    python algorithms/policy_iteration.py --env-id FrozenLake-v1
    python algorithms/policy_iteration.py --env-id Taxi-v4 --discount 0.99
    python algorithms/policy_iteration.py --initial-policy "s0=a2 s1=a1 s2=a2"

Measured
    The first command converges to V* = (11, 1, 4) and π* = (a1, a1, a2) with two policies.

Deviations
    An action is changed only for a gain: of actions that tie, an argmax may change for ever.
    The first policy is not random but, without --initial-policy, one that ends, or stays somewhere
    for nothing, if it can: at discount 1 another has no value.
    The lecture is undiscounted; here a reward t steps later counts γ^t (--discount).
"""

import functools
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import tyro
from scipy import sparse
from scipy.sparse import linalg
from tqdm import tqdm

# ---- Args ----------------------------------------------------------------------------------------


@dataclass
class Args:
    """V, Q and rewards have the same unit; an iteration evaluates and improves a policy."""

    model: Path | None = None
    """JSON file: {state: {action: [[probability, next state, reward, terminated], ...]}}"""
    env_id: str = ""
    """Gymnasium environment with a model (unwrapped.P), such as FrozenLake-v1"""
    env_kwargs: str = ""
    """its arguments, such as "map_name=8x8 is_slippery=False" """
    discount: float = 1.0
    """γ in [0, 1], the weight of a reward one step later"""
    initial_policy: str = ""
    """such as "s0=a2 s1=a1 s2=a1", the lecture's π2; else one that ends if it can"""
    max_iterations: int = 1000
    """policies after which to give up"""
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


# ---- algorithm: policy iteration -----------------------------------------------------------------


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


def policy_iteration(P, R, first_row, policy, discount: float, max_iterations=1000) -> list[tuple]:
    """Algorithm 4 from `policy` (S,) int, a row for each state: [(π (S,), V^π (S,), Q^π (rows,)),
    ...], of which the last is the best.

    Exits if a policy has no value, or if π has not converged after max_iterations.
    """
    steps = []
    for _ in tqdm(range(max_iterations), "policy iteration", delay=2, leave=False):
        # Perform policy evaluation on π to find V^π(s)  Algorithm 4, line 3
        P_π, R_π = P[policy], R[policy]  # (S, S), (S,)
        live, V = live_states(P_π, R_π, discount), np.zeros(len(policy))  # (S,), (S,)
        V[live] = solve_system(P_π[live][:, live], R_π[live], discount)
        Q = backup(P, R, V, discount)  # (rows,)
        steps.append((policy, V, Q))
        # π(s) = argmax_a Q^π(s, a)  Algorithm 4, line 5
        best = maximum(Q, first_row)  # (S,)
        gain = ~np.isclose(Q[policy], best, rtol=1e-9, atol=1e-9)  # (S,)
        if not gain.any():
            return steps
        # Easy to get wrong: an action that only ties is not taken, or π may change for ever.
        policy = np.where(gain, argmax(Q, first_row), policy)
    raise SystemExit(f"error: π has not converged in {max_iterations} iterations")


def solve_system(P: sparse.csr_array, R: np.ndarray, discount: float) -> np.ndarray:
    """V (n,) of Equation 3, V = R + γ P V, as a linear system; P (n, n), R (n,)."""
    A = sparse.eye_array(len(R), format="csc") - discount * P.tocsc()  # (n, n) (I - γ P) V = R
    if len(R) > 1000:  # a large system: approach V step by step, which is quick; else solve exactly
        V, _ = linalg.bicgstab(A, R, rtol=1e-13, maxiter=1000)  # (n,)
        if (np.abs(A @ V - R) <= 1e-10 * np.maximum(1, np.abs(V))).all():
            return V
    return linalg.spsolve(A, R) if len(R) else R  # (n,), which may be 0


def may_reach(P: sparse.csr_array, goal: np.ndarray) -> np.ndarray:
    """(n,) bool: the states from which a state of `goal` (n,) bool may be reached by P (n, n)."""
    reached, before = goal, None
    while not np.array_equal(reached, before):
        reached, before = reached | (P @ reached > 0), reached
    return reached


def live_states(P: sparse.csr_array, R: np.ndarray, discount: float) -> np.ndarray:
    """(n,) bool: where V^π is to be worked out; elsewhere it is 0. P (n, n) and R (n,) are π's own.

    Exits if the policy has no value.
    """
    if discount < 1:
        return np.ones(len(R), bool)
    # Easy to get wrong: where a policy never ends, I - P is singular and sweeps may not converge.
    live = may_reach(P, np.abs(R) > 1e-9)  # something may still be collected
    # An end: a transition that terminates, or a state after which nothing is collected.
    ends = may_reach(P, (P.sum(axis=1) < 1 - 1e-9) | ~live)
    if not ends.all():
        raise SystemExit("error: at discount 1 the policy has no value: it may collect for ever")
    return live


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


def read_policy(text: str, model: dict) -> np.ndarray:
    """π (S,) int, a row for each state, from `s0=a2 s1=a1`; -1 for a state that is not named."""
    chosen = dict(item.rpartition("=")[::2] for item in text.split())  # {state: action}, without =
    rows = {pair: row for row, pair in enumerate((s, a) for s in model for a in model[s])}
    if unknown := chosen.items() - rows.keys():  # pairs (s, a)
        raise SystemExit(f"error: {unknown} names no state and action of this model")
    return np.array([rows[s, chosen[s]] if s in chosen else -1 for s in model])


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


# ---- main ----------------------------------------------------------------------------------------


def main(args: Args) -> None:
    """Improve the policy that the flags name until it is the best, and report."""
    model, _ = read_model(args)
    P, R, first_row = arrays(model)
    text = args.initial_policy or ("" if args.model or args.env_id else "s0=a2 s1=a1 s2=a1")  # π2
    policy = read_policy(text, model) if text else first_row  # (S,)
    if args.discount == 1 and not text:
        # Easy to get wrong: at discount 1 the first policy needs a value. It rests where that costs
        # nothing. Elsewhere all actions tie, and the rule for ties takes the way that soonest ends.
        idle = idle_rows(P, R, first_row, np.zeros(len(model)))  # (rows,)
        policy, _ = greedy_policy(P, R, first_row, Q=idle - 1.0)  # 0 where idle, else -1
    if policy.min() < 0:
        raise SystemExit("error: --initial-policy needs an action in every state")
    steps = policy_iteration(P, R, first_row, policy, args.discount, args.max_iterations)
    policy, V, Q = steps[-1]
    if len(R) <= 12:  # small enough to be worked through on paper
        shown = [*steps, steps[-1]]  # the lecture's last row: π has not changed
        V_rows = [[f"{round(v, 2):g}" for v in V_i] for _, V_i, _ in shown]
        print_table([f"V_i({s})" for s in model], V_rows)
        rows = [q_row(model, Q_i, V_i, args.discount) for _, V_i, Q_i in shown]
        print_table([f"Q_i({s}, {a})" for s in model for a in model[s]], rows)
        names = [a for s in model for a in model[s]]  # of every row
        print_table([f"π_i({s})" for s in model], [[names[row] for row in π] for π, _, _ in shown])
    residual = np.abs(maximum(Q, first_row) - V).max()
    report(args.output_json, model, V, Q, policy, len(steps), residual)


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")  # a pipe on Windows may not know π
    main(tyro.cli(Args, description=__doc__))
