# /// script
# requires-python = ">=3.10"
# dependencies = ["numpy>=2.0", "scipy>=1.14", "gymnasium>=1.0", "tyro>=0.9", "tqdm>=4.66", "matplotlib>=3.9"]
# ///
"""Value iteration: the best policy of a known Markov decision process (§4.3, Algorithm 3, Equations 27-31).

Run it
    python algorithms/value_iteration.py                                      # the lecture's MDP, its two tables
    python algorithms/value_iteration.py --env-id FrozenLake-v1 --env-kwargs "map_name=8x8" --figure lake.png
    python algorithms/value_iteration.py --env-id Taxi-v3 --discount 0.99
    python algorithms/value_iteration.py --mdp my_mdp.json --output-json best.json

Measured
    The first command ends after 5 sweeps with V* = (11, 1, 4, 0), π* = (a1, a1, a2). FrozenLake-v1 at discount 1:
    V(0) = 0.823529411742 (exactly 14/17) after 994 sweeps. On 10^6 states (20 transitions each, discount 0.95) a
    sweep takes 58.8 ms and a whole solve 18.6 s, QuantEcon's 67.3 ms and 24.7 s; on 10^5 4.11 ms and 1.52 s against
    5.48 ms and 1.54 s (benchmarks/known_mdps.py, two CPU cores).

Deviations
    lecture                     this file                                why
    --------------------------  ---------------------------------------  -----------------------------------------------
    no discount                 `--discount` γ, 1 if not given; below 1  a backup is then a contraction
                                a bound of the error is printed
    "until V has converged"     until no V changes by more than          floats; Q is a step behind V, and the lecture's
                                `--tolerance`, and then one sweep more   tables, too, go on to i = 5
    i stays 0 (Algorithm 3)     i = i + 1 in every sweep                 as in Algorithm 1
    π* = argmax Q*              at discount 1 such that it also ends     to walk to and fro for nothing is a tie
    nothing of infinite values  an error that names the states           rewards collected for ever have no finite sum
"""

import collections
import contextlib
import dataclasses
import functools
import inspect
import io
import itertools
import json
import math
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, TypeVar

import gymnasium as gym
import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import sparse
from scipy.sparse import csgraph
from tqdm import tqdm

Flags = TypeVar("Flags")

# ---- Args ----------------------------------------------------------------------------------------


@dataclass
class Args:
    """V, Q, rewards and tolerances are in the unit of the rewards, iterations in sweeps over all states."""

    mdp: Path | None = None
    """a JSON file with the MDP; without it and --env-id, the lecture's Figure 5"""
    env_id: str = ""
    """a Gymnasium environment with a model, such as FrozenLake-v1, Taxi-v3, CliffWalking-v1"""
    env_kwargs: str = ""
    """its arguments, such as "map_name=8x8 is_slippery=false" """
    discount: float = 1.0
    """γ in [0, 1], weight of a reward one step later (the lecture is undiscounted: 1)"""
    tolerance: float = 1e-12
    """V has converged when no V(s) changes by more in a sweep (Algorithm 3, line 5), in units of reward;
    above 1e-9 it is also what makes a tie"""
    max_iterations: int = 100_000
    """sweeps after which to give up, an error"""
    output_json: Path | None = None
    """write values, action values, policy, ties, iterations, residual and history to this file"""
    figure: Path | None = None
    """draw the convergence of V and, in a grid world, values and policy, to this .png"""


def fail(message: str) -> NoReturn:
    """Bad input: one line on standard error, exit code 2."""
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2)


def parse_args(args_class: type[Flags]) -> Flags:
    """Read the command line; a flag that cannot be read ends in one line and exit code 2, not in tyro's box."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a Windows console or pipe may not know π
            stream.reconfigure(encoding="utf-8", errors="backslashreplace")
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            return tyro.cli(args_class, description=f"{__doc__}\n{inspect.getdoc(args_class)}")
    except SystemExit as stop:
        if stop.code != 2:
            raise
        lines = [line.strip("│ ") for line in box.getvalue().splitlines()[1:]]
        fail(" ".join(itertools.takewhile(lambda line: not line.startswith(("─", "╰")), lines)) + " (see --help)")


def check_settings(discount: float, tolerance: float, max_iterations: int) -> None:
    """Raises ValueError for a discount outside [0, 1] and for limits that nothing could keep."""
    if not 0 <= discount <= 1:
        raise ValueError(f"discount must be in [0, 1], not {discount}")
    if not 0 < tolerance < math.inf:
        raise ValueError(f"tolerance must be above 0, not {tolerance}")
    if max_iterations < 1:
        raise ValueError(f"max-iterations must be at least 1, not {max_iterations}")


def check_outputs(output_json: Path | None, figure: Path | None) -> None:
    """Raises ValueError where a file could not be written, before an hour of work finds it out."""
    for path in filter(None, (output_json, figure)):
        if path.is_dir() or not path.absolute().parent.is_dir():
            raise ValueError(f"cannot write {path}: it is a folder, or in none")
    if figure and figure.suffix not in (".png", ".pdf", ".svg"):
        raise ValueError(f"--figure {figure}: the name must end in .png, .pdf or .svg")


# ---- problem: a known Markov decision process ----------------------------------------------------

FIGURE_5 = {
    "start": "s0",
    "terminal": ["sG"],
    "transitions": {
        "s0": {"a1": [[1.0, "s1", 10]], "a2": [[0.6, "s1", 10], [0.4, "s2", 5]]},
        "s1": {"a1": [[1.0, "sG", 1]]},
        "s2": {"a1": [[1.0, "sG", 1]], "a2": [[0.7, "sG", 1], [0.3, "s0", 0]]},
    },
}  # the lecture's MDP; one outcome = [P(s'|s,a), s', R(s,a,s')]


@dataclass(frozen=True)
class MDP:
    """A Markov decision process (§2.4). Pairs (s, a) are rows, in order of state; a terminal state has one empty row.

    states (S,): names, any sequence, so range(10**6) will do.        actions (rows,): name of each row's action.
    first_row (S,) int: index of each state's first row.              terminal (S,) bool: the goal states 𝒢.
    P (rows, S) CSR float64: P(s'|s,a), an entry for each outcome.    R (rows,) float64: Σ_s' P(s'|s,a) R(s,a,s').
    start (S,) float64: probability of starting in s (the lecture: 1 for s0).
    rewards (outcomes,) float64: R(s,a,s') in the order of P.data; only the printed arithmetic needs it.
    grid: (height, width) of a world whose first states are the cells of a grid.
    Raises ValueError, naming state and action, where this is not a decision process.
    """

    states: Sequence
    actions: Sequence
    first_row: np.ndarray
    P: sparse.csr_array
    R: np.ndarray
    start: np.ndarray
    terminal: np.ndarray
    rewards: np.ndarray | None = None
    grid: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        rows, size = self.P.shape
        arrays = (self.states, self.first_row, self.start, self.terminal)
        if any(len(array) != size for array in arrays) or not len(self.actions) == len(self.R) == rows:
            raise ValueError(f"an MDP with P of shape {self.P.shape} has {size} states and {rows} actions and rewards")
        if self.first_row[0] != 0 or (np.diff(self.first_row, append=rows) < 1).any():
            raise ValueError("first_row must begin with 0 and give every state at least one row")
        if not abs(self.start.sum() - 1) <= 1e-9 or not (self.start >= 0).all():
            raise ValueError("the probabilities of the start states must be at least 0 and sum to 1")
        if not (self.P.data > 0).all():
            raise ValueError("every probability that P stores must be above 0 (see P.eliminate_zeros)")
        ends = self.terminal[self.state_of_row]  # (rows,)
        total = self.P @ np.ones(size)  # (rows,)
        for row in np.flatnonzero(~(np.abs(total - ~ends) <= 1e-9))[:1]:
            what = f"state {self.states[self.state_of_row[row]]}, action {self.actions[row]}"
            raise ValueError(f"{what}: the probabilities sum to {total[row]:.12g}, not to {int(not ends[row])}")
        if not np.isfinite(self.R).all() or self.R[ends].any():
            raise ValueError("every reward must be finite, and 0 in a terminal state")

    @functools.cached_property
    def state_of_row(self) -> np.ndarray:
        """(rows,) int: the state s of each pair (s, a)."""
        return np.repeat(np.arange(len(self.first_row)), np.diff(self.first_row, append=self.P.shape[0]))

    @functools.cached_property
    def width(self) -> int:
        """|A_s| if it is the same in every state, else 0."""
        counts = np.diff(self.first_row, append=self.P.shape[0])  # (S,)
        return int(counts[0]) if (counts == counts[0]).all() else 0


def mdp_from_json(model: dict) -> MDP:
    """The MDP of `{"start": state, "terminal": [state, …], "transitions": {state: {action: [[P, s', R], …], …}, …}}`.

    "start" may also be {state: probability, …}. Raises ValueError that says where the model is wrong.
    """
    if not isinstance(model, dict) or not isinstance(model.get("transitions"), dict) or "start" not in model:
        raise ValueError('a model is {"start": s, "terminal": [s, …], "transitions": {s: {a: [[P, next s, R], …]}}}')
    if unknown := set(model) - {"start", "terminal", "transitions"}:
        raise ValueError(f"unknown key {sorted(unknown)[0]!r} in the model")
    transitions, terminal = model["transitions"], model.get("terminal", [])
    if not isinstance(terminal, list) or not all(isinstance(state, str) for state in terminal):
        raise ValueError('"terminal" must be a list of states')
    states = list(dict.fromkeys([*transitions, *terminal]))
    start = model["start"] if isinstance(model["start"], dict) else {str(model["start"]): 1.0}
    if not states:
        raise ValueError("the model has no states")
    number, goals = {state: s for s, state in enumerate(states)}, set(terminal)
    if unknown := [state for state in start if state not in number]:
        raise ValueError(f"unknown start state {unknown[0]!r}")
    if not all(map(is_number, start.values())):
        raise ValueError('"start" must be a state, or {state: probability, …}')
    actions, first_row, outcomes_before = [], [], [0]  # the rows; outcomes_before is P's index pointer
    probabilities, successors, rewards = [], [], []  # the outcomes
    for state in states:
        first_row.append(len(actions))
        choices = transitions.get(state, {})
        if not isinstance(choices, dict) or bool(choices) == (state in goals):
            wrong = "is terminal, but has actions" if state in goals else "is not terminal, but has no actions"
            raise ValueError(f"state {state} {wrong}")
        for action, outcomes in choices.items() or [("", [])]:
            for outcome in outcomes if isinstance(outcomes, list) else [outcomes]:
                what = f"state {state}, action {action}"
                if not isinstance(outcome, list) or len(outcome) != 3:
                    raise ValueError(f"{what}: {outcome!r} is not [probability, next state, reward]")
                probability, successor, reward = outcome
                if not is_number(probability) or probability < 0:
                    raise ValueError(f"{what}: {probability!r} is not a probability")
                if not isinstance(successor, str) or successor not in number:
                    raise ValueError(f"{what}: unknown next state {successor!r}")
                if not is_number(reward):
                    raise ValueError(f"{what}: {reward!r} is not a finite reward")
                if probability > 0:
                    probabilities.append(float(probability))
                    successors.append(number[successor])
                    rewards.append(float(reward))
            actions.append(action)
            outcomes_before.append(len(rewards))
    shape = (len(actions), len(states))
    P = sparse.csr_array((np.array(probabilities, float), np.array(successors, int), outcomes_before), shape=shape)
    # R(s, a) = Σ_s' P(s'|s, a) R(s, a, s')
    R, size = (
        sparse.csr_array((P.data * factor, P.indices, P.indptr), shape=shape).sum(axis=1)  # (rows,)
        for factor in (rewards, np.abs(rewards))
    )
    R[np.abs(R) <= 4 * np.finfo(float).eps * size] = 0  # easy to get wrong: 0.1·3 - 0.3·1 is 5.6e-17, and no gain
    return MDP(
        states, actions, np.array(first_row), P, R, rewards=np.array(rewards),
        start=np.array([float(start.get(state, 0)) for state in states]),  # (S,)
        terminal=np.array([state in goals for state in states]),  # (S,)
    )


def is_number(x: object) -> bool:
    """Is this value of a JSON file a finite number? (Python reads NaN and 1e999 without complaint.)"""
    return isinstance(x, (int, float)) and not isinstance(x, bool) and abs(x) <= sys.float_info.max


def mdp_from_gymnasium(env_id: str, env_kwargs: str) -> MDP:
    """The MDP of a Gymnasium environment that has its model in `unwrapped.P`: {s: {a: [(P, s', R, terminated), …]}}.

    Gymnasium ends an episode by a flag of the transition: every flagged one leads to one added state, "terminal".
    """
    kwargs = {}
    for item in env_kwargs.split():
        name, equals, kwargs[name] = item.partition("=")
        if not equals:
            raise ValueError(f"--env-kwargs: {item!r} is not name=value")
        with contextlib.suppress(ValueError):  # what is not JSON, such as 8x8, stays text
            kwargs[name] = json.loads(kwargs[name].replace("True", "true").replace("False", "false"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # advice about versions, on a run in which nothing is wrong
        try:
            try:
                env = gym.make(env_id, **kwargs).unwrapped
            except gym.error.DeprecatedEnv:
                env = gym.make(env_id.rpartition("-v")[0], **kwargs).unwrapped
                print(f"{env_id} is retired in Gymnasium {gym.__version__}; {env.spec.id} takes its place.\n")
        except Exception as error:  # whatever the constructor of somebody's environment raises
            raise ValueError(f"Gymnasium cannot make {env_id} with {kwargs}: {error}") from error
    if not hasattr(env, "P"):
        raise ValueError(f"{env_id} has no model (unwrapped.P): its transition probabilities are unknown")
    start = getattr(env, "initial_state_distrib", np.eye(1, len(env.P))[0])  # (cells,)
    mdp = mdp_from_json({
        "start": {str(s): float(probability) for s, probability in enumerate(start)},
        "terminal": ["terminal"],
        "transitions": {
            str(s): {
                str(a): [[float(p), "terminal" if ended else str(s_next), float(r)] for p, s_next, r, ended in outcomes]
                for a, outcomes in choices.items()
            }
            for s, choices in env.P.items()
        },
    })  # fmt: skip
    shape = tuple(getattr(env, "shape", getattr(getattr(env, "desc", None), "shape", ())))
    return dataclasses.replace(mdp, grid=shape if len(shape) == 2 and math.prod(shape) == len(env.P) else None)


def load_json(path: Path) -> object:
    """The contents of a JSON file. Raises ValueError for broken syntax (line, column) and for a repeated key."""

    def unique(pairs: list[tuple[str, object]]) -> dict:
        seen = collections.Counter(key for key, _ in pairs)
        if seen and max(seen.values()) > 1:
            raise ValueError(f"{path}: the key {seen.most_common(1)[0][0]!r} occurs twice in one object")
        return dict(pairs)

    try:
        return json.loads(path.read_text(encoding="utf-8-sig"), object_pairs_hook=unique)
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} is not JSON: {error.msg} at line {error.lineno}, column {error.colno}") from error
    except (UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path} is not JSON: {error}") from error


def read_mdp(mdp: Path | None, env_id: str, env_kwargs: str) -> MDP:
    """The MDP that the flags name: a JSON file, a Gymnasium environment, or else the lecture's Figure 5."""
    if mdp and env_id:
        raise ValueError("--mdp and --env-id both name a model: give one of them")
    if env_kwargs and not env_id:
        raise ValueError("--env-kwargs needs --env-id")
    if env_id:
        return mdp_from_gymnasium(env_id, env_kwargs)
    return mdp_from_json(load_json(mdp) if mdp else FIGURE_5)


@dataclass
class Solution:
    """What a script found. NaN stands for the value of a state that the policy does not reach, -1 for its action."""

    V: np.ndarray  # (S,)
    Q: np.ndarray  # (rows,)
    policy: np.ndarray  # (S,) int, rows
    tied: np.ndarray  # (rows,) bool, the actions that are as good as the best
    iterations: int
    residual: float  # Bellman residual of V
    changes: list[float]  # the residual's course, for the figure
    history: list[dict[str, np.ndarray]]  # {"values": V_i, "action_values": Q_i, "policy": π_i} for i = 0, 1, …


# ---- algorithm: value iteration ------------------------------------------------------------------


def backup(mdp: MDP, V: np.ndarray, discount: float) -> np.ndarray:
    """Q (rows,) of the values V (S,) by Equation 29: one Bellman backup."""
    # Q(s, a) = Σ_s' P(s'|s, a) [R(s, a, s') + γ V(s')]  Equation 29; R has the rewards summed already
    Q = mdp.P @ (discount * V)  # (rows,)
    Q += mdp.R
    return Q


def maximum(mdp: MDP, Q: np.ndarray) -> np.ndarray:
    """max_a Q(s, a), (rows,) → (S,). With equally many actions everywhere, whole columns are faster."""
    if mdp.width:
        return functools.reduce(np.maximum, Q.reshape(-1, mdp.width).T)  # (S,)
    return np.maximum.reduceat(Q, mdp.first_row)  # (S,)


def slack(best: np.ndarray, tolerance: float) -> np.ndarray:
    """(S,) How far below `best` (S,) still counts as equal: `tolerance` of that value's size where it is above 1.

    Easy to get wrong: of the largest |Q| of all, one forbidden action at -1e9 would make ties of good and bad. (But
    1e-11 of the largest value is what solving and summing leave of it everywhere.)
    """
    size = np.abs(best)  # (S,)
    return np.maximum(tolerance * np.maximum(1.0, size), 1e-11 * size.max())


def tied_rows(mdp: MDP, Q: np.ndarray, tolerance: float) -> np.ndarray:
    """(rows,) bool: the actions that come within `tolerance`, or 1e-9 if that is more, of the best of their state."""
    best = maximum(mdp, Q)  # (S,)
    return Q >= (best - slack(best, max(1e-9, tolerance)))[mdp.state_of_row]


def first_rows(mdp: MDP, rows: np.ndarray) -> np.ndarray:
    """(S,) int: the first of `rows` (indices in ascending order) in each state, -1 where a state has none."""
    policy = np.full(len(mdp.first_row), -1)  # (S,)
    policy[mdp.state_of_row[rows[::-1]]] = rows[::-1]  # the last assignment stays
    return policy


def settled(change: float, V: np.ndarray, tolerance: float) -> bool:
    """Has V converged: within the tolerance, or within what the spacing of doubles allows?"""
    return change <= tolerance or change <= 4 * np.finfo(float).eps * np.abs(V).max()


def value_iteration(
    mdp: MDP, discount: float, tolerance: float, max_iterations: int
) -> tuple[np.ndarray, np.ndarray, list[float], list[dict[str, np.ndarray]]]:
    """Algorithm 3: (V* (S,), Q* (rows,), max |V_i - V_i-1| for each i, the V_i and Q_i for at most 100 states).

    Raises ValueError if V has not converged after max_iterations.
    """
    check_settings(discount, tolerance, max_iterations)
    V, Q = np.zeros(len(mdp.first_row)), np.zeros(len(mdp.R))  # (S,), (rows,)
    changes, history, converged = [math.inf], [{"values": V, "action_values": Q}], False
    with tqdm(desc="value iteration", unit=" sweeps", delay=2, leave=False) as bar:
        while not converged:
            # Q is one step behind V: after V has converged one more sweep lets Q converge, too.
            converged = settled(changes[-1], V, tolerance)
            if len(changes) > max_iterations:
                raise ValueError(not_converged(mdp, Q, discount, len(changes) - 1, changes[-1]))
            # V_i+1(s) = max_a Q_i(s, a), Q_i(s, a) = Σ_s' P(s'|s, a) [R(s, a, s') + γ V_i(s')]  Algorithm 3, line 7
            Q = backup(mdp, V, discount)  # (rows,)
            V_next = maximum(mdp, Q)  # (S,)
            changes.append(float(np.abs(V_next - V).max()))
            V = V_next
            history += [{"values": V, "action_values": Q}] if len(V) <= 100 else []
            bar.update()
    return V, Q, changes[1:], history if len(V) <= 100 else []


def not_converged(mdp: MDP, Q: np.ndarray, discount: float, sweeps: int, change: float) -> str:
    """The message if V has not converged; at discount 1 it names the loop in which V grows, if there is one."""
    message = f"V has not converged after --max-iterations {sweeps:,} (last change {change:.3g})"
    rows = first_rows(mdp, np.flatnonzero(tied_rows(mdp, Q, 0.0)))  # (S,)
    loop = lasting_rows(mdp, rows[~mdp.terminal])
    if discount == 1 and len(loop := loop[mdp.R[loop] != 0]):
        message += f"; at discount 1 the best actions go round for ever in {names(mdp, mdp.state_of_row[loop])}"
    return message


def greedy_policy(mdp: MDP, Q: np.ndarray, tied: np.ndarray, discount: float) -> np.ndarray:
    """π* (S,) by Equation 31: the first of the tied actions, but at discount 1 one that also collects what Q promises.

    Easy to get wrong: at discount 1 walking to and fro for nothing ties with walking to the goal, since V is still
    there the next time. A plain argmax may choose it, and never arrive.
    """
    if discount < 1:
        return first_rows(mdp, np.flatnonzero(tied))
    rows = np.flatnonzero(tied & ~mdp.terminal[mdp.state_of_row])
    at_rest = (mdp.R[rows] == 0) & (np.abs(maximum(mdp, Q)[mdp.state_of_row[rows]]) <= 1e-9)
    policy = policy_towards(mdp, rows, lasting_rows(mdp, rows[at_rest]))
    if len(missed := np.flatnonzero(policy < 0)):
        why = "rewards cancel out in a loop, or --tolerance is too large"
        raise ValueError(f"no policy attains the values found in {names(mdp, missed)}: {why}")
    return policy


# ---- evaluation: which values are finite without a discount --------------------------------------


def state_graph(mdp: MDP, rows: np.ndarray) -> sparse.csr_array:
    """The graph on states, (S, S), with an edge s → s' for every outcome of `rows` (indices in ascending order)."""
    P = mdp.P[rows]  # (len(rows), S)
    edges = np.bincount(mdp.state_of_row[rows], np.diff(P.indptr), minlength=P.shape[1])  # (S,) edges out of s
    graph = sparse.csr_array((P.data, P.indices, np.append(0, np.cumsum(edges)).astype(int)), shape=(P.shape[1],) * 2)
    graph.sum_duplicates()  # easy to get wrong: given an edge twice, SciPy's connected_components never returns
    return graph


def search(graph: sparse.csr_array, sources: np.ndarray) -> np.ndarray:
    """Breadth-first search from `sources` (S,) bool: predecessors (S,) int; S for a source, < 0 if not found."""
    root = sparse.csr_array(sources[None].astype(float))  # (1, S), an added node that leads to every source
    whole = sparse.block_array([[graph, None], [root, sparse.csr_array((1, 1))]], format="csr")  # (S + 1, S + 1)
    return csgraph.breadth_first_order(whole, len(sources))[1][:-1]


def lasting_rows(mdp: MDP, rows: np.ndarray) -> np.ndarray:
    """Those of `rows` (indices in ascending order) that can be played for ever: what they lead to, they lead back from.

    Of one row per state these are a policy's recurrent classes; of more, what the literature calls end components.
    """
    while True:
        component = csgraph.connected_components(state_graph(mdp, rows), connection="strong")[1]  # (S,)
        P = mdp.P[rows]  # (len(rows), S)
        own = np.repeat(component[mdp.state_of_row[rows]], np.diff(P.indptr))  # (outcomes,)
        stays = np.logical_and.reduceat(component[P.indices] == own, P.indptr[:-1])  # (len(rows),) nothing leads out
        if stays.all():
            return rows
        rows = rows[stays]


def policy_towards(mdp: MDP, rows: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """A policy (S,) that surely gets to a terminal state or to a state of `rest`, where it stays; -1 where none does.

    It plays only `rows`, and in the states of `rest` only those (both are indices in ascending order).
    """
    policy = np.where(mdp.terminal, mdp.first_row, first_rows(mdp, rest))  # (S,)
    # From every state a step nearer to the end has positive probability, so that the end is reached with probability 1.
    nearer = search(state_graph(mdp, rows).T, policy >= 0)  # (S,) the next state on a shortest way
    P = mdp.P[rows]  # (len(rows), S)
    row = np.repeat(rows, np.diff(P.indptr))  # (outcomes,)
    return np.where(policy >= 0, policy, first_rows(mdp, row[P.indices == nearer[mdp.state_of_row[row]]]))


def without_discount(mdp: MDP) -> tuple[np.ndarray, np.ndarray]:
    """What discount 1 needs to know before anything is iterated: (rest, safe).

    rest, int: the rows that can be played for ever with rewards of 0 only, which has the value 0.
    safe (S,) int: a policy that reaches a terminal state or rest from everywhere, so that its values are finite.
    Raises ValueError that names the states where V* is infinite, or where no policy has a finite value.
    """
    acting = np.flatnonzero(~mdp.terminal[mdp.state_of_row])
    rest = lasting_rows(mdp, acting[mdp.R[acting] >= 0])
    if len(gaining := rest[mdp.R[rest] > 0]):
        where = names(mdp, mdp.state_of_row[gaining])
        raise ValueError(f"V* is infinite at discount 1: rewards above 0 can be collected for ever in {where}")
    safe = policy_towards(mdp, acting, rest)
    if len(hopeless := np.flatnonzero(safe < 0)):
        where = names(mdp, hopeless)
        why = "neither a terminal state can be reached nor a loop with rewards of 0"
        raise ValueError(f"no policy has a finite value at discount 1 in {where}: {why}")
    return rest, safe


def names(mdp: MDP, states: np.ndarray) -> str:
    """The names of some states for a message, at most five of them."""
    states = np.unique(states)
    more = f", … ({len(states)} states)" if len(states) > 5 else ""
    return ", ".join(str(mdp.states[s]) for s in states[:5]) + more


# ---- report and checkpoint -----------------------------------------------------------------------


def readable(mdp: MDP) -> bool:
    """Is the MDP small enough to be worked through on paper?"""
    return len(mdp.R) <= 12


def decimal(x: float) -> str:
    """A number as the lecture prints it: two decimals without trailing zeros (but two digits of what is below 0.1)."""
    return f"{x:.2g}" if 0 < abs(x) < 0.1 else f"{x + 0:.2f}".rstrip("0").rstrip(".")


def worked(mdp: MDP, row: int, discount: float, value: Callable[[int], str]) -> str:
    """Σ_s' P(s'|s,a) [R(s,a,s') + γ V(s')] of a row as the lecture writes it: `0.6·[10 + V(s1)] + 0.4·[5 + V(s2)]`."""
    gamma = "" if discount == 1 else f"{discount:g}·"
    outcomes = range(*mdp.P.indptr[row : row + 2])
    brackets = (f"{mdp.P.data[k]:.4g}·[{mdp.rewards[k]:g} + {gamma}{value(mdp.P.indices[k])}]" for k in outcomes)
    return " + ".join(brackets) or "0"


def print_table(header: list[str], rows: list[list[str]], most: int = 12) -> None:
    """Print columns that line up; of more rows than `most` all but the last are left out from there on."""
    if len(rows) > most:
        rows = [*rows[: most - 2], ["…"] * len(header), rows[-1]]
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    for row in [header, ["-" * width for width in widths], *rows]:
        print("  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip())
    print()


def print_solution(mdp: MDP, solution: Solution) -> None:
    """V, π and ties of the first states, the value of the start, and the Bellman residual."""
    rows = []
    for s in range(min(len(mdp.states), 20)):
        rows_of_s = range(mdp.first_row[s], (*mdp.first_row[s + 1 : s + 2], len(mdp.R))[0])
        ties = ", ".join(str(mdp.actions[row]) for row in rows_of_s if solution.tied[row])
        action = "-" if mdp.terminal[s] or solution.policy[s] < 0 else str(mdp.actions[solution.policy[s]])
        value = "undefined" if np.isnan(solution.V[s]) else f"{solution.V[s] + 0:.12g}"
        rows.append([str(mdp.states[s]), value, action, ties if "," in ties else ""])
    print_table(["state", "V", "π", "ties"], rows, most=20)
    if len(mdp.states) > 20:
        print(f"… and {len(mdp.states) - 20} more states (--output-json FILE writes all of them)")
    one = f"V({mdp.states[mdp.start.argmax()]})"
    value = mdp.start @ np.where(mdp.start > 0, solution.V, 0)
    print(f"{one if mdp.start.max() == 1 else 'Mean V of the states to start from'} = {value:.12g}")
    print(f"{solution.iterations} iterations, Bellman residual {solution.residual:.3g}")


def as_json(mdp: MDP, solution: Solution) -> dict:
    """The solution as --output-json writes it; a value that is not defined is null."""
    states, actions = [str(state) for state in mdp.states], [str(action) for action in mdp.actions]
    bounds = np.append(mdp.first_row, len(mdp.R)).tolist()
    choices = {state: [] if mdp.terminal[s] else range(*bounds[s : s + 2]) for s, state in enumerate(states)}

    def named(values: np.ndarray, action_values: np.ndarray | None = None, policy: np.ndarray | None = None) -> dict:
        entry = {"values": dict(zip(states, np.where(np.isnan(values), None, values).tolist(), strict=True))}
        if action_values is not None:
            Q = np.where(np.isnan(action_values), None, action_values).tolist()
            entry["action_values"] = {state: {actions[row]: Q[row] for row in rows} for state, rows in choices.items()}
        if policy is not None:
            acting = np.flatnonzero((policy >= 0) & ~mdp.terminal)
            entry["policy"] = {states[s]: actions[policy[s]] for s in acting}
        return entry

    ties = {state: [actions[row] for row in rows if solution.tied[row]] for state, rows in choices.items()}
    return {
        **named(solution.V, solution.Q, solution.policy),
        "ties": {state: tied for state, tied in ties.items() if len(tied) > 1},
        "iterations": solution.iterations,
        "residual": solution.residual,
        "history": [named(**entry) for entry in solution.history] if len(states) <= 100 else [],
    }


def save_json(path: Path | None, contents: object) -> None:
    """Write --output-json, if it is asked for."""
    if path:
        path.write_text(json.dumps(contents, indent=1, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")


def save_figure(
    path: Path | None, mdp: MDP, solutions: dict[str, Solution], xlabel: str, ylabel: str, yscale: str = "log"
) -> None:
    """Draw --figure, if it is asked for: for each solution its convergence and, in a grid, its values and actions.

    Convergence is V of every state where there are at most 10, else `changes`, which `ylabel` describes.
    """
    if not path:
        return
    columns = 2 if mdp.grid else 1
    figure = Figure(figsize=(6.4 * columns, 4.4 * len(solutions)), layout="constrained")
    panels = figure.subplots(len(solutions), columns, squeeze=False)
    for (title, solution), (curves, *map_panel) in zip(solutions.items(), panels, strict=True):
        if len(mdp.states) <= 10 and solution.history:
            for s, state in enumerate(mdp.states):
                curves.plot([entry["values"][s] for entry in solution.history], marker=".", label=f"V({state})")
            curves.set(ylabel="V")
            curves.legend()
        else:
            drawn = [y if y > 0 or yscale == "linear" else math.nan for y in solution.changes]  # there is no log of 0
            curves.plot(range(1, len(drawn) + 1), drawn, marker=".")
            curves.set(ylabel=ylabel, yscale=yscale)
        curves.set(title=title, xlabel=xlabel)
        curves.xaxis.get_major_locator().set_params(integer=True)
        if mdp.grid:
            draw_grid(map_panel[0], mdp, solution)
    figure.savefig(path, dpi=120)


def draw_grid(axes: Axes, mdp: MDP, solution: Solution) -> None:
    """V as colours and π as arrows on the grid; a cell in which nobody ever acts (hole, goal, cliff) is left empty."""
    cells = math.prod(mdp.grid)
    acting = search(state_graph(mdp, np.arange(len(mdp.R))), mdp.start > 0)[:cells] >= 0  # (cells,)
    acting &= solution.policy[:cells] >= 0
    # An action's arrow is its mean step to a neighbouring cell, over all states: where it leads, slips averaged out.
    P = mdp.P.tocoo()
    place = np.stack(np.divmod(np.arange(len(mdp.states)), mdp.grid[1]), axis=1)  # (S, 2) row and column
    step = place[P.col] - place[mdp.state_of_row[P.row]]  # (outcomes, 2)
    near = (np.abs(step).sum(axis=1) == 1) & (P.col < cells)  # (outcomes,)
    arrows = {}
    for action in set(mdp.actions[: mdp.first_row[cells]]):
        of_action = near & (np.array(mdp.actions) == action)[P.row]  # (outcomes,)
        mean = P.data[of_action] @ step[of_action]  # (2,)
        arrows[action] = mean / max(1e-9, np.linalg.norm(mean))
    image = axes.imshow(np.where(acting, solution.V[:cells], np.nan).reshape(mdp.grid), cmap="viridis")
    axes.figure.colorbar(image, ax=axes, label="V", shrink=0.8)
    for s in np.flatnonzero(acting):
        (y, x), (dy, dx) = place[s], arrows[mdp.actions[solution.policy[s]]]
        ink = "white" if image.norm(solution.V[s]) < 0.6 else "black"
        axes.text(x, y - 0.3, f"{solution.V[s]:.3g}", ha="center", va="center", color=ink, fontsize=7)
        size = {"angles": "xy", "scale_units": "xy", "scale": 2.5, "width": 0.006}
        axes.quiver(x - 0.2 * dx, y + 0.15 - 0.2 * dy, dx, dy, color=ink, **size)
    axes.set(title="V and π", xticks=range(mdp.grid[1]), yticks=range(mdp.grid[0]))


# ---- main ----------------------------------------------------------------------------------------


def print_value_tables(mdp: MDP, discount: float, history: list[dict[str, np.ndarray]]) -> None:
    """The lecture's two tables (§4.3): V_i(s), and Q_i(s, a) with the arithmetic."""
    V = [entry["values"] for entry in history]
    acting = np.flatnonzero(~mdp.terminal[mdp.state_of_row])
    pairs = [f"Q_i({mdp.states[mdp.state_of_row[row]]}, {mdp.actions[row]})" for row in acting]
    rows = [[str(i), *map(decimal, V_i)] for i, V_i in enumerate(V)]
    print_table(["i", *(f"V_i({state})" for state in mdp.states)], rows)
    cells = [["0", *("0" for _ in acting)]]
    for i, entry in enumerate(history[1:], start=1):
        Q_i, before = entry["action_values"], [decimal(v) for v in V[i - 1]]
        arithmetic = {row: worked(mdp, row, discount, before.__getitem__) for row in acting}
        cells.append([str(i), *(f"{text} = {decimal(Q_i[row])}" for row, text in arithmetic.items())])
    print_table(["i", *pairs], cells)


def main() -> None:
    """Read the flags and the MDP, solve it, report; bad input ends in one line."""
    args = parse_args(Args)
    try:
        check_settings(args.discount, args.tolerance, args.max_iterations)
        check_outputs(args.output_json, args.figure)
        mdp = read_mdp(args.mdp, args.env_id, args.env_kwargs)
        if args.discount == 1:
            without_discount(mdp)
        V, Q, changes, history = value_iteration(mdp, args.discount, args.tolerance, args.max_iterations)
        tied = tied_rows(mdp, Q, args.tolerance)
        policy = greedy_policy(mdp, Q, tied, args.discount)
        residual = float(np.abs(maximum(mdp, backup(mdp, V, args.discount)) - V).max())
        solution = Solution(V, Q, policy, tied, len(changes), residual, changes, history)
        if readable(mdp):
            print_value_tables(mdp, args.discount, history)
        print_solution(mdp, solution)
        if args.discount < 1:
            # ‖V - V*‖ ≤ ‖V - T V‖ + ‖T V - T V*‖ ≤ residual + γ ‖V - V*‖, T a backup: it contracts by γ
            print(f"max |V - V*| <= {residual / (1 - args.discount):.3g}")
        save_json(args.output_json, as_json(mdp, solution))
        save_figure(args.figure, mdp, {"Value iteration": solution}, "sweep i", "max |V_i - V_i-1|")
    except (ValueError, OSError) as error:
        fail(" ".join(str(error).split()))


if __name__ == "__main__":
    main()
