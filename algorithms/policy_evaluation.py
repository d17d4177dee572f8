# /// script
# requires-python = ">=3.10"
# dependencies = [
#     "gymnasium>=1.3", "numpy>=2.0", "pandas>=2.2", "scipy>=1.14", "tqdm>=4.66", "tyro>=0.9",
# ]
# ///
"""Policy evaluation: the value of a policy of a known Markov decision process (§3, Algorithm 1).

By the linear system of Equations 2 and 3, and iteratively.

Run it
    python algorithms/policy_evaluation.py                    # π1, π2, π3 of §3.2 and their tables
    python algorithms/policy_evaluation.py --policy "s0=a2 s1=a1 s2=a2"
    python algorithms/policy_evaluation.py --env-id FrozenLake-v1     # always left: V = 0
    python algorithms/policy_evaluation.py --model my_mdp.json --discount 0.95

Measured
    The first command prints V(s0) = 11, 9 and 111/11, and V(s2) = 41/11 for π3.

Deviations
    §3 and §4 are undiscounted; here a reward t steps later counts γ^t (--discount).
    At discount 1, V is 0 where all expected rewards to come are 0 (to 1e-9), and a policy that may
    get others for ever has no value: an error. V is undefined in states that π never reaches.
"""

import json
import sys
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import tyro
from scipy import sparse
from scipy.sparse import linalg
from tqdm import trange

# ---- Args ----------------------------------------------------------------------------------------


@dataclass
class Args:
    """A sweep is over the states that the policy reaches. V(s) is the expected sum of rewards from
    state s on, in their unit; π(s) the action in s."""

    model: Path | None = None
    """JSON file: {state: {action: [[probability, next state, reward, terminated], ...]}}"""
    env_id: str = ""
    """Gymnasium environment with a model (unwrapped.P), such as FrozenLake-v1; replaces --model"""
    env_kwargs: str = ""
    """its arguments, such as "map_name=8x8 is_slippery=False"; all but True and False are text"""
    discount: float = 1.0
    """γ in [0, 1], the weight of a reward one step later"""
    policy: str = ""
    """such as "s0=a1 s1=a1"; else π1, π2 and π3 of the lecture, or the first action everywhere"""
    tolerance: float = 1e-12
    """V has converged when no V(s) changes by more than this in a sweep (relative to |V(s)|, if
    above 1); the error of V may be larger"""
    max_iterations: int = 100_000
    """sweeps after which to give up"""
    output_json: Path | None = None
    """write values, action values and policy to this file (of Figure 5, without --policy: π3's)"""


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


# ---- algorithm: policy evaluation ----------------------------------------------------------------


def policy_evaluation(P, R, policy, args: Args) -> tuple[np.ndarray, np.ndarray, int]:
    """V^π (S,) by Algorithm 1, V^π (S,) by the linear system, and the number of sweeps.

    π (S,) int has the index of an action in each of the n states that it reaches, elsewhere -1; V
    is NaN there. V is computed in m of the n states. In the rest no more reward comes, and V is 0.
    """
    states = np.flatnonzero(policy >= 0)  # (n,)
    rows = policy[states] * len(policy) + states  # (n,) of P: a·S + s
    P_π, R_π = P[rows][:, states], R[policy[states], states]  # (n, n), (n,)
    live = live_states(P_π, R_π, args.discount)  # (n,)
    states, P_π, R_π = states[live], P_π[live][:, live], R_π[live]  # (m,), (m, m), (m,)
    V = np.where(policy >= 0, 0.0, np.nan)  # (S,)
    exact = V.copy()  # (S,)
    V[states], sweeps = iterative_policy_evaluation(P_π, R_π, np.zeros(len(states)), args)
    exact[states] = solve_system(P_π, R_π, args.discount)
    return V, exact, sweeps


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


def solve_system(P: sparse.csr_array, R: np.ndarray, discount: float) -> np.ndarray:
    """V (n,) of Equation 3, V = R + γ P V, as a linear system; P (n, n), R (n,)."""
    # (I - γ P) V = R
    A = sparse.eye_array(len(R), format="csc") - discount * P.tocsc()  # (n, n)
    # For a large system BiCGSTAB, an iterative solver that needs little memory. For small ones, and
    # where that does not converge, a direct solver, whose memory may grow with n².
    if len(R) > 1000:
        V, _ = linalg.bicgstab(A, R, rtol=1e-13, maxiter=1000)  # (n,)
        if (np.abs(A @ V - R) <= 1e-10 * np.maximum(1, np.abs(V))).all():
            return V
    return linalg.spsolve(A, R) if len(R) else R  # (n,); n may be 0


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


def read_policy(text: str, model: dict) -> np.ndarray:
    """π (S,) int from `s0=a2 s1=a1`; -1 for a state that is not named."""
    # {state: action}, the parts before and after the last =
    chosen = dict(item.rpartition("=")[::2] for item in text.split())
    if unknown := chosen.items() - {(s, a) for s in model for a in model[s]}:
        raise SystemExit(f"error: {unknown} names no state and action of this model")
    return np.array([list(model[s]).index(chosen[s]) if s in chosen else -1 for s in model])


def worked(transitions: list, discount: float, V: dict[str, str]) -> str:
    """Σ_s' P(s'|s, a) [R(s, a, s') + γ V(s')] as text, `0.6·[10 + 0] + 0.4·[5 + 0]`."""
    γ = "" if discount == 1 else f"{discount:g}·"
    terms = [f"{p:g}·[{r:.9g} + {γ}{'0' if end else V[str(s)]}]" for p, s, r, end in transitions]
    return " + ".join(terms)


def print_table(header: list[str], rows: list[list[str]]) -> None:
    """Print the rows i = 0, 1, ... of a table of the lecture."""
    print(pd.DataFrame(rows, columns=header).rename_axis(columns="i").to_string(), "\n")


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


def print_evaluation(model: dict, P, R, policy, discount: float, exact, sweeps: int) -> None:
    """Equation 3 of the states that π (S,) reaches, its solution `exact` (S,), and the lecture's
    table of the first sweeps. π is -1 in states that it never reaches."""
    chosen = {s: list(model[s].values())[a] for s, a in zip(model, policy, strict=True) if a >= 0}
    unknowns = {s: f"V({s})" for s in model}
    for s, v in zip(chosen, exact[policy >= 0], strict=True):
        fraction = Fraction(v).limit_denominator(10_000)
        text = fraction if abs(fraction - v) <= 1e-12 else f"{v:.12g}"
        print(f"V({s}) = {worked(chosen[s], discount, unknowns)} = {text}")
    print()
    table, V = [["0"] * len(chosen)], np.zeros(len(model))  # (S,)
    for _ in range(min(sweeps, 9)):  # once more, to be printed
        texts = {s: f"{round(v, 2):.9g}" for s, v in zip(model, V, strict=True)}
        V = np.where(policy >= 0, backup(P, R, V, discount)[policy, np.arange(len(V))], 0)  # (S,)
        cells = {s: f"{round(v, 2):.9g}" for s, v in zip(model, V, strict=True)}
        table.append([f"{worked(chosen[s], discount, texts)} = {cells[s]}" for s in chosen])
    print_table([f"V_i({s})" for s in chosen], table)


# ---- main ----------------------------------------------------------------------------------------


def main(args: Args) -> None:
    """Evaluate the policy that the flags name (of Figure 5, all three), and report."""
    model, env, P, R = read_model(args)
    start = getattr(env, "initial_state_distrib", np.eye(1, len(model))[0])  # (S,), else 1, 0, 0, …
    named = args.policy or args.model or args.env_id  # else π1, π2 and π3 of §3.2
    texts = [args.policy] if named else ["s0=a1 s1=a1", "s0=a2 s1=a1 s2=a1", "s0=a2 s1=a1 s2=a2"]
    for text in texts:
        policy = read_policy(text, model) if text else np.zeros(len(model), int)  # (S,)
        # The policy graph (§3.2): the states to which the start leads. In the transpose, where
        # every step goes backwards, they are those that can reach the start.
        rows = policy * len(model) + np.arange(len(model))  # (S,) of P: a·S + s
        reached = can_reach(P[rows].T, start > 0)  # (S,)
        # Where --policy names no action, π is -1 and the row is -S + s, counted from the end: one
        # of the last action. No matter which: if such a state is reached, that is an error.
        if policy[reached].min() < 0:
            raise SystemExit("error: --policy reaches a state for which it names no action")
        policy = np.where(reached, policy, -1)  # (S,)
        V, exact, sweeps = policy_evaluation(P, R, policy, args)
        if R.size <= 12:  # small enough to be worked through on paper
            print_evaluation(model, P, R, policy, args.discount, exact, sweeps)
        path = args.output_json if text == texts[-1] else None
        Q = backup(P, R, V, args.discount)  # (A, S); NaN of actions that lead to unreached states
        report(path, model, V, Q, policy, sweeps, np.abs(Q.ravel()[rows] - V)[reached].max())
        print(f"The linear system differs by {np.abs(V - exact)[reached].max():.2g}\n")


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")  # a pipe on Windows may not know π
    main(tyro.cli(Args, description=__doc__))
