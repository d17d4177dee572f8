"""Policy iteration: the lecture's three tables (§4.4), improper policies, ties."""

import json

import numpy as np
import policy_iteration as script
import pytest
from known_mdps import CANCELLING, ENDLESS_GAIN, TO_AND_FRO, best_values, random_model, run, tables, written

FIXED = "1·[1 + 0] = 1"


def test_the_lectures_three_tables_as_printed(monkeypatch, capsys):
    code, out, err = run(script, monkeypatch, capsys)
    assert (code, err) == (0, "")
    V, Q, policy, result = tables(out)
    last = "0.7·[1 + 0] + 0.3·[0 + 11] = 4"
    assert V[1:] == [["0", "9", "1", "1", "0"], ["1", "11", "1", last, "0"], ["2", "11", "1", last, "0"]]
    assert Q[1:] == [
        ["0", "1·[10 + 1] = 11", "0.6·[10 + 1] + 0.4·[5 + 1] = 9", FIXED, FIXED, "0.7·[1 + 0] + 0.3·[0 + 9] = 3.4"],
        ["1", "1·[10 + 1] = 11", "0.6·[10 + 1] + 0.4·[5 + 4] = 10.2", FIXED, FIXED, last],
        ["2", "1·[10 + 1] = 11", "0.6·[10 + 1] + 0.4·[5 + 4] = 10.2", FIXED, FIXED, last],
    ]
    assert policy[1:] == [["0", "a2", "a1", "a1"], ["1", "a1", "a1", "a2"], ["2", "a1", "a1", "a2"]]
    assert [row[2] for row in result[1:]] == ["a1", "a1", "a2", "-"]  # Equation 33


def test_the_lectures_three_tables_as_json(monkeypatch, capsys, tmp_path):
    run(script, monkeypatch, capsys, "--output-json", tmp_path / "out.json")
    result = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    V = [list(entry["values"].values()) for entry in result["history"]]
    np.testing.assert_allclose(V, [[9, 1, 1, 0], [11, 1, 4, 0], [11, 1, 4, 0]], rtol=0, atol=1e-12)
    Q = [[q for choices in entry["action_values"].values() for q in choices.values()] for entry in result["history"]]
    np.testing.assert_allclose(Q, [[11, 9, 1, 1, 3.4], [11, 10.2, 1, 1, 4], [11, 10.2, 1, 1, 4]], rtol=0, atol=1e-12)
    assert [entry["policy"]["s2"] for entry in result["history"]] == ["a1", "a2", "a2"]
    assert result["iterations"] == 2 and result["residual"] == 0


@pytest.mark.parametrize("initial", ["s0=a1 s1=a1", "first", "random", "s0=a2 s1=a1 s2=a2"])
def test_every_initial_policy_ends_at_the_same(monkeypatch, capsys, initial):
    for seed in range(3):
        code, out, err = run(script, monkeypatch, capsys, "--initial-policy", initial, "--seed", seed)
        assert (code, err) == (0, "") and "V(s0) = 11\n" in out


def test_a_saved_policy_may_be_the_initial_one(monkeypatch, capsys, tmp_path):
    run(script, monkeypatch, capsys, "--output-json", tmp_path / "out.json")
    _, out, _ = run(script, monkeypatch, capsys, "--initial-policy", tmp_path / "out.json")
    assert "1 iterations" in out


def test_random_depends_on_the_seed_alone(monkeypatch, capsys, tmp_path):
    def first_policy(seed):
        flags = ["--env-id", "FrozenLake-v1", "--initial-policy", "random", "--seed", seed, "--discount", 0.9]
        run(script, monkeypatch, capsys, *flags, "--output-json", tmp_path / "out.json")
        return json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))["history"][0]["policy"]

    assert first_policy(1) == first_policy(1) != first_policy(2)


def test_an_improper_policy_on_the_way_is_no_dead_end(monkeypatch, capsys):
    # Taxi's first actions bump into a wall for ever, -1 each; a peer's policy iteration loops here
    for flags in (["first"], ["random"], ["random", "--seed", 5]):
        values = {"Taxi-v3": "= 7.93\n", "CliffWalking-v1": "= -13\n", "FrozenLake-v1": "= 0.823529411765\n"}
        for env_id, value in values.items():
            code, out, err = run(script, monkeypatch, capsys, "--env-id", env_id, "--initial-policy", *flags)
            assert (code, err) == (0, "") and value in out
            assert env_id == "FrozenLake-v1" or "The initial policy has no finite value in" in out


def test_only_the_states_that_cannot_end_are_given_another_action():
    model = {
        "start": "a",
        "terminal": ["goal"],
        "transitions": {
            "a": {"stay": [[1, "a", -1]], "out": [[1, "goal", -1]]},
            "b": {"out": [[1, "goal", -5]], "dear": [[1, "goal", -6]], "on": [[1, "a", 0]]},
        },
    }
    mdp = script.mdp_from_json(model)
    solution, lost = script.policy_iteration(mdp, np.array([0, 3, 5]), 1.0, 1e-9, 100)
    assert lost.tolist() == [True, False, False]
    assert solution.history[0]["policy"].tolist() == [1, 3, 5] and solution.V.tolist() == [-1, -1, 0]


def test_an_infinite_value_is_proved_on_the_way():
    mdp = script.mdp_from_json(ENDLESS_GAIN)
    for rows in ([0, 2, 3], [1, 2, 3]):
        with pytest.raises(ValueError, match=r"V\* is infinite at discount 1: .* in s, t"):
            script.policy_iteration(mdp, np.array(rows), 1.0, 1e-9, 100)


def test_the_best_policy_with_a_value_where_rewards_cancel():
    mdp = script.mdp_from_json(CANCELLING)
    assert script.policy_iteration(mdp, mdp.first_row, 1.0, 1e-9, 100)[0].V.tolist() == [-10, -9, 0]


def test_ties_do_not_go_round_for_ever():
    # twins: equal actions whose float values differ in the last digit, in a ring that passes the differences on
    size = 30
    thirds, tenths = [[1 / 3, "goal", 0.1], [2 / 3, "goal", 0.1]], [[0.1, "goal", 0.1]] * 3 + [[0.7, "goal", 0.1]]
    transitions = {}
    for s in range(size):
        left, right = f"s{(s - 1) % size}", f"s{(s + 1) % size}"
        transitions[f"s{s}"] = {
            "left": [[0.9 * p, name, r] for p, name, r in thirds] + [[0.1, left, 0.1]],
            "right": [[0.9 * p, name, r] for p, name, r in tenths] + [[0.1, right, 0.1]],
        }
    mdp = script.mdp_from_json({"start": "s0", "terminal": ["goal"], "transitions": transitions})
    for seed in range(20):
        policy = script.parse_policy(mdp, "random", np.random.default_rng(seed))
        solution, _ = script.policy_iteration(mdp, policy, 1.0, 1e-9, 50)
        assert solution.iterations == 1 and (solution.policy == policy).all()
    assert solution.tied[:-1].all() and len(script.as_json(mdp, solution)["ties"]) == size


def test_discounted_against_all_policies():
    for seed in range(100):
        rng = np.random.default_rng(seed)
        model, discount = random_model(rng, proper=False), float(rng.choice([0, 0.5, 0.999]))
        mdp = script.mdp_from_json(model)
        V = script.policy_iteration(mdp, script.parse_policy(mdp, "random", rng), discount, 1e-9, 100)[0].V
        best = best_values(model, discount)
        np.testing.assert_allclose(V[: len(best)], list(best.values()), atol=1e-8)


def test_bad_initial_policies(monkeypatch, capsys, tmp_path):
    for text, message in [("s0=a2 s1=a1", "reaches s2 but names no action there"), ("s9=a1", "'s9' is no state")]:
        code, out, err = run(script, monkeypatch, capsys, "--initial-policy", text)
        assert (code, out) == (2, "") and message in err
    code, _, err = run(script, monkeypatch, capsys, "--max-iterations", 1)
    assert code == 2 and "π has not converged after --max-iterations 1" in err


def test_the_figure(monkeypatch, capsys, tmp_path):
    flags = ["--mdp", written(tmp_path / "mdp.json", TO_AND_FRO), "--figure", tmp_path / "figure.png"]
    assert run(script, monkeypatch, capsys, *flags)[0] == 0
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")
