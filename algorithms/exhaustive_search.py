# /// script
# requires-python = ">=3.10"
# dependencies = [
#     "gymnasium>=1.3", "numpy>=2.0", "pandas>=2.2", "scipy>=1.14", "tqdm>=4.66", "tyro>=0.9",
# ]
# ///
"""Exhaustive search: the best policy, by evaluating every one (§4.2, Algorithm 2).

Run it
    python algorithms/exhaustive_search.py                    # the lecture's MDP has three policies
    python algorithms/exhaustive_search.py --env-id FrozenLake-v1 --env-kwargs is_slippery=False
    python algorithms/exhaustive_search.py --model my_mdp.json --discount 0.95

Measured
    The first command evaluates 3 policies and finds π1 with V(s0) = 11.

Deviations
    A policy needs actions only in states that it reaches: Figure 5 has three policies, as in §3.2.
    The bound of §4.2, Π_s |A_s|, is 2 · 1 · 2 = 4 here.
    Every evaluation starts from the values of the policies before it, as §4.2 suggests. Each policy
    is also evaluated from V = 0, to show how many sweeps that saves.
    §3 and §4 are undiscounted; here a reward t steps later counts γ^t (--discount). A policy that
    has no value (at discount 1 it may collect for ever) is an error.
"""

import itertools
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import tyro
from scipy import sparse
from tqdm import tqdm, trange

# ---- Args ----------------------------------------------------------------------------------------


@dataclass
class Args:
    """A sweep is over a policy's states. V(s) is the expected sum of rewards from state s on, in
    their unit; π(s) the action in s. The iterations in the report are policies."""

    model: Path | None = None
    """JSON file: {state: {action: [[probability, next state, reward, terminated], ...]}}"""
    env_id: str = ""
    """Gymnasium environment with a model (unwrapped.P), such as FrozenLake-v1; replaces --model"""
    env_kwargs: str = ""
    """its arguments, such as "map_name=8x8 is_slippery=False"; all but True and False are text"""
    discount: float = 1.0
    """γ in [0, 1], the weight of a reward one step later"""
    max_policies: int = 10_000
    """refuse an MDP that has more policies"""
    tolerance: float = 1e-12
    """V has converged when no V(s) changes by more than this in a sweep (relative to |V(s)|, if
    above 1); the error of V may be larger"""
    max_iterations: int = 100_000
    """sweeps after which to give up"""
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


# ---- algorithm: exhaustive search ----------------------------------------------------------------


def policies(P: sparse.csr_array, R: np.ndarray, start: np.ndarray) -> Iterator[np.ndarray]:
    """Every policy once, (S,) int: the index of an action in each state it reaches, else -1."""
    stack = [np.full(len(start), -1)]  # of (S,)
    while stack:
        policy = stack.pop()
        # A state needs an action only once it is reached: s0 at first, s2 only after a2 in s0.
        decided = np.flatnonzero(policy >= 0)  # indices of states
        reached = (start > 0) | (P[policy[decided] * len(policy) + decided].sum(axis=0) > 0)  # (S,)
        undecided = np.flatnonzero(reached & (policy < 0))  # indices of states
        if len(undecided) == 0:
            yield policy
            continue
        s = undecided[0]
        for a in np.flatnonzero(np.isfinite(R[:, s]))[::-1]:  # so the first action is popped first
            stack.append(policy.copy())
            stack[-1][s] = a


def evaluate_policy(P, R, policy, warm: np.ndarray, args: Args) -> tuple[np.ndarray, int, int]:
    """Of π (S,): V^π (S,), which is NaN in states that π never reaches, the number of sweeps that
    it took from `warm` (S,), and how many it takes from V = 0."""
    states = np.flatnonzero(policy >= 0)  # (n,)
    rows = policy[states] * len(policy) + states  # (n,) of P: a·S + s
    P_π, R_π = P[rows][:, states], R[policy[states], states]  # (n, n), (n,)
    live = live_states(P_π, R_π, args.discount)  # (n,)
    states, P_π, R_π = states[live], P_π[live][:, live], R_π[live]  # (m,), (m, m), (m,)
    V = np.where(policy >= 0, 0.0, np.nan)  # (S,)
    V[states], sweeps = iterative_policy_evaluation(P_π, R_π, warm[states], args)
    _, sweeps_from_0 = iterative_policy_evaluation(P_π, R_π, np.zeros(len(states)), args)
    return V, sweeps, sweeps_from_0


def exhaustive_search(P, R, start: np.ndarray, args: Args) -> tuple:
    """Algorithm 2: π* (S,), V* (S,) and, of every policy, (V^π(start), sweeps, sweeps from 0).

    Exits for more than --max-policies policies, and if one has no value.
    """
    candidates = list(itertools.islice(policies(P, R, start), args.max_policies + 1))
    if len(candidates) > args.max_policies:
        raise SystemExit(f"error: there are more than {args.max_policies} policies")
    current_max, best, tried = -np.inf, None, []
    warm = np.zeros(len(start))  # (S,) where the next evaluation starts
    for policy in tqdm(candidates, "exhaustive search", unit=" policies", delay=2, leave=False):
        V, sweeps, sweeps_from_0 = evaluate_policy(P, R, policy, warm, args)  # Algorithm 2, line 5
        warm = np.where(policy >= 0, V, warm)  # close, for policies have much in common
        value = start[start > 0] @ V[start > 0]  # elsewhere V may be NaN
        tried.append((value, sweeps, sweeps_from_0))
        if current_max < value:  # lines 6-9
            current_max, best = value, (policy, V)
    return *best, tried


def iterative_policy_evaluation(P, R, V, args: Args) -> tuple[np.ndarray, int]:
    """Algorithm 1 from V (n,): V^π (n,), and the number of sweeps.

    P (n, n) and R (n,) are the policy's own. Exits if V has not converged after --max-iterations.
    """
    for sweep in trange(1, args.max_iterations + 1, desc="sweeps", delay=2, leave=False):
        # V_{i+1}(s) = Σ_s' P(s'|s, π(s)) [R(s, π(s), s') + γ V_i(s')]  Algorithm 1, line 7
        V, V_old = R + args.discount * (P @ V), V  # (n,)
        if (np.abs(V - V_old) <= args.tolerance * np.maximum(1, np.abs(V))).all():
            return V, sweep
    raise SystemExit(f"error: V has not converged in {args.max_iterations} sweeps")


def backup(P: sparse.csr_array, R: np.ndarray, V: np.ndarray, discount: float) -> np.ndarray:
    """Q (A, S) of the values V (S,)."""
    # Q(s, a) = Σ_s' P(s'|s, a) [R(s, a, s') + γ V(s')]  Equation 29; R is summed already
    future = (P @ (discount * V)).reshape(R.shape)  # (A, S) γ Σ_s' P(s'|s, a) V(s')
    return np.add(R, future, out=future)  # R + future, in place: a new array takes time


def can_reach(P: sparse.csr_array, goal: np.ndarray) -> np.ndarray:
    """(n,) bool: the states from which a state of `goal` (n,) bool can be reached by P (n, n)."""
    reaches, before = goal, None  # in 0 steps
    while not np.array_equal(reaches, before):
        reaches, before = reaches | (P @ reaches > 0), reaches  # in one step more
    return reaches


def live_states(P: sparse.csr_array, R: np.ndarray, discount: float) -> np.ndarray:
    """(n,) bool: where V^π is to be worked out; elsewhere it is 0. P (n, n) and R (n,) are π's own.

    Exits if the policy has no value.
    """
    if discount < 1:
        return np.ones(len(R), bool)
    # Easy to get wrong: of a state that goes to itself for ever, Equation 3 says V = V + R. It has
    # no solution where R is not 0, and where R is 0 any V solves it: I - P is singular.
    live = can_reach(P, np.abs(R) > 1e-9)  # a reward other than 0 can still come
    # An end is a transition that terminates, or a state from which no reward comes. If one can be
    # reached from every state, π reaches one with probability 1: there are finitely many states.
    ends = can_reach(P, (P.sum(axis=1) < 1 - 1e-9) | ~live)
    if not ends.all():
        raise SystemExit("error: at discount 1 the policy has no value: it may collect for ever")
    return live


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
    """Try every policy of the MDP that the flags name, and report the best."""
    model, env, P, R = read_model(args)
    start = getattr(env, "initial_state_distrib", np.eye(1, len(model))[0])  # (S,), else 1, 0, 0, …
    policy, V, tried = exhaustive_search(P, R, start, args)
    for i, (π, counts) in enumerate(zip(policies(P, R, start), tried[:10], strict=False), start=1):
        actions = [f"{s}={list(model[s])[a]}" for s, a in zip(model, π, strict=True) if a >= 0]
        value, sweeps, sweeps_from_0 = counts
        print(f"π{i}: V of the start {value:.12g}, {sweeps} sweeps, {sweeps_from_0} from V = 0; "
              f"{' '.join(actions)}")
    _, sweeps, sweeps_from_0 = np.sum(tried, axis=0)
    print(f"{len(tried)} policies, {sweeps:.0f} sweeps, {sweeps_from_0:.0f} from V = 0\n")
    Q = backup(P, R, V, args.discount)  # (A, S)
    residual = np.nanmax(np.abs(Q[policy, np.arange(len(V))] - V))
    report(args.output_json, model, V, Q, policy, len(tried), residual)


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")  # a pipe on Windows may not know π
    main(tyro.cli(Args, description=__doc__))
