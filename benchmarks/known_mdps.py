"""The known-MDP scripts beside QuantEcon's DiscreteDP: a Bellman sweep, whole solves, policy evaluation, peak memory.

    pip install -r requirements.txt -r benchmarks/requirements.txt
    python benchmarks/known_mdps.py                          # 10^4, 10^5 and 10^6 states
    python benchmarks/known_mdps.py --sizes 10000 --linear-program

Random sparse MDPs: 4 actions in every state, 5 successors drawn at random, discount 0.95. The same arrays go to both;
both stop value iteration at the same change of V, γ/(1-γ) of which is at most ε/2. Each solve runs in a process of its
own, which gives its peak memory (libraries and model included) and a time limit; the sweeps of the two run in turns in
one process, ten each, of which the first, which finds the other's arrays in the cache, is not counted.
"""

import importlib
import math
import multiprocessing
import platform
import statistics
import sys
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
import scipy
import tyro
from scipy import sparse

sys.path.insert(0, str(Path(__file__).parent.parent / "algorithms"))  # imported where needed: memory is measured

ACTIONS, SUCCESSORS = 4, 5


@dataclass
class Args:
    sizes: tuple[int, ...] = (10_000, 100_000, 1_000_000)
    """numbers of states"""
    discount: float = 0.95
    """γ"""
    epsilon: float = 1e-6
    """ε, largest error of V that value iteration may leave, as QuantEcon defines it"""
    repeats: int = 60
    """sweeps of each, in turns of ten"""
    limit: float = 170.0
    """seconds after which a solve, imports and making of the model included, is given up"""
    linear_program: bool = False
    """also the linear program (at 10^4 states it is given up)"""
    seed: int = 0
    """of the random MDP"""


def random_arrays(size: int, seed: int) -> tuple[sparse.csr_array, np.ndarray]:
    """P (size · ACTIONS, size) and R (size · ACTIONS,), the same for the same seed."""
    rng = np.random.default_rng(seed)
    rows = size * ACTIONS
    P = rng.random((rows, SUCCESSORS))
    P /= P.sum(axis=1, keepdims=True)
    indices = rng.integers(0, size, rows * SUCCESSORS, dtype=np.int32)
    indptr = np.arange(rows + 1, dtype=np.int32) * SUCCESSORS
    return sparse.csr_array((P.ravel(), indices, indptr), shape=(rows, size)), rng.random(rows)


def our_mdp(module, size: int, seed: int):
    """The MDP of one of our scripts, from arrays alone."""
    P, R = random_arrays(size, seed)
    names, first_row = np.tile(np.arange(ACTIONS), size), np.arange(size) * ACTIONS
    return module.MDP(range(size), names, first_row, P, R, np.eye(1, size)[0], np.zeros(size, bool))


def their_ddp(size: int, seed: int, discount: float):
    """The same model as QuantEcon's DiscreteDP, of state-action pairs."""
    import quantecon

    P, R = random_arrays(size, seed)
    pairs = np.repeat(np.arange(size), ACTIONS), np.tile(np.arange(ACTIONS), size)
    ddp = quantecon.markov.DiscreteDP(R, sparse.csr_matrix(P), discount, *pairs)
    ddp.solve("value_iteration", max_iter=1)  # compile
    return ddp


def sweeps(size: int, args: Args) -> tuple[str, str]:
    """One Bellman sweep of each, in turns: the median and the best time in ms."""
    value_iteration = importlib.import_module("value_iteration")
    mdp, ddp = our_mdp(value_iteration, size, args.seed), their_ddp(size, args.seed, args.discount)
    V, out, times = np.random.default_rng(1).random(size), np.empty(size), ([], [])
    sweep = (
        lambda: value_iteration.maximum(mdp, value_iteration.backup(mdp, V, args.discount)),
        lambda: ddp.bellman_operator(V, Tv=out),
    )
    for _ in range(math.ceil(args.repeats / 10)):
        for who in (0, 1):
            for i in range(10):
                started = time.perf_counter()
                sweep[who]()
                if i:
                    times[who].append(time.perf_counter() - started)
    assert np.allclose(sweep[0](), sweep[1](), atol=1e-12)
    return tuple(f"{1e3 * statistics.median(t):.3g} ms (best {1e3 * min(t):.3g})" for t in times)


def solve(who: str, method: str, size: int, args: Args) -> tuple[float, int, float, np.ndarray, float]:
    """One whole solve: seconds, iterations, peak memory in GB, V, seconds to make the model."""
    tolerance = args.epsilon * (1 - args.discount) / (2 * args.discount)  # QuantEcon's rule
    built = time.perf_counter()
    if who == "QuantEcon":
        ddp = their_ddp(size, args.seed, args.discount)
        started = time.perf_counter()
        result = ddp.solve(method.replace(" ", "_"), epsilon=args.epsilon, max_iter=100_000)
        seconds, iterations, V = time.perf_counter() - started, result.num_iter, result.v
    else:
        script = importlib.import_module(method.replace(" ", "_"))
        mdp = our_mdp(script, size, args.seed)
        started = time.perf_counter()
        if method == "value iteration":
            V, Q, changes, _ = script.value_iteration(mdp, args.discount, tolerance, 100_000)
            script.greedy_policy(mdp, Q, script.tied_rows(mdp, Q, tolerance), args.discount)
            iterations = len(changes)
        elif method == "policy iteration":
            # QuantEcon begins with the greedy policy of V(s) = max_a R(s, a); so do we.
            Q_0 = script.backup(mdp, script.maximum(mdp, mdp.R), args.discount)
            policy = script.first_rows(mdp, np.flatnonzero(script.tied_rows(mdp, Q_0, 1e-12)))
            solution, _ = script.policy_iteration(mdp, policy, args.discount, 1e-9, 1000)
            V, iterations = solution.V, solution.iterations
        else:
            solution, _ = script.linear_program(mdp, args.discount, 1e-9, 10**8)
            V, iterations = solution.V, solution.iterations
        seconds = time.perf_counter() - started
    return seconds, iterations, peak_memory(), V, started - built


def evaluate(who: str, size: int, args: Args) -> tuple[float, float]:
    """V of the policy "first": seconds, and the largest residual |R + γ P V - V|."""
    if who == "ours":
        script = importlib.import_module("policy_evaluation")
        mdp = our_mdp(script, size, args.seed)
        started = time.perf_counter()
        P, R = script.policy_system(mdp, mdp.first_row, ~mdp.terminal)
        V = script.solve_policy(P, R, args.discount, np.zeros(size))
    else:
        ddp = their_ddp(size, args.seed, args.discount)
        R, P = ddp.RQ_sigma(np.zeros(size, int))
        started = time.perf_counter()
        V = ddp.evaluate_policy(np.zeros(size, int))
    return time.perf_counter() - started, float(np.abs(R + args.discount * (P @ V) - V).max())


def peak_memory() -> float:
    """Peak memory of this process in GB; NaN where the system does not tell (Windows)."""
    try:
        import resource
    except ImportError:
        return float("nan")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9


def apart(what: str, limit: float, function, *arguments):
    """The function's result, computed in a process of its own; None after `limit` seconds or for want of memory."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        try:
            result = pool.apply_async(function, arguments).get(limit)
            pool.close()
            pool.join()
            return result
        except (multiprocessing.TimeoutError, MemoryError) as error:
            return print(f"  {what}: given up, {type(error).__name__} ({limit:g} s allowed)", flush=True)


def main() -> None:
    """Print one line for each measurement."""
    args = tyro.cli(Args, description=__doc__)
    versions = f"NumPy {np.__version__}, SciPy {scipy.__version__}, QuantEcon {version('quantecon')}"
    print(f"{platform.machine()}, Python {platform.python_version()}, {versions}")
    print(f"discount {args.discount}, ε {args.epsilon:g}")
    for size in args.sizes:
        print(f"\n{size:,} states, {size * ACTIONS * SUCCESSORS:,} transitions", flush=True)
        if result := apart("Bellman sweep", 600, sweeps, size, args):
            print(f"  Bellman sweep: ours {result[0]}, QuantEcon {result[1]}", flush=True)
        for method in ("value iteration", "policy iteration"):
            values = []
            for who in ("ours", "QuantEcon"):
                if result := apart(f"{method}, {who}", args.limit, solve, who, method, size, args):
                    seconds, iterations, memory, V, building = result
                    values.append(V)
                    print(f"  {method}, {who}: {seconds:.3g} s, {iterations} iterations, peak memory {memory:.2f} GB "
                          f"(model made in {building:.2g} s)", flush=True)  # fmt: skip
            if len(values) == 2:
                print(f"    V of the two differ by at most {np.abs(values[0] - values[1]).max():.1e}")
        for who in ("ours", "QuantEcon"):
            if result := apart(f"policy evaluation, {who}", args.limit, evaluate, who, size, args):
                print(f"  policy evaluation, {who}: {1e3 * result[0]:.3g} ms, residual {result[1]:.1e}", flush=True)
        what = "linear program, ours"
        if args.linear_program and (result := apart(what, args.limit, solve, "ours", "linear program", size, args)):
            print(f"  {what}: {result[0]:.3g} s, peak memory {result[2]:.2f} GB", flush=True)


if __name__ == "__main__":
    main()
