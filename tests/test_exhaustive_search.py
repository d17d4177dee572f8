"""Exhaustive search: the lecture's three policy graphs (§4.2), and the oracle of the five scripts."""

import itertools
import json
import re

import exhaustive_search as script
import numpy as np
import policy_evaluation
import pytest
from known_mdps import (
    BETTER_STAY,
    CANCELLING,
    ENDLESS_GAIN,
    PURE_GAIN,
    SOLVERS,
    TO_AND_FRO,
    TRAP,
    best_values,
    dense_values,
    random_model,
    run,
    solve,
    tables,
    written,
)


def search(model, discount=1.0, max_policies=10**6):
    """Solution and candidates of a JSON model, with the model as the script reads it."""
    mdp = script.mdp_from_json(model)
    return mdp, *script.exhaustive_search(mdp, discount, 1e-12, 100_000, max_policies)


def test_the_lectures_three_policies(monkeypatch, capsys, tmp_path):
    code, out, err = run(script, monkeypatch, capsys, "--output-json", tmp_path / "out.json")
    assert (code, err) == (0, "")
    assert "3 distinct policy graphs, of ∏|A_s| = 4 assignments" in out
    policies = tables(out)[0][1:]
    assert [row[1] for row in policies] == ["s0=a1 s1=a1", "s0=a2 s1=a1 s2=a1", "s0=a2 s1=a1 s2=a2"]  # π¹, π², π³
    assert [float(row[2]) for row in policies] == pytest.approx([11, 9, 111 / 11], abs=1e-10)
    result = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    assert result["policy"] == {"s0": "a1", "s1": "a1"}
    assert result["values"] == {"s0": 11, "s1": 1, "s2": None, "sG": 0}
    assert [entry["values"]["s0"] for entry in result["history"]] == pytest.approx([11, 9, 111 / 11], abs=1e-12)
    assert result["iterations"] == 3 and result["ties"] == {}


def test_the_warm_start_saves_sweeps_and_changes_no_value(monkeypatch, capsys):
    _, out, _ = run(script, monkeypatch, capsys)
    cold, warm = (sum(int(row[column]) for row in tables(out)[0][1:]) for column in (3, 4))
    assert warm < cold
    assert f"The warm start saves {cold - warm} of {cold} sweeps." in out
    for seed in range(20):
        mdp, _, candidates = search(random_model(np.random.default_rng(seed), proper=True))
        for candidate in candidates:
            alone, _ = script.evaluate_graph(mdp, candidate.rows, 1.0, 1e-12, 100_000, np.zeros(len(mdp.states)))
            np.testing.assert_allclose(candidate.V, alone, atol=1e-10)


def test_the_warm_start_does_not_leak_into_a_loop_without_reward():
    # The policy before leaves t for 7; the next stays in t, and V(t) = V(t) would keep the 7.
    model = {
        "start": "s",
        "terminal": ["goal"],
        "transitions": {"s": {"on": [[1, "t", 0]]}, "t": {"out": [[1, "goal", 7]], "stay": [[1, "t", 0]]}},
    }
    _, _, candidates = search(model)
    assert [candidate.value for candidate in candidates] == [7, 0]


def test_each_policy_graph_comes_once():
    for seed in range(50):
        model = random_model(np.random.default_rng(seed), proper=False)
        mdp = script.mdp_from_json(model)
        names = [f"s{s}" for s in range(len(model["transitions"]))]
        expected = set()
        for actions in itertools.product(*(model["transitions"][state] for state in names)):
            policy, reached, frontier = dict(zip(names, actions, strict=True)), set(), ["s0"]
            while frontier:
                state = frontier.pop()
                if state in reached or state not in policy:
                    continue
                reached.add(state)
                frontier += [s_next for _, s_next, _ in model["transitions"][state][policy[state]]]
            expected.add(frozenset((state, policy[state]) for state in reached))
        graphs = [frozenset((names[mdp.state_of_row[row]], mdp.actions[row]) for row in rows)
                  for rows in script.policy_graphs(mdp)]
        assert len(graphs) == len(set(graphs)) and set(graphs) == expected


def test_a_deep_tree_has_few_policy_graphs_and_many_assignments():
    transitions = {}
    for node in range(1, 64):
        children = [str(2 * node + k) if node < 32 else "end" for k in (0, 1)]
        transitions[str(node)] = {"left": [[1, children[0], node]], "right": [[1, children[1], node]]}
    mdp, solution, _ = search({"start": "1", "terminal": ["end"], "transitions": transitions}, max_policies=64)
    assert solution.iterations == 64 and script.assignments(mdp) == "about 10^19"  # 2^63
    assert solution.V[0] == 1 + 3 + 7 + 15 + 31 + 63


def test_it_refuses_too_many_policies_with_their_number(monkeypatch, capsys):
    code, out, err = run(script, monkeypatch, capsys, "--max-policies", 2)
    assert (code, out) == (2, "")
    assert re.fullmatch(r"error: there are more than --max-policies 2 policy graphs \(4 assignments.*\)\n", err)
    code, _, err = run(script, monkeypatch, capsys, "--env-id", "FrozenLake-v1", "--max-policies", 1000)
    assert code == 2 and "1,000 policy graphs (4,294,967,296 assignments" in err


def test_ties_are_a_set():
    model = {
        "start": "s",
        "terminal": ["goal"],
        "transitions": {
            "s": {"a": [[1, "goal", 0.3]], "b": [[0.5, "goal", 0.1], [0.5, "goal", 0.5]], "c": [[1, "goal", 0]]}
        },
    }
    mdp, solution, _ = search(model)
    assert script.as_json(mdp, solution)["ties"] == {"s": ["a", "b"]}


def test_policies_without_a_finite_value_are_passed_over():
    mdp, solution, candidates = search(TRAP)
    assert solution.V[mdp.states.index("s")] == 1 and np.isnan(candidates[1].value)
    assert search(TO_AND_FRO)[1].V.tolist() == [1, 1, 0]
    assert search(BETTER_STAY)[1].V[0] == 0
    assert search(CANCELLING)[1].V[0] == -10
    for model in (ENDLESS_GAIN, PURE_GAIN):
        with pytest.raises(ValueError, match=r"V\* is infinite .* in s"):
            search(model)
    hopeless = {"start": "s", "transitions": {"s": {"stay": [[1, "s", -1]]}}}
    with pytest.raises(ValueError, match="no policy has a finite value"):
        search(hopeless)


def test_a_distribution_of_starts():
    model = {**TO_AND_FRO, "start": {"left": 0.25, "goal": 0.75}}
    mdp, solution, _ = search(model)
    assert mdp.start @ solution.V == 0.25


@pytest.mark.parametrize("part", range(4))
def test_the_five_scripts_agree_on_a_thousand_random_mdps(part):
    for seed in range(250 * part, 250 * (part + 1)):
        rng = np.random.default_rng(seed)
        proper = seed % 2 == 0
        model, discount = random_model(rng, proper), 1.0 if proper else float(rng.choice([0, 0.5, 0.9, 0.95]))
        oracle = best_values(model, discount)
        solutions = {module.__name__: solve(module, module.mdp_from_json(model), discount) for module in SOLVERS}
        for name, solution in solutions.items():
            states = ["s0"] if name == "exhaustive_search" else list(oracle)  # it looks at the start alone (§4.1)
            for s, state in enumerate(states):
                assert solution.V[s] == pytest.approx(oracle[state], abs=1e-8), (seed, name, state)
        # the policies that the scripts return attain the values that they return
        mdp = policy_evaluation.mdp_from_json(model)
        for solution in {solution.policy.tobytes(): solution for solution in solutions.values()}.values():
            evaluated = policy_evaluation.policy_evaluation(mdp, solution.policy, discount, 1e-12, 100_000)
            assert evaluated.V[0] == pytest.approx(oracle["s0"], abs=1e-8), seed
            if (solution.policy[: len(oracle)] >= 0).all():
                chosen = {state: mdp.actions[solution.policy[s]] for s, state in enumerate(oracle)}
                assert dense_values(model, chosen, discount)["s0"] == pytest.approx(oracle["s0"], abs=1e-8)


def test_the_figure_and_a_model_of_ones_own(monkeypatch, capsys, tmp_path):
    path = written(tmp_path / "mdp.json", TO_AND_FRO)
    code, out, err = run(script, monkeypatch, capsys, "--mdp", path, "--figure", tmp_path / "figure.png")
    assert (code, err) == (0, "") and "V(left) = 1" in out
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")
