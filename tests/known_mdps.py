"""What the tests of the five known-MDP scripts share: two ways to run one, independent oracles."""

import importlib
import itertools
import json

import numpy as np
import pytest

SOLVERS = "exhaustive_search value_iteration policy_iteration linear_program".split()
SCRIPTS = list(map(importlib.import_module, ["policy_evaluation", *SOLVERS]))


def go(state, reward=0.0, p=1.0):
    """One transition; "goal" ends the episode."""
    return [p, state, reward, state == "goal"]


def run(script, folder, model=None, **settings):
    """What a script's main writes as JSON, of a model (written as JSON too) or an environment."""
    if model is not None:
        settings["model"] = folder / "model.json"
        settings["model"].write_text(model if isinstance(model, str) else json.dumps(model))
    script.main(script.Args(output_json=folder / "out.json", **settings))
    result = json.loads((folder / "out.json").read_text("utf-8"), parse_constant=pytest.fail)
    assert list(result) == ["values", "action_values", "policy", "iterations", "residual"]
    (folder / "out.json").unlink()
    return result


def refused(script, folder, model=None, **settings):
    """The one line with which a script ends; it has written nothing."""
    with pytest.raises(SystemExit) as stop:
        run(script, folder, model, **settings)
    assert isinstance(stop.value.code, str) and "\n" not in stop.value.code  # exit code 1
    assert {path.name for path in folder.iterdir()} <= {"model.json"}
    return stop.value.code


def tables(text):
    """The printed tables: rows of cells, without the header and the column of i."""
    blocks = [block.splitlines() for block in text.split("\n\n") if block.startswith("i ")]
    return [[[cell.strip() for cell in line.split("  ") if cell][1:] for line in block[1:]]
            for block in blocks]  # fmt: skip


def q_row(v1, q1, v1_, v2, q2, v0, q3):
    """A row of the lecture's tables of Q."""
    return [f"1·[10 + {v1}] = {q1}", f"0.6·[10 + {v1_}] + 0.4·[5 + {v2}] = {q2}",
            "1·[1 + 0] = 1", "1·[1 + 0] = 1", f"0.7·[1 + 0] + 0.3·[0 + {v0}] = {q3}"]  # fmt: skip


def random_model(rng, proper):
    """Ragged action sets, ties, p = 0, now and then a fine of 1e9; proper: any action may end."""
    model = {f"s{i}": {} for i in range(rng.integers(1, 5))}
    rewards = [*range(-5, 6), -1e9 if rng.random() < 0.2 else 0]
    for s in model:
        for a in map(str, range(rng.integers(1, 4))):
            names = [*rng.choice([*model, "goal"], rng.integers(1, 4)), *["goal"] * proper]
            weights = rng.integers(0, 9, len(names)) + np.eye(len(names))[-1]
            ways = zip(names, rng.choice(rewards, len(names)), weights / weights.sum(), strict=True)
            tie = rng.random() < 0.3 and model[s].get("0")
            model[s][a] = tie or [go(str(n), float(r), p) for n, r, p in ways]
    return model


def dense(model, policy, discount):
    """V (S,) of a policy {state: action} by a dense system."""
    A, b, number = np.eye(len(model)), np.zeros(len(model)), {s: i for i, s in enumerate(model)}
    for s, a in policy.items():
        for p, s_next, r, end in model[s][a]:
            b[number[s]] += p * r
            A[number[s], number.get(s_next, 0)] -= 0 if end else discount * p
    return np.linalg.solve(A, b)


def brute(model, discount):
    """V* (S,): the best of every policy."""
    choices = itertools.product(*model.values())
    policies = [dict(zip(model, actions, strict=True)) for actions in choices]
    return np.max([dense(model, policy, discount) for policy in policies], axis=0)
