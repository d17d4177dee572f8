"""Measure the known-MDP scripts beside QuantEcon's DiscreteDP: time and peak memory.

    pip install -r requirements.txt -r benchmarks/requirements.txt
    python benchmarks/known_mdps.py                     # 10^4, 10^5 and 10^6 states
    python benchmarks/known_mdps.py --sizes 1000

Random MDPs from arrays: 4 actions in every state, 5 successors, discount 0.95; both get the same.
A solve has a process of its own: its peak memory counts libraries and model. Of two solves in turns
the quicker counts. Ratio: ours / theirs. `--solves modified_policy_iteration` has QuantEcon's
quickest, which is not in the lecture, beside our policy iteration. On Linux alone: it tells the
peak memory.
"""

import importlib
import multiprocessing
import platform
import resource
import statistics
import sys
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
import tyro
from machine import cpu_name
from scipy import sparse

sys.path.insert(0, str(Path(__file__).parent.parent / "algorithms"))

ACTIONS, SUCCESSORS, DISCOUNT = 4, 5, 0.95
EPSILON = 1e-6  # the error of V that QuantEcon's value iteration may leave


@dataclass
class Args:
    """Times are in seconds."""

    sizes: tuple[int, ...] = (10_000, 100_000, 1_000_000)
    """numbers of states"""
    sweeps: int = 60
    """Bellman sweeps of each"""
    solves: tuple[str, ...] = ("value_iteration", "policy_iteration", "policy_evaluation")
    """what is solved; modified_policy_iteration, too, can be"""
    limit: float = 170.0
    """seconds until a solve, or all sweeps, are given up, imports and making the model included"""


def random_mdp(size: int, by_state: bool = False) -> tuple[sparse.csr_array, np.ndarray]:
    """P (A·S, S) and R (A, S), the same every time; `by_state`: with the actions of a state side by
    side, P (S·A, S) and R (S, A)."""
    rng, order = np.random.default_rng(0), (size, ACTIONS) if by_state else (ACTIONS, size)
    p, s_next = np.empty((*order, SUCCESSORS)), np.empty((*order, SUCCESSORS), np.int32)
    R = np.empty(order)
    for a in range(ACTIONS):
        at = np.s_[:, a] if by_state else a
        p[at] = rng.random((size, SUCCESSORS))
        s_next[at] = rng.integers(0, size, (size, SUCCESSORS), dtype=np.int32)
        R[at] = rng.random(size)
    p /= p.sum(axis=2, keepdims=True)
    rows = size * ACTIONS
    ends = np.arange(rows + 1, dtype=np.int32) * SUCCESSORS
    return sparse.csr_array((p.ravel(), s_next.ravel(), ends), shape=(rows, size)), R


def their_mdp(size: int):
    """The same as a DiscreteDP of state-action pairs, compiled."""
    from quantecon.markov import DiscreteDP  # here, for the peak memory of ours is without it

    P, R = random_mdp(size, by_state=True)
    pairs = np.repeat(np.arange(size), ACTIONS), np.tile(np.arange(ACTIONS), size)
    ddp = DiscreteDP(R.ravel(), sparse.csr_matrix(P), DISCOUNT, *pairs)
    ddp.solve("value_iteration", max_iter=1)
    return ddp


def bellman_sweeps(size: int, number: int) -> list[float]:
    """Median seconds of a sweep, ours and theirs, in turns of ten in one process."""
    script = importlib.import_module("value_iteration")
    (P, R), ddp = random_mdp(size), their_mdp(size)
    V, V_next = np.random.default_rng(1).random(size), np.empty(size)
    sweeps = (lambda: script.backup(P, R, V, DISCOUNT).max(axis=0),
              lambda: ddp.bellman_operator(V, Tv=V_next))  # fmt: skip
    seconds = [], []
    for turn in range(0, number, 10):
        for who, sweep in enumerate(sweeps):
            sweep()  # not counted: it finds the other's arrays in the cache
            for _ in range(min(10, number - turn)):
                began = time.perf_counter()
                sweep()
                seconds[who].append(time.perf_counter() - began)
    assert np.allclose(sweeps[0](), sweeps[1](), atol=1e-12)
    return [statistics.median(times) for times in seconds]


def our_solve(what: str, size: int) -> tuple[float, int, np.ndarray]:
    """Seconds, iterations and V."""
    what = what.removeprefix("modified_")
    script, (P, R) = importlib.import_module(what), random_mdp(size)
    began, iterations = time.perf_counter(), 1
    if what == "value_iteration":
        # QuantEcon's rule for a change of V; ours is relative to |V|, which is at most 1 / (1 - γ)
        tolerance = EPSILON * (1 - DISCOUNT) ** 2 / (2 * DISCOUNT)
        V, changes = script.value_iteration(P, R, DISCOUNT, tolerance)
        iterations = len(changes)
        script.backup(P, R, V, DISCOUNT).argmax(axis=0)
    elif what == "policy_iteration":  # from the greedy policy of max_a R(s, a), as QuantEcon does
        policy = script.backup(P, R, R.max(axis=0), DISCOUNT).argmax(axis=0)
        steps = script.policy_iteration(P, R, policy, DISCOUNT)
        V, iterations = steps[-1][1], len(steps)
    else:  # the first action everywhere
        V = script.solve_system(P[:size], R[0], DISCOUNT)
    return time.perf_counter() - began, iterations, V


def their_solve(what: str, size: int) -> tuple[float, int, np.ndarray]:
    """Seconds, iterations and V."""
    ddp = their_mdp(size)
    began = time.perf_counter()
    if what == "policy_evaluation":
        V, iterations = ddp.evaluate_policy(np.zeros(size, int)), 1
    else:
        result = ddp.solve(what, epsilon=EPSILON, max_iter=100_000)
        V, iterations = result.v, result.num_iter
    return time.perf_counter() - began, iterations, V


def peak_memory() -> float:
    """Peak memory of this process in GB, on Linux."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def apart(limit: float, function, *arguments):
    """The function's result and its peak memory, from a process of its own; None: given up."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        try:
            result = pool.apply_async(function, arguments).get(limit), pool.apply(peak_memory)
            pool.close()
            pool.join()
            return result
        except (multiprocessing.TimeoutError, MemoryError):
            return None


def in_turns(limit: float, what: str, size: int) -> list:
    """The quicker of two solves of ours and of QuantEcon's, in turns; None: given up."""
    solves, found = (our_solve, their_solve), ([], [])
    for _ in range(2):
        for solve, solved in zip(solves, found, strict=True):
            if None not in solved:
                solved.append(apart(limit, solve, what, size))
    return [None if None in solved else min(solved, key=lambda one: one[0][0]) for solved in found]


def main(args: Args) -> None:
    """Print one line for each measurement."""
    versions = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy", "quantecon"))
    print(f"{cpu_name()}; Python {platform.python_version()}, {versions}")
    given_up = f"given up after {args.limit:g} s, or out of memory"
    for size in args.sizes:
        print(f"{size:,} states")
        text, sweeps = given_up, apart(args.limit, bellman_sweeps, size, args.sweeps)
        if sweeps:
            (ours, theirs), _ = sweeps
            text = f"{1e3 * ours:.3g} ms; QuantEcon {1e3 * theirs:.3g} ms"
            text += f"; ratio {ours / theirs:.2g}"
        print(f"  bellman_sweep: {text}", flush=True)
        for what in args.solves:
            found = in_turns(args.limit, what, size)
            for who, one in zip(("", "QuantEcon "), found, strict=True):
                text = given_up
                if one:
                    (seconds, iterations, _), memory = one
                    text = f"{seconds:.3g} s, {iterations} iterations, {memory:.2f} GB"
                print(f"  {what}: {who}{text}", flush=True)
            if all(found):
                (ours, _, V), (theirs, _, their_V) = found[0][0], found[1][0]
                difference = np.abs(V - their_V).max()
                print(f"  {what}: ratio {ours / theirs:.2g}, V differ by {difference:.1e}")


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")
    main(tyro.cli(Args, description=__doc__))
