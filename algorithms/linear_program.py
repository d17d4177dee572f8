# /// script
# requires-python = ">=3.10"
# dependencies = [
#     "gymnasium>=1.3", "numpy>=2.0", "pandas>=2.2", "scipy>=1.14", "tyro>=0.9",
# ]
# ///
"""The Bellman optimality equation as a linear program (§4.3, Equation 27), for few states.

Run it
    python algorithms/linear_program.py                       # the lecture's MDP, its program
    python algorithms/linear_program.py --env-id FrozenLake-v1 --discount 0.99
    python algorithms/linear_program.py --env-id Taxi-v4

Measured
    The first command prints V* = (11, 1, 4), the V* of value iteration.

Deviations
    §3 and §4 are undiscounted; here a reward t steps later counts γ^t (--discount).
    At discount 1, of actions that tie (to 1e-9), the policy takes one that ends: an argmax may walk
    to and fro for ever.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import tyro
from scipy import optimize, sparse

# ---- Args ----------------------------------------------------------------------------------------


@dataclass
class Args:
    """An iteration is one of the solver; a small program may need none. V and Q are sums of
    rewards, in their unit."""

    model: Path | None = None
    """JSON file: {state: {action: [[probability, next state, reward, terminated], ...]}}"""
    env_id: str = ""
    """Gymnasium environment with a model (unwrapped.P), such as FrozenLake-v1; replaces --model"""
    env_kwargs: str = ""
    """its arguments, such as "map_name=8x8 is_slippery=False"; all but True and False are text"""
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


# ---- algorithm: linear program -------------------------------------------------------------------


def linear_program(P, R, discount: float) -> tuple[np.ndarray, int]:
    """Equation 27 as a linear program: V* (S,), and the solver's iterations. Exits if it has none.

    V(s) ≥ the sum in Equation 27 for each action a means V(s) ≥ their maximum. V* is the smallest
    such V: if V(s) were above the maximum in some state, V(s) could be lowered.
    """
    # min Σ_s V(s)  subject to  V(s) ≥ R(s, a) + γ Σ_s' P(s'|s, a) V(s')  for all s and a,
    # that is (γ P - E) V ≤ -R, where E has a 1 in each row's own state
    exists = np.isfinite(R.ravel())  # (A·S,)
    E = sparse.vstack([sparse.eye_array(R.shape[1])] * len(R))  # (A·S, S)
    A, b = (discount * P - E).tocsr()[exists], -R.ravel()[exists]  # a row for each s and a
    # The solver's default tolerance, 1e-7, cannot tell close actions apart; 1e-10 can. A float64
    # has 16 digits, though: beside a reward of 1e9 no solver reaches 1e-10, so ask for less there.
    tolerance = float(np.clip(1e-16 * np.abs(b).max(), 1e-10, 1e-7))
    tolerances = {"primal_feasibility_tolerance": tolerance, "dual_feasibility_tolerance": 1e-10}
    # Easy to get wrong: where the agent can stay for ever for nothing, V ≥ 0. At discount 1 the
    # inequality of an action that stays in s, V(s) ≥ 0 + V(s), does not say so.
    idle = idle_actions(P, R).any(axis=0) & (discount == 1)  # (S,)
    bounds = [(0 if can_idle else None, None) for can_idle in idle]  # (S, 2)
    result = optimize.linprog(np.ones(len(bounds)), A, b, bounds=bounds, options=tolerances)
    # Infeasible: no finite V is large enough, V* is +∞ somewhere. Unbounded: V can fall without
    # limit, V* is -∞ somewhere, or there is none: rewards of -1 and 1 in turns for ever.
    if result.x is None:
        raise SystemExit(f"error: V* is not found: {result.message.splitlines()[0]}")
    return result.x + 0.0, int(result.nit)  # (S,); -0.0 becomes 0.0


def backup(P: sparse.csr_array, R: np.ndarray, V: np.ndarray, discount: float) -> np.ndarray:
    """Q (A, S) of the values V (S,)."""
    # Q(s, a) = Σ_s' P(s'|s, a) [R(s, a, s') + γ V(s')]  Equation 29; R is summed already
    future = (P @ (discount * V)).reshape(R.shape)  # (A, S) γ Σ_s' P(s'|s, a) V(s')
    return np.add(R, future, out=future)  # R + future, in place: a new array takes time


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


def idle_actions(P: sparse.csr_array, R: np.ndarray) -> np.ndarray:
    """(A, S) bool: the idle actions, the largest set of them. Each has expected reward 0 and leads,
    unless it ends the episode, to states that have one: the agent can idle for ever, for 0."""
    idle, before = np.ones(R.shape[1], bool), None  # (S,) has an idle action; at first all do
    while not np.array_equal(idle, before):
        # |reward| + the probability to leave them, by one backup; ∞ where there is no action
        actions = backup(P, np.abs(R), ~idle, discount=1) <= 1e-9  # (A, S)
        idle, before = actions.any(axis=0), idle
    return actions


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


# ---- main ----------------------------------------------------------------------------------------


def main(args: Args) -> None:
    """Solve the MDP that the flags name, and report."""
    model, _, P, R = read_model(args)
    V, iterations = linear_program(P, R, args.discount)
    Q = backup(P, R, V, args.discount)  # (A, S)
    if R.size <= 12:  # small enough to be worked through on paper
        unknowns = {s: f"V({s})" for s in model}
        print("min  " + " + ".join(unknowns.values()) + "  subject to")
        for s, actions in model.items():
            for transitions in actions.values():
                print(f"V({s}) ≥ {worked(transitions, args.discount, unknowns)}")
        for s, idle in zip(model, idle_actions(P, R).T, strict=True):
            if args.discount == 1 and idle.any():
                print(f"V({s}) ≥ 0")
        print()
    # π*(s) = argmax_a Q*(s, a)  Equation 31
    policy = Q.argmax(axis=0) if args.discount < 1 else proper_policy(P, R, Q)  # (S,)
    report(args.output_json, model, V, Q, policy, iterations, np.abs(Q.max(axis=0) - V).max())


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")  # a pipe on Windows may not know π
    main(tyro.cli(Args, description=__doc__))
