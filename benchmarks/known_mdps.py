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
    """seconds after which a solve is given up, imports and the making of the model included"""


def our_mdp(size: int) -> tuple[sparse.csr_array, np.ndarray]:
    """P (A·S, S) and R (A, S), the same every time."""
    rng, rows = np.random.default_rng(0), size * ACTIONS
    p = rng.random((rows, SUCCESSORS))
    p /= p.sum(axis=1, keepdims=True)
    s_next = rng.integers(0, size, rows * SUCCESSORS, dtype=np.int32)
    ends = np.arange(rows + 1, dtype=np.int32) * SUCCESSORS
    P = sparse.csr_array((p.ravel(), s_next, ends), shape=(rows, size))
    return P, rng.random((ACTIONS, size))


def their_mdp(size: int):
    """The same as a DiscreteDP of state-action pairs, compiled."""
    from quantecon.markov import DiscreteDP  # here, for the peak memory of ours is without it

    P, R = our_mdp(size)
    pairs = np.repeat(np.arange(size), ACTIONS), np.tile(np.arange(ACTIONS), size)
    by_state = pairs[1] * size + pairs[0]  # its order: the actions of a state stand together
    ddp = DiscreteDP(R.ravel()[by_state], sparse.csr_matrix(P[by_state]), DISCOUNT, *pairs)
    ddp.solve("value_iteration", max_iter=1)
    return ddp


def bellman_sweeps(size: int, number: int) -> list[float]:
    """Median seconds of a sweep, ours and theirs, in turns of ten in one process."""
    script = importlib.import_module("value_iteration")
    (P, R), ddp = our_mdp(size), their_mdp(size)
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
    script, (P, R) = importlib.import_module(what), our_mdp(size)
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


def apart(limit: float | None, function, *arguments):
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
    for size in args.sizes:
        print(f"{size:,} states")
        (ours, theirs), _ = apart(None, bellman_sweeps, size, args.sweeps)
        times = f"{1e3 * ours:.3g} ms; QuantEcon {1e3 * theirs:.3g} ms"
        print(f"  bellman_sweep: {times}; ratio {ours / theirs:.2g}", flush=True)
        for what in args.solves:
            found = in_turns(args.limit, what, size)
            for who, one in zip(("", "QuantEcon "), found, strict=True):
                text = f"given up after {args.limit:g} s, or out of memory"
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
