# /// script
# requires-python = ">=3.10"
# dependencies = [
#     "gymnasium>=1.3", "numpy>=2.0", "pandas>=2.2", "scipy>=1.14", "tqdm>=4.66", "tyro>=0.9",
# ]
# ///
"""Policy iteration: evaluate, improve, repeat (§4.4, Algorithm 4).

Run it
    python algorithms/policy_iteration.py                     # the lecture's MDP, from π2
    python algorithms/policy_iteration.py --env-id FrozenLake-v1
    python algorithms/policy_iteration.py --env-id Taxi-v4 --discount 0.99
    python algorithms/policy_iteration.py --initial-policy "s0=a2 s1=a1 s2=a2"

Measured
    The first command evaluates two policies and finds V* = (11, 1, 4) and π* = (a1, a1, a2). As in
    the lecture, the tables repeat the last. The arithmetic of V_i(s) is that of Q_i(s, π_i(s)).

Deviations
    An action is changed only for a gain of more than 1e-9 · (1 + |max_a Q(s, a)|): of actions that
    tie, an argmax may change for ever. The gain left, max_a Q(s, a) - V(s), is printed as the
    Bellman residual.
    At discount 1, Q(s, a) is raised to 0 for an action a with which the agent can idle for ever. If
    V(s) = -9 and a stays in s for 0, Equation 29 gives Q(s, a) = 0 + V(s) = -9, a tie with V(s),
    but idling is worth 0. Then a table prints 1·[0 + -9] = 0.
    The initial policy is not random. Of Figure 5 it is π2, else the first action everywhere or, at
    discount 1, where a policy that never ends may have no value, one that ends or idles.
    §3 and §4 are undiscounted; here a reward t steps later counts γ^t (--discount).
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
    """An iteration evaluates and improves a policy. V(s) is the expected sum of rewards from
    state s on, in their unit; Q(s, a) the same if the first action is a; π(s) the action in s."""

    model: Path | None = None
    """JSON file: {state: {action: [[probability, next state, reward, terminated], ...]}}"""
    env_id: str = ""
    """Gymnasium environment with a model (unwrapped.P), such as FrozenLake-v1; replaces --model"""
    env_kwargs: str = ""
    """its arguments, such as "map_name=8x8 is_slippery=False"; all but True and False are text"""
    discount: float = 1.0
    """γ in [0, 1], the weight of a reward one step later"""
    initial_policy: str = ""
    """such as "s0=a2 s1=a1 s2=a1", §4.4's π2 and Figure 5's default; else see the deviations"""
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


# ---- algorithm: policy iteration -----------------------------------------------------------------


def backup(P: sparse.csr_array, R: np.ndarray, V: np.ndarray, discount: float) -> np.ndarray:
    """Q (A, S) of the values V (S,)."""
    # Q(s, a) = Σ_s' P(s'|s, a) [R(s, a, s') + γ V(s')]  Equation 29; R is summed already
    future = (P @ (discount * V)).reshape(R.shape)  # (A, S) γ Σ_s' P(s'|s, a) V(s')
    return np.add(R, future, out=future)  # R + future, in place: a new array takes time


def policy_iteration(P, R, policy, discount: float, max_iterations=1000) -> list[tuple]:
    """Algorithm 4 from `policy` (S,) int: [(π (S,), V^π (S,), Q^π (A, S)), ...], of which the last
    is the best.

    Exits if a policy has no value, or if π has not converged after max_iterations.
    """
    steps, states = [], np.arange(len(policy))
    idle = idle_actions(P, R) if discount == 1 else np.zeros(R.shape, bool)  # (A, S)
    for _ in tqdm(range(max_iterations), "policy iteration", delay=2, leave=False):
        # Perform policy evaluation on π to find V^π(s)  Algorithm 4, line 3
        P_π, R_π = P[policy * len(states) + states], R[policy, states]  # (S, S), (S,)
        live, V = live_states(P_π, R_π, discount), np.zeros(len(policy))  # (S,), (S,)
        V[live] = solve_system(P_π[live][:, live], R_π[live], discount)
        Q = backup(P, R, V, discount)  # (A, S)
        Q[idle] = np.maximum(Q[idle], 0)  # idling is worth 0, even where V(s) < 0 now
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
    # (I - γ P) V = R
    A = sparse.eye_array(len(R), format="csc") - discount * P.tocsc()  # (n, n)
    # For a large system BiCGSTAB, an iterative solver that needs little memory. For small ones, and
    # where that does not converge, a direct solver, whose memory may grow with n².
    if len(R) > 1000:
        V, _ = linalg.bicgstab(A, R, rtol=1e-13, maxiter=1000)  # (n,)
        if (np.abs(A @ V - R) <= 1e-10 * np.maximum(1, np.abs(V))).all():
            return V
    return linalg.spsolve(A, R) if len(R) else R  # (n,); n may be 0


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


def idle_actions(P: sparse.csr_array, R: np.ndarray) -> np.ndarray:
    """(A, S) bool: the idle actions, the largest set of them. Each has expected reward 0 and leads,
    unless it ends the episode, to states that have one: the agent can idle for ever, for 0."""
    idle, before = np.ones(R.shape[1], bool), None  # (S,) has an idle action; at first all do
    while not np.array_equal(idle, before):
        # |reward| + the probability to leave them, by one backup; ∞ where there is no action
        actions = backup(P, np.abs(R), ~idle, discount=1) <= 1e-9  # (A, S)
        idle, before = actions.any(axis=0), idle
    return actions


def initial_policy(P: sparse.csr_array, R: np.ndarray, discount: float) -> np.ndarray:
    """The initial π (S,) int. At discount 1 it must have a value: from every state it can reach an
    end, or states in which it idles.

    Exits if no policy does.
    """
    if discount < 1:
        return np.zeros(R.shape[1], int)  # the first action
    idle = idle_actions(P, R)  # (A, S)
    policy, safe, before = idle.argmax(axis=0), idle.any(axis=0), None  # (S,), (S,)
    ends = (P.sum(axis=1) < 1 - 1e-9).reshape(R.shape) & np.isfinite(R)  # (A, S)
    while not np.array_equal(safe, before):
        # From the end backwards: actions that can end, or lead to a state that is safe
        good = ends | ((P @ safe).reshape(R.shape) > 0)  # (A, S)
        policy = np.where(safe, policy, good.argmax(axis=0))  # (S,)
        safe, before = safe | good.any(axis=0), safe  # (S,)
    if not safe.all():
        raise SystemExit("error: no policy has a value at discount 1: a state leads to no end")
    return policy


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


# ---- main ----------------------------------------------------------------------------------------


def main(args: Args) -> None:
    """Improve the policy that the flags name until it is the best, and report."""
    model, _, P, R = read_model(args)
    text = args.initial_policy or ("" if args.model or args.env_id else "s0=a2 s1=a1 s2=a1")  # π2
    policy = read_policy(text, model) if text else initial_policy(P, R, args.discount)  # (S,)
    if policy.min() < 0:
        raise SystemExit("error: --initial-policy needs an action in every state")
    steps = policy_iteration(P, R, policy, args.discount, args.max_iterations)
    if R.size <= 12:  # small enough to be worked through on paper
        shown = [*steps, steps[-1]]  # the lecture's last row: π has not changed
        V_rows = [[f"{round(v, 2):.9g}" for v in V_i] for _, V_i, _ in shown]
        print_table([f"V_i({s})" for s in model], V_rows)
        rows = [q_row(model, Q_i, V_i, args.discount) for _, V_i, Q_i in shown]
        print_table([f"Q_i({s}, {a})" for s in model for a in model[s]], rows)
        names = [list(model[s]) for s in model]  # of the actions
        rows = [[names[i][a] for i, a in enumerate(π)] for π, _, _ in shown]
        print_table([f"π_i({s})" for s in model], rows)
    policy, V, Q = steps[-1]
    report(args.output_json, model, V, Q, policy, len(steps), np.abs(Q.max(axis=0) - V).max())


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")  # a pipe on Windows may not know π
    main(tyro.cli(Args, description=__doc__))
