"""What the tests of the five known-MDP scripts share: models, random models, independent oracles, the command line."""

import itertools
import json
import re

import exhaustive_search
import linear_program
import numpy as np
import policy_evaluation
import policy_iteration
import value_iteration
from scipy import sparse

SCRIPTS = [policy_evaluation, exhaustive_search, value_iteration, policy_iteration, linear_program]
SOLVERS = SCRIPTS[1:]  # those that look for the best policy

# Models at discount 1 that a peer refuses, loops on for ever, or answers wrongly.
TO_AND_FRO = {  # the agent may walk to and fro for nothing, which ties with going to the goal
    "start": "left",
    "terminal": ["goal"],
    "transitions": {
        "left": {"right": [[1, "right", 0]]},
        "right": {"left": [[1, "left", 0]], "out": [[1, "goal", 1]]},
    },
}
BETTER_STAY = {  # to stay for nothing is worth 0, to leave costs
    "start": "s",
    "terminal": ["goal"],
    "transitions": {
        "s": {"out": [[1, "goal", -1]], "step": [[1, "t", 0]]},
        "t": {"out": [[1, "goal", -3]], "back": [[1, "s", 0]]},
    },
}
ENDLESS_GAIN = {  # +2 and -1, round and round
    "start": "s",
    "terminal": ["goal"],
    "transitions": {
        "s": {"out": [[1, "goal", 0]], "step": [[1, "t", 2]]},
        "t": {"back": [[1, "s", -1]]},
    },
}
PURE_GAIN = {
    "start": "s",
    "terminal": ["goal"],
    "transitions": {"s": {"out": [[1, "goal", 5]], "stay": [[1, "s", 1]]}},
}
TRAP = {  # no policy leaves t, and t costs
    "start": "s",
    "terminal": ["goal"],
    "transitions": {"s": {"out": [[1, "goal", 1]], "in": [[1, "t", 0]]}, "t": {"stay": [[1, "t", -1]]}},
}
CANCELLING = {  # -1 and +1, round and round: the sums have no limit
    "start": "s",
    "terminal": ["goal"],
    "transitions": {
        "s": {"step": [[1, "t", -1]], "out": [[1, "goal", -10]]},
        "t": {"back": [[1, "s", 1]], "out": [[1, "goal", -10]]},
    },
}

FORBIDDEN = {  # to do a3 ends in a fine of 1e9; beside it 1 and 1.5 are still not the same
    "start": "s",
    "terminal": ["goal"],
    "transitions": {
        "s": {"a1": [[1, "goal", 1]], "a2": [[1, "goal", 1.5]], "a3": [[1, "goal", -1e9]], "a4": [[1, "pit", 0]]},
        "pit": {"out": [[1, "goal", -1e9]]},
    },
}
FAIR_LOOP = {  # 0.1·3 - 0.3·1 is nothing, in floating point too
    "start": "s",
    "terminal": ["goal"],
    "transitions": {"s": {"bet": [[0.1, "s", 3], [0.3, "s", -1], [0.6, "s", 0]], "out": [[1, "goal", -1]]}},
}


def run(module, monkeypatch, capsys, *flags):
    """A script's main in this process: (exit code, standard output, standard error)."""
    monkeypatch.setattr("sys.argv", [module.__name__, *map(str, flags)])
    code = 0
    try:
        module.main()
    except SystemExit as stop:
        code = stop.code
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def tables(output):
    """The printed tables, as lists of rows (headers first) of cells; a column that is empty in a row is left out."""
    blocks = re.split(r"\n\s*\n", output)
    found = []
    for block in blocks:
        lines = block.splitlines()
        for i, line in enumerate(lines):
            if i and re.fullmatch(r"[- ]*-[- ]*", line):
                found.append([re.split(r"\s{2,}", row.strip()) for row in [lines[i - 1], *lines[i + 1 :]]])
    return found


def written(path, model):
    """The path, after the model has been written there as JSON."""
    path.write_text(json.dumps(model), encoding="utf-8")
    return path


def random_model(rng, proper):
    """A small model with ragged actions, one or two terminals and ties; `proper`: every action may end the episode."""
    size, goals = int(rng.integers(1, 5)), [f"g{k}" for k in range(rng.integers(1, 3))]
    states = [f"s{s}" for s in range(size)]
    transitions = {}
    for state in states:
        actions = {}
        for a in range(rng.integers(1, 4)):
            if actions and rng.random() < 0.3:
                actions[f"a{a}"] = actions[rng.choice(list(actions))]  # a tie
                continue
            names = list(rng.choice(states + goals, size=rng.integers(1, 4)))
            names += [rng.choice(goals)] if proper else []
            weights = rng.integers(1, 9, len(names))
            outcomes = zip(weights / weights.sum(), names, rng.integers(-5, 6, len(names)), strict=True)
            actions[f"a{a}"] = [[float(p), str(s_next), int(r)] for p, s_next, r in outcomes]
        transitions[state] = actions
    return {"start": "s0", "terminal": goals, "transitions": transitions}


def dense_values(model, policy, discount):
    """{state: V^π} of {state: action} for all non-terminal states, by numpy.linalg.solve from the JSON."""
    states = list(model["transitions"])
    A, b = np.eye(len(states)), np.zeros(len(states))
    for i, state in enumerate(states):
        for p, s_next, r in model["transitions"][state][policy[state]]:
            b[i] += p * r
            if s_next in states:
                A[i, states.index(s_next)] -= discount * p
    return dict(zip(states, np.linalg.solve(A, b).tolist(), strict=True))


def best_values(model, discount):
    """{state: V*} as the largest V^π of all assignments of actions, where every one of them has finite values."""
    states = list(model["transitions"])
    best = dict.fromkeys(states, -np.inf)
    for actions in itertools.product(*(model["transitions"][state] for state in states)):
        values = dense_values(model, dict(zip(states, actions, strict=True)), discount)
        best = {state: max(best[state], values[state]) for state in states}
    return best


def solve(module, mdp, discount):
    """The solution of one of the four solvers by its Python function."""
    if module is exhaustive_search:
        return module.exhaustive_search(mdp, discount, 1e-12, 100_000, 10**6)[0]
    if module is policy_iteration:
        return module.policy_iteration(mdp, mdp.first_row, discount, 1e-9, 1000)[0]
    if module is linear_program:
        return module.linear_program(mdp, discount, 1e-12, 100_000)[0]
    V, Q, changes, history = module.value_iteration(mdp, discount, 1e-12, 100_000)
    tied = module.tied_rows(mdp, Q, 1e-12)
    policy = module.greedy_policy(mdp, Q, tied, discount)
    return module.Solution(V, Q, policy, tied, len(changes), changes[-1], changes, history)


def sparse_mdp(module, rng, size, actions=4, successors=5):
    """A random MDP of a script, made from arrays alone: no terminal states, rewards in [0, 1)."""
    rows = size * actions
    weights = rng.random((rows, successors))
    weights /= weights.sum(axis=1, keepdims=True)
    indices, indptr = rng.integers(0, size, rows * successors), np.arange(rows + 1) * successors
    P = sparse.csr_array((weights.ravel(), indices, indptr), shape=(rows, size))
    start = np.zeros(size)
    start[0] = 1
    first_row, terminal = np.arange(size) * actions, np.zeros(size, bool)
    return module.MDP(range(size), np.tile(np.arange(actions), size), first_row, P, rng.random(rows), start, terminal)
