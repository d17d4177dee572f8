# /// script
# requires-python = ">=3.10"
# dependencies = [
#     "gymnasium>=1.0", "numpy>=2.0", "pandas>=2.2", "scipy>=1.14", "tqdm>=4.66", "tyro>=0.9",
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

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
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

# `arrays`, below, makes of it R (A, S) and P (A·S, S), sparse: S rows for each action. Figure 5:
#                P: s0   s1   s2    R: Σ_s' P(s'|s, a) R(s, a, s')
#     a1, s0         .    1    .    10
#     a1, s1         .    .    .     1
#     a1, s2         .    .    .     1
#     a2, s0         .   .6   .4     8 = 0.6 · 10 + 0.4 · 5
#     a2, s1         .    .    .    -∞: s1 has no second action; -∞ is never the largest Q
#     a2, s2        .3    .    .     0.7 = 0.7 · 1 + 0.3 · 0
# A transition that terminates is left out of P, for nothing comes after it. So a row's sum is the
# chance to go on, and sG has no row, no column, and V = 0.


# ---- algorithm: policy iteration -----------------------------------------------------------------


def backup(P: sparse.csr_array, R: np.ndarray, V: np.ndarray, discount: float) -> np.ndarray:
    """Q (A, S) of the values V (S,)."""
    # Q(s, a) = Σ_s' P(s'|s, a) [R(s, a, s') + γ V(s')]  Equation 29; R is summed already
    Q = (P @ (discount * V)).reshape(R.shape)  # (A, S)
    return np.add(R, Q, out=Q)  # R + Q without a copy, which at 10^6 states is a third of the time


def policy_iteration(P, R, policy, discount: float, max_iterations=1000) -> list[tuple]:
    """Algorithm 4 from `policy` (S,) int: [(π (S,), V^π (S,), Q^π (A, S)), ...], of which the last
    is the best.

    Exits if a policy has no value, or if π has not converged after max_iterations.
    """
    steps, states = [], np.arange(len(policy))
    for _ in tqdm(range(max_iterations), "policy iteration", delay=2, leave=False):
        # Perform policy evaluation on π to find V^π(s)  Algorithm 4, line 3
        P_π, R_π = P[policy * len(states) + states], R[policy, states]  # (S, S), (S,)
        live, V = live_states(P_π, R_π, discount), np.zeros(len(policy))  # (S,), (S,)
        V[live] = solve_system(P_π[live][:, live], R_π[live], discount)
        Q = backup(P, R, V, discount)  # (A, S)
        steps.append((policy, V, Q))
        # Easy to get wrong: an action that only ties is not taken, or π may change for ever.
        gain = ~np.isclose(Q[policy, states], Q.max(axis=0), rtol=1e-9, atol=1e-9)  # (S,)
        if not gain.any():
            return steps
        # π(s) = argmax_a Q^π(s, a)  Algorithm 4, line 5
        policy = np.where(gain, Q.argmax(axis=0), policy)  # (S,)
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


def greedy_policy(P, R, Q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At discount 1: π (S,) int and where it may end (S,) bool. Of the best actions that tie, π
    takes one that soonest ends, or rests for nothing."""
    V = Q.max(axis=0)  # (S,)
    tied = np.isclose(Q, V, rtol=1e-9, atol=1e-9)  # (A, S)
    # Easy to get wrong: walking to and fro ties with walking to the goal. So a second MDP decides,
    # by value iteration again: of the tied actions alone, an end is worth 1, and γ = 0.995.
    ends = (1 - P.sum(axis=1)).round(8).reshape(R.shape)  # (A, S) the chance to end
    rests = backup(P, np.abs(R), np.abs(V), discount=1) <= 1e-9  # (A, S) an end, too: V stays 0
    V_end, V_old = np.zeros(len(V)), None  # (S,)
    while not np.array_equal(V_end, V_old):
        Q_end = np.where(tied, 0.995 * np.where(rests, 1, backup(P, ends, V_end, 1)), -1)  # (A, S)
        V_end, V_old = Q_end.max(axis=0), V_end  # (S,)
    return Q_end.argmax(axis=0), V_end > 0


def idle_actions(P: sparse.csr_array, R: np.ndarray) -> np.ndarray:
    """(A, S) bool: actions whose expected reward is 0, and that end or lead to states alone where
    some action is idle again: the agent may rest there for ever."""
    idle, before = np.ones(R.shape[1], bool), None  # (S,)
    while not np.array_equal(idle, before):
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
        model, env = json.loads(args.model.read_text("utf-8")) if args.model else FIGURE_5, None
        if args.env_id:
            items = (item.split("=") for item in args.env_kwargs.split())
            kwargs = {k: {"true": True, "false": False}.get(v.lower(), v) for k, v in items}
            env = gym.make(args.env_id, **kwargs).unwrapped
            model = env.P
        # Names are text, as in JSON. A state without an action is terminal.
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
    index = {s: i for i, s in enumerate(model)}
    for s, i in index.items():
        for k, (a, transitions) in enumerate(model[s].items()):
            try:
                R[k, i] = sum(p * reward for p, _, reward, _ in transitions)
                for p, s_next, _, terminated in transitions:
                    if going_on := p * (1 - terminated):  # nothing comes after an end
                        P[k * S + i, index[str(s_next)]] += going_on
                p = [transition[0] for transition in transitions]
                if not (min(p) >= 0 and abs(sum(p) - 1) <= 1e-9 and np.isfinite(R[k, i])):
                    raise ValueError
            except Exception:  # wrong numbers, an unknown next state, or not four values
                raise SystemExit(f"error: state {s}, action {a}: invalid {transitions}") from None
    return P.tocsr(), R


def read_policy(text: str, model: dict) -> np.ndarray:
    """π (S,) int from `s0=a2 s1=a1`; -1 for a state that is not named."""
    chosen = dict(item.rpartition("=")[::2] for item in text.split())  # {state: action}, without =
    if unknown := chosen.items() - {(s, a) for s in model for a in model[s]}:
        raise SystemExit(f"error: {unknown} names no state and action of this model")
    return np.array([list(model[s]).index(chosen[s]) if s in chosen else -1 for s in model])


def worked(transitions: list, discount: float, V: dict[str, str]) -> str:
    """Σ_s' P(s'|s, a) [R(s, a, s') + γ V(s')] as text, `0.6·[10 + 0] + 0.4·[5 + 0]`."""
    γ = "" if discount == 1 else f"{discount:g}·"
    terms = [f"{p:g}·[{r:g} + {γ}{'0' if end else V[str(s)]}]" for p, s, r, end in transitions]
    return " + ".join(terms)


def print_table(header: list[str], rows: list[list[str]]) -> None:
    """Print the rows i = 0, 1, ... of a table of the lecture."""
    print(pd.DataFrame(rows, columns=header).rename_axis(columns="i").to_string(), "\n")


def q_row(model: dict, Q: np.ndarray, V: np.ndarray, discount: float) -> list[str]:
    """A row of the lecture's table of Q_i(s, a) (A, S), worked out from V_i (S,)."""
    texts = {s: f"{round(v, 2):g}" for s, v in zip(model, V, strict=True)}
    pairs = [(t, Q[a, i]) for i, s in enumerate(model) for a, t in enumerate(model[s].values())]
    return [f"{worked(t, discount, texts)} = {round(q, 2):g}" for t, q in pairs]


def report(path: Path | None, model: dict, V, Q, policy, iterations: int) -> None:
    """Print V (S,) and π (S,), and write them with Q (A, S) to `path`. NaN is undefined. The
    Bellman residual is the largest |Q(s, π(s)) - V(s)|."""
    values, q = (np.where(np.isnan(x), None, x).tolist() for x in (V, Q.T))
    solution = {  # in JSON, undefined is null
        "values": dict(zip(model, values, strict=True)),
        "action_values": {s: dict(zip(model[s], q[i], strict=False)) for i, s in enumerate(model)},
        "policy": {s: list(model[s])[a] for s, a in zip(model, policy, strict=True) if a >= 0},
        "iterations": iterations,
        "residual": float(np.nanmax(np.abs(Q[policy, np.arange(len(V))] - V))),
    }
    table = pd.DataFrame({"V(s)": solution["values"], "π(s)": solution["policy"]}).head(20)
    print(table.to_string(float_format="{:.12g}".format, na_rep="undefined"))
    print(f"{iterations} iterations, Bellman residual {solution['residual']:.2g}")
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(solution, indent=1) + "\n", "utf-8")


# ---- main ----------------------------------------------------------------------------------------


def main(args: Args) -> None:
    """Improve the policy that the flags name until it is the best, and report."""
    model, _, P, R = read_model(args)
    text = args.initial_policy or ("" if args.model or args.env_id else "s0=a2 s1=a1 s2=a1")  # π2
    policy = read_policy(text, model) if text else np.zeros(len(model), int)  # (S,)
    if args.discount == 1 and not text:
        # Easy to get wrong: at discount 1 the first policy needs a value. It rests where that costs
        # nothing. Elsewhere all actions tie, and the rule for ties takes the way that soonest ends.
        tie = np.where(np.isfinite(R), -1, R)  # (A, S) Q of nothing but ties
        policy, _ = greedy_policy(P, R, Q=np.where(idle_actions(P, R), 0, tie))
    if policy.min() < 0:
        raise SystemExit("error: --initial-policy needs an action in every state")
    steps = policy_iteration(P, R, policy, args.discount, args.max_iterations)
    if R.size <= 12:  # small enough to be worked through on paper
        shown = [*steps, steps[-1]]  # the lecture's last row: π has not changed
        V_rows = [[f"{round(v, 2):g}" for v in V_i] for _, V_i, _ in shown]
        print_table([f"V_i({s})" for s in model], V_rows)
        rows = [q_row(model, Q_i, V_i, args.discount) for _, V_i, Q_i in shown]
        print_table([f"Q_i({s}, {a})" for s in model for a in model[s]], rows)
        names = [list(model[s]) for s in model]  # of the actions
        rows = [[names[i][a] for i, a in enumerate(π)] for π, _, _ in shown]
        print_table([f"π_i({s})" for s in model], rows)
    policy, V, Q = steps[-1]
    report(args.output_json, model, V, Q, policy, len(steps))


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")  # a pipe on Windows may not know π
    main(tyro.cli(Args, description=__doc__))
